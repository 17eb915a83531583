"""Search for a displacement after a slip or a kidnap: the landmarks and odometry disagree on the pose.

Odometry that is wrong without a jump leaves traces in the sightings that are held back: they agree with one another at
another pose of the robot, and not with odometry. Sightings with wrong identities do not agree with one another. The
evidence is a count: held-back sightings that fit the other pose, minus believed ones that do not.
"""

from bisect import insort
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.landmarks.rigid_alignment import aligned, are_spread
from graph_slam_ros.slam.robust.connections import Connections, connections_across
from graph_slam_ros.slam.robust.displacement_hypothesis import DisplacementHypothesis
from graph_slam_ros.slam.robust.landmark_history import LandmarkHistory
from graph_slam_ros.slam.robust.ledger import Ledger
from graph_slam_ros.slam.robust.odometry_chain import OdometryChain
from graph_slam_ros.slam.robust.seen_point import seen_heading, seen_point, seen_variance
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index, Numbers

Flags = NDArray[np.bool_]

WINDOW = 50  # sightings that are compared
REACH_S = 20.0  # sightings that are older are not compared with the newest
_SEEDS = 10  # newest held back sightings from which another pose is computed
_FIT = 0.999  # probability with which a true sighting fits the other pose
_MAP_SIGMA_M = 0.1  # error of a landmark of the map, beside its neighbours
_VAGUE_M, _VAGUE = 0.2, 0.3  # a sighting that fits within more than this, and this part of its distance, tells nothing
_HEADING_SIGMA_RAD = 0.05  # error of a landmark's heading in the map
SAME_M, SAME_RAD = 1.0, 0.3  # poses farther from each other are two
_DRIFT = 2.0  # sigmas of odometry


@dataclass(frozen=True, slots=True)
class _Seen:
    """One sighting of a landmark with a position: its edge, and where odometry's chain of motions puts it."""

    edge: int
    keyframe: int
    landmark: int
    stamp_ns: int
    point: Array
    base: Array
    variance: float
    drift: Array  # variances [m^2, rad^2] of odometry since the evidence's frame began
    heading: float  # of a landmark that is a pose, in the evidence's frame; NaN where it was not seen
    heading_variance: float


@dataclass(frozen=True, slots=True)
class _Window:
    """The sightings of the window as arrays, in order of time."""

    edges: Index
    keyframes: Index
    landmarks: Index
    seconds: Array  # since the newest, at most 0
    points: Array
    bases: Array
    variances: Array
    drifts: Array
    headings: Array
    heading_variances: Array
    places: Array  # of the landmarks in map
    place_headings: Array
    supports: Index  # vertices of the keyframes from which each landmark was well known
    is_in: Flags
    fits_now: Flags  # the present estimate, but for what the map may be wrong by


