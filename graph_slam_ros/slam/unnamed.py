"""Landmarks whose sightings do not say which they are: begun, confirmed, merged, parted again, given up.

A landmark that nothing in the map fits is begun as a tentative one. It is in the graph at once - seen for a first time
it bends nothing - and is associated like any other, but it is given up unless it is seen again often enough for long
enough. Nothing is final: what was seen of each landmark is kept, so that two that turn out to be one are merged by
giving the sightings of one to the other, and are parted again where these do not fit; and one that moved is given up.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.slam import association, carry
from graph_slam_ros.slam.association import NEW, UNCLEAR, Gates
from graph_slam_ros.slam.carry import Carried, Where
from graph_slam_ros.slam.config import Config
from graph_slam_ros.slam.counters import Counters
from graph_slam_ros.slam.landmarks import Landmark, Landmarks
from graph_slam_ros.slam.measurements import Sighting, Sightings
from graph_slam_ros.slam.space import Numbers
from graph_slam_ros.solver import Solver

Array = NDArray[np.float64]

_MOST_CANDIDATES = 24  # landmarks that one message is compared with: the nearest
_MOST_AT_ONCE = 8  # new landmarks whose pairings are weighed together: the latest
_MOST_TRIED = 1000
_REACH_SIGMA = 5.0
_POSITIONED = ("position", "pose", "range_bearing")


@dataclass(frozen=True, slots=True)
class Merger:
    """Two landmarks that became one: which, the sightings that changed hands, and the edges they are now."""

    kept: str
    merged: str
    first: int
    count: int


class Unnamed:
    """Association of a message's sightings with the landmarks, and what follows from it later.

    Parameters
    ----------
    hand_over : gives the solver what is new in the graph, so that its covariances are of all of it
    """

    def __init__(
        self, config: Config, landmarks: Landmarks, solver: Solver, counters: Counters, hand_over: Callable[[], None]
    ) -> None:
        self._config, self._space = config.landmarks, config.space
        self._landmarks, self._solver, self._counters = landmarks, solver, counters
        self._hand_over = hand_over
        c = config.landmarks
        self._gates = Gates(
            c.gate_same, c.gate_other, c.density_per_m**self._space.dimensions, c.ambiguity_chi2, c.close_m
        )
        self._begun = 0
        self._mergers: deque[Merger] = deque(maxlen=100)
        self._parted: set[tuple[str, str]] = set()

    def identified(self, m: Sightings, where: Where) -> list[tuple[str, Sighting]]:
        """The sightings of a message that can be used, each with an identity; the others are counted."""
        out = [(s.id, s) for s in m.sightings if s.id]
        unnamed = [s for s in m.sightings if not s.id and s.kind in _POSITIONED]
        if len(out) + len(unnamed) < len(m.sightings):
            self._counters.count(m.topic, "no_id", len(m.sightings) - len(out) - len(unnamed))
        found = self._associated(unnamed, where) if unnamed else []
        if len(found) < len(unnamed):
            self._counters.count(m.topic, "unclear_which", len(unnamed) - len(found))
        return out + found

    def _associated(self, sightings: list[Sighting], where: Where) -> list[tuple[str, Sighting]]:
        seen = [self._position(s, where) for s in sightings]
        try:
            names, what = self._expected(where, seen)
        except GraphSlamError:  # the graph has no covariance now: the solve that failed is counted
            return []
        matches = association.associate(self._gates, seen, what, jointly=self._config.association == "joint")
        out = []
        for s, match in zip(sightings, matches, strict=True):
            if match.landmark == NEW:
                out.append((self._new_name(), self._widened(s, where, None)))
            elif match.landmark != UNCLEAR:
                out.append((names[match.landmark], self._widened(s, where, match.spread)))
        return out

    def _widened(self, s: Sighting, where: Where, spread: Array | None) -> Sighting:
        """With a covariance (n, n) in the keyframe's axes added."""
        added = self._config.unnamed_sigma_m**2 * np.eye(self._space.dimensions)
        spread = added if spread is None else spread + added
        space, size = self._space, len(s.measured)
        n, covariance = space.dimensions, np.array(s.covariance).reshape(size, size)
        axes = space.turn(where.T_keyframe_base).T
        if s.kind == "pose":
            axes = space.turn(s.measured).T @ axes
        elif s.kind == "range_bearing":
            to_sensor = space.turn(s.T_base_sensor or space.identity).T
            axes = carry.gradient(space, s.kind, carry.point_of(space, s.measured)) @ to_sensor @ axes
        covariance[:n, :n] += axes @ spread @ axes.T
        return replace(s, covariance=tuple(covariance.ravel().tolist()))

    def _extent(self) -> Array:
        """Covariance of where on a landmark, or among several close by, it is seen."""
        return (self._config.added_sigma_m**2 + self._config.unnamed_sigma_m**2) * np.eye(self._space.dimensions)

    def _new_name(self) -> str:
        self._begun += 1
        return f"unnamed{self._begun}"

    def _position(self, s: Sighting, where: Where) -> Carried:
        """Where it was seen, from the keyframe."""
        if s.kind != "range_bearing":
            at = carry.position(self._space, s, where)
        else:
            at = self._by_range_and_bearing(s, where)
        return Carried(at.measured, at.covariance + self._extent())

    def _by_range_and_bearing(self, s: Sighting, where: Where) -> Carried:
        space, T_base_sensor = self._space, s.T_base_sensor or self._space.identity
        point = carry.point_of(space, s.measured)
        n = space.dimensions
        to_base = space.turn(T_base_sensor) @ np.linalg.inv(carry.gradient(space, s.kind, point))
        own = to_base @ np.array(s.covariance).reshape(n, n) @ to_base.T
        at_base = tuple(map(float, space.group.act(T_base_sensor, tuple(point.tolist()))))
        seen = Sighting("", "position", at_base, tuple(own.ravel().tolist()))
        return carry.position(space, seen, where)

    def _expected(self, where: Where, seen: list[Carried]) -> tuple[list[str], association.Expected]:
        """Landmarks that may be seen here, and what they look like."""
        space, n = self._space, self._space.dimensions
        self._hand_over()
        names = list(self._landmarks.known)
        vertices = np.array([self._landmarks.known[name].vertex for name in names], dtype=np.int64)
        T_map_keyframe: Numbers = tuple(self._solver.estimate([where.vertex])[0].tolist())
        if len(names):
            (pose_covariance,) = self._solver.marginal([where.vertex])
            at = np.array([space.group.act(T_map_keyframe, z.measured[:n]) for z in seen])
            apart = np.linalg.norm(self._positions(vertices)[None] - at[:, None], axis=2).min(axis=0)
            lever = max(float(np.linalg.norm(z.measured[:n])) for z in seen)
            spread = [float(np.linalg.eigvalsh(z.covariance)[-1]) for z in seen]
            turned = lever**2 * float(np.linalg.eigvalsh(pose_covariance[n:, n:])[-1])
            moved = float(np.linalg.eigvalsh(pose_covariance[:n, :n])[-1])
            reach = _REACH_SIGMA * np.sqrt(max(spread) + turned + moved)
            near = [k for k in np.argsort(apart, kind="stable").tolist() if apart[k] < reach][:_MOST_CANDIDATES]
        else:
            near = []
        chosen = [int(vertices[k]) for k in near]
        joint = self._solver.joint_marginal([where.vertex, *chosen])
        values = [tuple(self._solver.estimate([v])[0].tolist()) for v in chosen]
        oldest_ns = where.stamp_ns - round(self._config.follow_s * 1e9)
        is_followed = [self._landmarks.known[names[k]].last_seen_ns >= oldest_ns for k in near]
        what = association.expected(space, T_map_keyframe, values, joint, np.array(is_followed, dtype=bool))
        return [names[k] for k in near], what

    def _positions(self, vertices: NDArray[np.int64]) -> Array:
        n = self._space.dimensions
        return np.array([self._solver.estimate([v])[0][:n] for v in vertices.tolist()]).reshape(-1, n)

    # -- afterwards ----------------------------------------------------------------------------------------------

    def review(self, now_ns: int) -> None:
        """Look at all landmarks again: part, merge, believe, give up."""
        self._part()
        for group in self._groups():
            self._merge(group)
        for name, landmark in list(self._landmarks.known.items()):
            if landmark.is_tentative:
                self._believe_or_give_up(name, landmark, now_ns)

    def _groups(self) -> list[list[str]]:
        """Landmarks that may be older ones: the tentative ones together, each of the others by itself."""
        known = self._landmarks.known
        young = [name for name, mark in known.items() if mark.is_tentative and mark.sightings > 1]
        others = [[name] for name, mark in known.items() if mark.seen and not mark.is_tentative]
        return ([young] if self._config.association == "joint" else [[name] for name in young]) + others

    def _merge(self, names: list[str]) -> None:
        """Merge those of a group of which it is clear which others they are."""
        names = [name for name in names if name in self._landmarks.known][-_MOST_AT_ONCE:]
        options = self._options(names)
        if not any(options.values()):
            return
        likely = self._likely_pairings(names, options)
        for name, other in likely[0].items():
            if all(name in pairs and self._are_close(pairs[name], other) for pairs in likely):
                self._counters.count("landmarks", "merged")
                first = len(self._landmarks.known[other].seen)
                self._mergers.append(Merger(other, name, first, self._landmarks.merge(other, name)))
                self._hand_over()

    def _options(self, names: list[str]) -> dict[str, list[str]]:
        """Believed landmarks that each may be: near enough by the covariance of both, never seen together with it."""
        known = self._landmarks.known
        older = [name for name, mark in known.items() if not mark.is_tentative]
        at = {name: self._positions(np.array([known[name].vertex]))[0] for name in {*names, *older}}
        out: dict[str, list[str]] = {}
        for name in names:
            mark = known[name]
            others = [o for o in older if self._may_be(name, o)]
            others.sort(key=lambda o: float(np.linalg.norm(at[o] - at[name])))
            out[name] = []
            for other in others[:_MOST_CANDIDATES]:
                apart, covariance = self._apart([(mark, known[other])])
                if association.pair_cost(apart, covariance)[0] < self._gates.other_chi2(len(apart)):
                    out[name].append(other)
        return out

    def _may_be(self, name: str, other: str) -> bool:
        a, b = self._landmarks.known[name], self._landmarks.known[other]
        is_later = a.is_tentative or (b.first_seen_ns, other) < (a.first_seen_ns, name)
        return name != other and is_later and (other, name) not in self._parted and not a.stamps & b.stamps

    def _likely_pairings(self, names: list[str], options: dict[str, list[str]]) -> list[dict[str, str]]:
        """The pairings, the best first, that cost at most ``margin`` more than it; none of them may be the best."""
        known = self._landmarks.known
        found: list[tuple[float, dict[str, str]]] = []

        def descend(depth: int, pairs: dict[str, str]) -> None:
            if len(found) > _MOST_TRIED:
                return
            if depth == len(names):
                found.append((self._cost(pairs), pairs))
                return
            descend(depth + 1, pairs)
            for other in options[names[depth]]:
                same = [name for name, o in pairs.items() if o == other]
                if not any(known[name].stamps & known[names[depth]].stamps for name in same):
                    descend(depth + 1, pairs | {names[depth]: other})

        descend(0, {})
        found = [(cost, pairs) for cost, pairs in found if np.isfinite(cost)]
        found.sort(key=lambda item: item[0])
        return [pairs for cost, pairs in found if cost <= found[0][0] + self._gates.margin]

    def _cost(self, pairs: dict[str, str]) -> float:
        """Of taking landmarks for others together, against all of them being new; infinite where they do not fit."""
        if not pairs:
            return 0.0
        known = self._landmarks.known
        apart, covariance = self._apart([(known[a], known[b]) for a, b in pairs.items()])
        statistic, cost = association.pair_cost(apart, covariance)
        return cost - len(pairs) * self._gates.new if statistic < self._gates.chi2(len(apart)) else np.inf

    def _are_close(self, a: str, b: str) -> bool:
        at = self._positions(np.array([self._landmarks.known[name].vertex for name in (a, b)]))
        return float(np.linalg.norm(at[1] - at[0])) <= self._gates.close_m

    def _apart(self, pairs: Sequence[tuple[Landmark, Landmark]]) -> tuple[Array, Array]:
        """Differences (k n,) of the positions of pairs in map, and their covariance together."""
        n = self._space.dimensions
        marks = list({id(mark): mark for pair in pairs for mark in pair}.values())
        joint = self._solver.joint_marginal([mark.vertex for mark in marks])
        first = dict(zip(map(id, marks), np.cumsum([0, *map(self._dof, marks)]).tolist(), strict=False))
        j, r = np.zeros((len(pairs) * n, len(joint))), np.zeros(len(pairs) * n)
        for k, (a, b) in enumerate(pairs):
            for mark, sign in ((a, 1.0), (b, -1.0)):
                j[k * n : (k + 1) * n, first[id(mark)] : first[id(mark)] + n] = sign * self._axes(mark)
                r[k * n : (k + 1) * n] += sign * self._positions(np.array([mark.vertex]))[0]
        return r, j @ joint @ j.T + np.kron(np.eye(len(pairs)), self._extent())

    def _dof(self, landmark: Landmark) -> int:
        return self._landmarks.kind_of(landmark).dof

    def _axes(self, landmark: Landmark) -> Array:
        """From the landmark's tangent space to the map's axes, of its position."""
        if self._landmarks.kind_of(landmark) is self._space.point:
            return np.eye(self._space.dimensions)
        return self._space.turn(tuple(self._solver.estimate([landmark.vertex])[0].tolist()))

    def _believe_or_give_up(self, name: str, landmark: Landmark, now_ns: int) -> None:
        """Believe a tentative landmark that is none of the others; give up what was not seen for long."""
        c = self._config
        for_long = landmark.last_seen_ns - landmark.first_seen_ns >= round(c.confirm_s * 1e9)
        if landmark.sightings >= c.confirm_sightings and for_long and not self._options([name])[name]:
            landmark.is_tentative = False
        elif now_ns - landmark.last_seen_ns > round(c.give_up_s * 1e9):
            self._landmarks.give_up(name)
            self._counters.count("landmarks", "given_up")

    def _part(self) -> None:
        """Take back a merger whose sightings do not fit."""
        for merger in list(self._mergers):
            landmark = self._landmarks.known.get(merger.kept)
            if landmark is None:
                self._mergers.remove(merger)
                continue
            edges = [record.edge for record in landmark.seen[merger.first : merger.first + merger.count]]
            fits, dof = self._landmarks.chi2_of(edges)
            if fits > chi2.ppf(1.0 - 1e-6, dof) and fits > 4.0 * dof:
                self._counters.count("landmarks", "parted")
                self._landmarks.part(merger.kept, merger.merged, merger.first, merger.count)
                self._hand_over()
                self._parted.add((merger.kept, merger.merged))
                self._mergers.remove(merger)
                return
