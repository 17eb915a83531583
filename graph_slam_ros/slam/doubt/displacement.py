"""Search for a displacement: the landmarks and odometry disagree on the pose.

Odometry that is wrong without a jump leaves traces in the sightings that are held back: they agree with one another at
another pose of the robot, and not with odometry. Sightings with wrong identities do not agree with one another. The
evidence is a count: held-back sightings that fit the other pose, minus believed ones that do not.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.connections import Connections, connections_across
from graph_slam_ros.slam.doubt.record import DisplacementHypothesis, Link
from graph_slam_ros.slam.doubt.window import REACH_S, Seen, View, Window
from graph_slam_ros.slam.landmarks.rotations import aligned, are_spread, pose_of
from graph_slam_ros.slam.levels import LIKELY, SAME_M, SAME_RAD
from graph_slam_ros.typing import Array, Index, Numbers

Flags = NDArray[np.bool_]

_SIGHTINGS = 50  # that are compared
_SEEDS = 10  # newest held back sightings from which another pose is computed
_MAP_SIGMA_M = 0.1  # error of a landmark of the map, beside its neighbours
_VAGUE_M, _VAGUE = 0.2, 0.3  # a sighting that fits within more than this, and this part of its distance, tells nothing
_HEADING_SIGMA_RAD = 0.05  # error of a landmark's heading in the map
_DRIFT = 2.0  # sigmas of odometry


@dataclass(frozen=True, slots=True)
class _Sightings:
    """The newest sightings that tell a position, as arrays, in order of time."""

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

    Attributes
    ----------
    window : the newest keyframes
    """

    def __init__(self, space: Geometry, backend: Backend, window: Window) -> None:
        self._space, self.window = space, window
        self._backend, self._graph = backend, backend.graph
        self._solver, self._ledger = backend.solver, backend.ledger

    @property
    def held_back_count(self) -> int:
        """The number of the newest sightings of well known landmarks that are held back."""
        known = [one.edge for view, one in self._standing() if self.window.known_from(one.what) < view.vertex]
        return self._ledger.are_inside(known).count(False)

    def hypothesis(self) -> DisplacementHypothesis | None:
        """The other pose for which the evidence is greatest; None where there is none."""
        window = self._sightings()
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

    def _earlier(self, window: _Sightings) -> Connections | None:
        """The accepted edges that connect across the keyframes before the window.

        None where the window has all that was seen since the segment began.
        """
        vertices = self.vertices
        vertices = vertices[(vertices > self.window.first) & (vertices < window.keyframes[0])]
        if self._has_all or not len(vertices):
            return None
        return connections_across(self._graph, self._solver.held, vertices, int(window.keyframes[0]))

    @property
    def _has_all(self) -> bool:
        """Return whether all sightings since the segment began are compared."""
        return self.window.is_whole and len(self._newest()) < _SIGHTINGS

    def _newest(self) -> list[tuple[View, Seen]]:
        """The newest sightings that tell a position, in order of time."""
        newest = (
            (view, one) for view in reversed(self.window.views) for one in reversed(view.seen) if one.point is not None
        )
        return list(islice(newest, _SIGHTINGS))[::-1]

    def _standing(self) -> list[tuple[View, Seen]]:
        is_standing = self._ledger.is_standing()
        return [(view, one) for view, one in self._newest() if is_standing(one.edge)]

    def _sightings(self) -> _Sightings | None:
        seen, n = self._standing(), self._space.dimensions
        if not seen:
            return None
        links, marks = [self.window.links[view.vertex] for view, _ in seen], [one for _, one in seen]
        estimates = [self._solver.estimate([one.what])[0] for one in marks]
        places = np.array([estimate[:n] for estimate in estimates])
        fits_now = [self._fits_now(one, link, place) for one, link, place in zip(marks, links, places, strict=True)]
        return _Sightings(
            np.array([one.edge for one in marks]),
            np.array([view.vertex for view, _ in seen]),
            np.array([one.what for one in marks]),
            np.array([(link.stamps_ns[1] - links[-1].stamps_ns[1]) * 1e-9 for link in links]),
            np.array([one.point for one in marks]),
            np.array([link.pose[:n] for link in links]),
            np.array([one.variance for one in marks]),
            np.array([link.drift for link in links]),
            np.array([one.heading for one in marks]),
            np.array([one.heading_variance for one in marks]),
            places,
            np.array([estimate[2] if len(estimate) == 3 and n == 2 else np.nan for estimate in estimates]),
            np.array([self.window.known_from(one.what) for one in marks]),
            np.array([self._ledger.is_inside(one.edge) for one in marks]),
            np.array(fits_now),
        )

    def _fits_now(self, one: Seen, link: Link, place: Array) -> bool:
        group = self._space.group
        now = tuple(self._solver.estimate([link.vertices[1]])[0].tolist())
        point = group.act(group.compose(now, group.inverse(link.pose)), tuple(np.array(one.point).tolist()))
        allowed = quantile(LIKELY, self._space.dimensions) * (one.variance + _MAP_SIGMA_M**2)
        return bool(np.sum((np.array(point) - place) ** 2) <= allowed)

    def _motions(self, window: _Sightings) -> Iterator[tuple[tuple[Array, Array], int]]:
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
                yield self._refined(window, aligned(p, m), seeds[0]), seeds[0]

    def _refined(self, window: _Sightings, motion: tuple[Array, Array], at: int) -> tuple[Array, Array]:
        """The motion by all sightings that are held back and fit it, the vaguer the less."""
        for _ in range(2):
            fits = self._fits(window, motion, at) & ~window.is_in
            if np.count_nonzero(fits) < self._space.dimensions:
                return motion
            weights = 1.0 / self._variances(window, at)[fits]
            motion = aligned(window.points[fits], window.places[fits], weights)
        return motion

    def _variances(self, window: _Sightings, at: int) -> Array:
        """The variance of each sighting, with what odometry may have drifted between it and one of them."""
        drift, lever = np.abs(window.drifts - window.drifts[at]), self._levers(window)
        return np.asarray(window.variances + _MAP_SIGMA_M**2 + drift[:, 0] + drift[:, 1] * lever**2)

    @staticmethod
    def _levers(window: _Sightings) -> Array:
        return np.asarray(np.linalg.norm(window.points - window.bases, axis=1))

    def _fits(self, window: _Sightings, motion: tuple[Array, Array], at: int) -> Flags:
        """Sightings that fit a motion; one that would fit nearly anywhere does not count."""
        turn, shift = motion
        away = np.sum((window.points @ turn.T + shift - window.places) ** 2, axis=1)
        allowed = quantile(LIKELY, self._space.dimensions) * self._variances(window, at)
        is_informative = allowed <= (_VAGUE_M + _VAGUE * self._levers(window)) ** 2
        fits = (away <= allowed) & is_informative & (window.seconds > -REACH_S)
        off = se2.wrap(window.headings + np.arctan2(turn[1, 0], turn[0, 0]) - window.place_headings)
        drift = np.abs(window.drifts - window.drifts[at])[:, 1]
        spread = window.heading_variances + drift + _HEADING_SIGMA_RAD**2
        return np.asarray(fits & ~(off**2 > quantile(LIKELY, 1) * spread))

    def _evidence(
        self, window: _Sightings, fits: Flags, motion: tuple[Array, Array], earlier: Connections | None
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
                and not self._is_drift(before.first, pose_of(self._space, *motion), int(window.keyframes[-1]))
            )
        best = 0 if is_earlier else len(firsts) - 1 - int(np.argmax(counted[::-1]))
        if counted[best] <= 0:
            return None
        first = int(firsts[best])
        is_believed = window.is_in & (window.supports < window.keyframes)
        if self._has_all and not is_believed[window.keyframes < first].any():
            first = max(self.window.first, int(self.vertices[0]))  # nothing supports what came before in this segment
        both = since[best] & known[best]
        agreeing = both & (fits if is_earlier else for_it)  # the first that is seen again may fit both poses
        return DisplacementHypothesis(
            first,
            max(first, int(window.keyframes[0])),
            pose_of(self._space, *motion),
            int(counted[best]),
            len(set(window.landmarks[agreeing].tolist())),
            len(set(window.keyframes[agreeing].tolist())),
            bool(np.isfinite(window.headings[agreeing]).all()),
            tuple(window.edges[both & fits].tolist()),
            tuple(window.edges[both & ~fits].tolist()),
        )

    def _is_drift(self, keyframe: int, T_map_chain: Numbers, newest: int) -> bool:
        """Return whether the noise of odometry since a keyframe explains that its frame lies there in map."""
        group, link = self._space.group, self.window.links[keyframe]
        now, chain = tuple(self._solver.estimate([keyframe])[0].tolist()), link.pose
        off_m, off_rad = self.difference(group.compose(now, group.inverse(chain)), T_map_chain, newest)
        drift_m, drift_rad = self.window.drift_since(link.drift, chain, newest)
        return off_m < _DRIFT * drift_m and off_rad < _DRIFT * drift_rad

    @property
    def vertices(self) -> Index:
        """The keyframes whose odometry is known, in order."""
        return np.fromiter(self.window.links, dtype=np.int64, count=len(self.window.links))

    # -- for whoever acts on it ----------------------------------------------------------------------------------

    def difference(self, T_map_chain: Numbers, other: Numbers, keyframe: int) -> tuple[float, float]:
        """Distance [m] and angle [rad] of a keyframe, by its vertex, by two places of the evidence's own frame."""
        group, chain = self._space.group, self.window.links[keyframe].pose
        difference = group.between(group.compose(T_map_chain, chain), group.compose(other, chain))
        return float(np.linalg.norm(difference[: self._space.dimensions])), float(self._space.angle(difference))

    def are_apart(self, T_map_chain: Numbers, other: Numbers, keyframe: int) -> bool:
        """Return whether these are two different poses."""
        far_m, turned_rad = self.difference(T_map_chain, other, keyframe)
        return far_m > SAME_M or turned_rad > SAME_RAD

    def begun_at(self, found: DisplacementHypothesis, first: int | None) -> DisplacementHypothesis | None:
        """Return a hypothesis that begins at an earlier keyframe, by its vertex, if odometry since is remembered.

        It begins where a map that is held has ended, at the earliest; None where all of odometry is in it.
        """
        if first is not None and first < found.first and self.window.links:
            found = replace(found, first=max(first, self.window.first, int(self.vertices[0])))
        links, free = self.window.links.items(), self._backend.first_free_edge
        begin = next((vertex for vertex, link in links if vertex >= found.first and link.edge >= free), None)
        return None if begin is None else replace(found, first=begin, seen_from=max(found.seen_from, begin))