class DisplacementSearch:
    """The newest sightings of landmarks, laid out along odometry alone.

    Parameters
    ----------
    graph, solver, ledger : of the back-end

    Attributes
    ----------
    chain : the newest keyframes by odometry alone
    """

    def __init__(self, space: Geometry, graph: Graph, solver: Solver, ledger: Ledger, history: LandmarkHistory) -> None:
        self._space, self._history = space, history
        self._graph, self._solver, self._ledger = graph, solver, ledger
        self._seen: deque[_Seen] = deque()  # in order of keyframes; they may come in another
        self.chain = OdometryChain(space, graph)
        self._poses: dict[int, list[int]] = {}  # edges of initial poses, by their keyframe
        self._first = 0  # vertex of the segment's first keyframe
        self._is_supported = False  # whether a sighting of a landmark that was known is believed since then
        self._forgot = False  # whether sightings were dropped because their keyframes had left the chain

    # -- what came -----------------------------------------------------------------------------------------------

    def begin(self, vertex: int) -> None:
        """A segment begins at a keyframe: what was seen before tells nothing of where it is."""
        self._first, self._is_supported, self._forgot = vertex, False, False
        while self._seen and self._seen[0].keyframe < vertex:
            self._seen.popleft()
        self.chain.forget_before(vertex)

    def add_initial_pose(self, edge: int, keyframe: int) -> None:
        """A pose that was given at a keyframe."""
        self._poses.setdefault(keyframe, []).append(edge)

    def add_sighting(self, edge: int, keyframe: int, landmark: int) -> None:
        """A sighting of a landmark; of use is one that tells a position."""
        one, n = self._graph.edge(edge), self._space.dimensions
        point = seen_point(self._space, one)
        if keyframe not in self.chain or point is None or keyframe < self._first:
            return
        base = self.chain.pose(keyframe)
        in_chain = np.array(self._space.group.act(base, tuple(point.tolist())))
        stamp_ns, variance = self.chain.stamp_ns(keyframe), seen_variance(self._space, one, point)
        drift, heading = self.chain.drift(keyframe), seen_heading(self._space, one, base)
        seen = _Seen(edge, keyframe, landmark, stamp_ns, in_chain, np.array(base[:n]), variance, drift, *heading)
        insort(self._seen, seen, key=lambda other: other.keyframe)
        if len(self._seen) > WINDOW:
            self._seen.popleft()

    def renumber(self, vertices: Index, edges: Index, first: int) -> None:
        """Take over new ids of all vertices and edges, by old ones; -1: it was removed.

        Parameters
        ----------
        first : the first keyframe that stays, by its new vertex
        """
        self.chain.renumber(vertices, edges, first)
        count = len(self._seen)
        self._seen = deque(
            replace(one, edge=int(edges[one.edge]), keyframe=int(vertices[one.keyframe]), landmark=landmark)
            for one in self._seen
            if edges[one.edge] >= 0 and (landmark := int(vertices[one.landmark])) >= 0
        )
        self._forgot |= len(self._seen) < count
        self._first = max(int(vertices[self._first]), first)
        poses = {int(vertices[vertex]): edges[given] for vertex, given in self._poses.items()}
        self._poses = {vertex: given[given >= 0].tolist() for vertex, given in poses.items() if vertex >= first}

    # -- what it tells -------------------------------------------------------------------------------------------

    @property
    def held_back_count(self) -> int:
        """The number of the newest sightings of well known landmarks that are held back."""
        known_from = cache(self._known_from)  # many are of the same landmark
        known = [one for one in self._standing() if known_from(one.landmark) < one.keyframe]
        are_inside = self._ledger.are_inside(one.edge for one in known)
        self._is_supported |= any(are_inside)
        return len(known) - sum(are_inside)

    def hypothesis(self) -> DisplacementHypothesis | None:
        """The other pose for which the evidence is greatest; None where there is none."""
        window = self._window()
        if window is None:
            return None
        found, earlier = list[tuple[DisplacementHypothesis, Flags]](), self._earlier(window)
        for motion, at in self._motions(window):
            fits = self._fits(window, motion, at)
            one = self._evidence(window, fits, motion, earlier)
            found += [(one, fits & ~window.is_in)] if one else []
        if not found:
            return None
        best, _ = max(found, key=lambda one: one[0].evidence)
        same, newest = window.keyframes >= best.first, int(window.keyframes[-1])
        rivals = [
            np.count_nonzero(fits & same)
            for one, fits in found
            if self.are_apart(best.T_map_chain, one.T_map_chain, newest)
        ]
        return replace(best, rival=int(max(rivals, default=0)))

    def _earlier(self, window: _Window) -> Connections | None:
        """The accepted edges that connect across the keyframes before the window.

        None where the window has all that was seen since the segment began.
        """
        vertices = self.chain.vertices
        vertices = vertices[(vertices > self._first) & (vertices < window.keyframes[0])]
        if self._has_all or not len(vertices):
            return None
        return connections_across(self._graph, self._solver.held, vertices, int(window.keyframes[0]))

    @property
    def _has_all(self) -> bool:
        """Return whether the window has all sightings since the segment began."""
        return len(self._seen) < WINDOW and not self._forgot

    def _standing(self) -> list[_Seen]:
        while self._seen and self._seen[0].keyframe not in self.chain:
            self._seen.popleft()
            self._forgot = True
        is_standing = self._ledger.is_standing()
        return [one for one in self._seen if is_standing(one.edge)]

    def _window(self) -> _Window | None:
        seen = self._standing()
        if not seen:
            return None
        newest_ns, n = seen[-1].stamp_ns, self._space.dimensions
        estimates = [self._solver.estimate([one.landmark])[0] for one in seen]
        places = np.array([estimate[:n] for estimate in estimates])
        return _Window(
            np.array([one.edge for one in seen]),
            np.array([one.keyframe for one in seen]),
            np.array([one.landmark for one in seen]),
            np.array([(one.stamp_ns - newest_ns) * 1e-9 for one in seen]),
            np.array([one.point for one in seen]),
            np.array([one.base for one in seen]),
            np.array([one.variance for one in seen]),
            np.array([one.drift for one in seen]),
            np.array([one.heading for one in seen]),
            np.array([one.heading_variance for one in seen]),
            places,
            np.array([estimate[2] if len(estimate) == 3 and n == 2 else np.nan for estimate in estimates]),
            np.array(list(map(cache(self._known_from), (one.landmark for one in seen)))),
            np.array([self._ledger.is_inside(one.edge) for one in seen]),
            np.array([self._fits_now(one, place) for one, place in zip(seen, places, strict=True)]),
        )

    def _fits_now(self, one: _Seen, place: Array) -> bool:
        group, chain = self._space.group, self.chain.pose(one.keyframe)
        now = tuple(self._solver.estimate([one.keyframe])[0].tolist())
        point = group.act(group.compose(now, group.inverse(chain)), tuple(one.point.tolist()))
        allowed = quantile(_FIT, self._space.dimensions) * (one.variance + _MAP_SIGMA_M**2)
        return bool(np.sum((np.array(point) - place) ** 2) <= allowed)

    def _motions(self, window: _Window) -> Iterator[tuple[tuple[Array, Array], int]]:
        """Rigid motions that lay a few held back sightings on their landmarks, and the newest of these."""
        out = np.flatnonzero(~window.is_in & (window.seconds > -REACH_S))[-_SEEDS:].tolist()[::-1]
        for several in combinations(out, self._space.dimensions):
            seeds = list(several)
            p, m = window.points[seeds], window.places[seeds]
            if len(set(window.landmarks[seeds].tolist())) < len(seeds) or not are_spread(p) or not are_spread(m):
                continue
            allowed = 3.0 * np.sqrt(self._variances(window, seeds[0])[seeds].sum())
            if all(
                abs(np.linalg.norm(p[i] - p[j]) - np.linalg.norm(m[i] - m[j])) < allowed
                for i, j in combinations(range(len(seeds)), 2)
            ):
                yield self._refined(window, aligned(p, m, np.ones(len(seeds))), seeds[0]), seeds[0]

    def _refined(self, window: _Window, motion: tuple[Array, Array], at: int) -> tuple[Array, Array]:
        """The motion by all sightings that are held back and fit it, the vaguer the less."""
        for _ in range(2):
            fits = self._fits(window, motion, at) & ~window.is_in
            if np.count_nonzero(fits) < self._space.dimensions:
                return motion
            weights = 1.0 / self._variances(window, at)[fits]
            motion = aligned(window.points[fits], window.places[fits], weights)
        return motion

    def _variances(self, window: _Window, at: int) -> Array:
        """The variance of each sighting, with what odometry may have drifted between it and one of them."""
        drift, lever = np.abs(window.drifts - window.drifts[at]), self._levers(window)
        return np.asarray(window.variances + _MAP_SIGMA_M**2 + drift[:, 0] + drift[:, 1] * lever**2)

    @staticmethod
    def _levers(window: _Window) -> Array:
        return np.asarray(np.linalg.norm(window.points - window.bases, axis=1))

    def _fits(self, window: _Window, motion: tuple[Array, Array], at: int) -> Flags:
        """Sightings that fit a motion; one that would fit nearly anywhere does not count."""
        turn, shift = motion
        away = np.sum((window.points @ turn.T + shift - window.places) ** 2, axis=1)
        allowed = quantile(_FIT, self._space.dimensions) * self._variances(window, at)
        is_informative = allowed <= (_VAGUE_M + _VAGUE * self._levers(window)) ** 2
        fits = (away <= allowed) & is_informative & (window.seconds > -REACH_S)
        off = se2.wrap(window.headings + np.arctan2(turn[1, 0], turn[0, 0]) - window.place_headings)
        drift = np.abs(window.drifts - window.drifts[at])[:, 1]
        spread = window.heading_variances + drift + _HEADING_SIGMA_RAD**2
        return np.asarray(fits & ~(off**2 > quantile(_FIT, 1) * spread))

    def _known_from(self, landmark: int) -> int:
        return self._history.known_from(landmark, min(one.edge for one in self._seen))

    def _evidence(
        self, window: _Window, fits: Flags, motion: tuple[Array, Array], earlier: Connections | None
    ) -> DisplacementHypothesis | None:
        """The evidence from the keyframe on that has most: landmarks that are newer than it tell nothing.

        One before the window may be the first, too.
        """
        for_it, against = fits & ~window.is_in & ~window.fits_now, ~fits & window.is_in
        firsts = window.keyframes[np.flatnonzero(np.diff(window.keyframes, prepend=-1) != 0)]
        before = None
        if earlier is not None:
            of, which = np.unique(window.landmarks, return_inverse=True)
            fitting = of[np.bincount(which, weights=fits) > np.bincount(which, weights=against)]
            before = earlier.likeliest(fitting)
            firsts = np.r_[before.first, firsts]
        known = window.supports[None, :] < firsts[:, None]
        since = window.keyframes[None, :] >= firsts[:, None]
        counted = (known & since) @ for_it.astype(int) - (known & since) @ against.astype(int)
        is_earlier = False
        if before is not None:
            counted[0] -= before.contradicted
            most = int(counted[1:].max())
            is_earlier = counted[0] > most or (
                counted[0] + before.explained > most
                and not self._is_drift(before.first, self._pose(motion), int(window.keyframes[-1]))
            )
        best = 0 if is_earlier else len(firsts) - 1 - int(np.argmax(counted[::-1]))
        if counted[best] <= 0:
            return None
        first = int(firsts[best])
        if not self._is_supported or (self._has_all and not window.is_in[window.keyframes < first].any()):
            first = max(self._first, int(self.chain.vertices[0]))  # nothing supports what came before in this segment
        else:
            first = self._after_the_longest_link(first)
        both = since[best] & known[best]
        agreeing = both & (fits if is_earlier else for_it)  # the first that is seen again may fit both poses
        return DisplacementHypothesis(
            first,
            max(first, int(window.keyframes[0])),
            self._pose(motion),
            int(counted[best]),
            len(set(window.landmarks[agreeing].tolist())),
            len(set(window.keyframes[agreeing].tolist())),
            bool(np.isfinite(window.headings[agreeing]).all()),
            tuple(window.edges[both & fits].tolist()),
            tuple(window.edges[both & ~fits].tolist()),
        )

    def _is_drift(self, keyframe: int, T_map_chain: Numbers, newest: int) -> bool:
        """Return whether the noise of odometry since a keyframe explains that its frame lies there in map."""
        group, chain = self._space.group, self.chain.pose(keyframe)
        now = tuple(self._solver.estimate([keyframe])[0].tolist())
        off_m, off_rad = self.difference(group.compose(now, group.inverse(chain)), T_map_chain, newest)
        drift_m, drift_rad = self.chain.drift_since(self.chain.drift(keyframe), chain, newest)
        return off_m < _DRIFT * drift_m and off_rad < _DRIFT * drift_rad

    def _after_the_longest_link(self, first: int) -> int:
        """Return a keyframe, or that after the longest of the links before it between which nothing was seen.

        Nothing tells in which of these links the robot was moved: most probably in the one that took longest.
        """
        seen = {one.keyframe for one in self._seen}
        vertices = self.chain.vertices.tolist()
        stamp_ns = self.chain.stamp_ns
        best = k = vertices.index(first)
        while k > 1 and vertices[k - 1] not in seen and not self._is_measured(vertices[k - 1]):
            k -= 1
            longest_ns = stamp_ns(vertices[best]) - stamp_ns(vertices[best - 1])
            if stamp_ns(vertices[k]) - stamp_ns(vertices[k - 1]) > longest_ns:
                best = k
        return vertices[best]

    def _is_measured(self, keyframe: int) -> bool:
        """Return whether more than odometry is believed of a keyframe."""
        edges = self._solver.edges_on(keyframe).tolist()
        return any(self._ledger.is_inside(one) for one in edges if self._graph.edge(one).label != "odometry")

    def _pose(self, motion: tuple[Array, Array]) -> Numbers:
        turn, shift = motion
        if self._space.dimensions == 2:
            return *map(float, shift), float(np.arctan2(turn[1, 0], turn[0, 0]))
        return *map(float, shift), *map(float, Rotation.from_matrix(turn).as_quat())

    # -- for whoever acts on it ----------------------------------------------------------------------------------

    def difference(self, T_map_chain: Numbers, other: Numbers, keyframe: int) -> tuple[float, float]:
        """Distance [m] and angle [rad] of a keyframe, by its vertex, by two places of the evidence's own frame."""
        group, chain = self._space.group, self.chain.pose(keyframe)
        difference = group.between(group.compose(T_map_chain, chain), group.compose(other, chain))
        return float(np.linalg.norm(difference[: self._space.dimensions])), float(self._space.angle(difference))

    def are_apart(self, T_map_chain: Numbers, other: Numbers, keyframe: int) -> bool:
        """Return whether these are two different poses."""
        far_m, turned_rad = self.difference(T_map_chain, other, keyframe)
        return far_m > SAME_M or turned_rad > SAME_RAD

    def begun_at(self, found: DisplacementHypothesis, first: int | None) -> DisplacementHypothesis:
        """Return a hypothesis that begins at an earlier keyframe, by its vertex, if odometry since is remembered."""
        if first is None or first >= found.first or not self.chain:
            return found
        return replace(found, first=max(first, self._first, int(self.chain.vertices[0])))

    def initial_poses(self, first: int) -> list[int]:
        """Edges of initial poses from a keyframe on."""
        return [edge for vertex, edges in self._poses.items() if vertex >= first for edge in edges]
