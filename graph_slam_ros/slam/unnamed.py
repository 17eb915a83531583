"""Landmarks whose sightings do not say which they are: begun, confirmed, merged, parted again, given up.

A landmark that nothing in the map fits is begun as a tentative one. It is in the graph at once - seen for a first time
it bends nothing - and is associated like any other, but it is given up unless it is seen again often enough for long
enough. Nothing is final: what was seen of each landmark is kept, so that two that turn out to be one are merged by
giving the sightings of one to the other, and are parted again where these do not fit; and one that moved is given up.
"""

from collections import deque
from collections.abc import Callable
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
        oldest_ns = where.stamp_ns - round(self._config.follow_s * 1e9)
        names = [name for name, mark in self._landmarks.known.items() if mark.last_seen_ns >= oldest_ns]
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
        return [names[k] for k in near], association.expected(space, T_map_keyframe, values, joint)

    def _positions(self, vertices: NDArray[np.int64]) -> Array:
        n = self._space.dimensions
        return np.array([self._solver.estimate([v])[0][:n] for v in vertices.tolist()]).reshape(-1, n)

    # -- afterwards ----------------------------------------------------------------------------------------------

    def review(self, now_ns: int) -> None:
        """Look at all landmarks again: confirm, give up, merge, part."""
        self._part()
        for name, landmark in list(self._landmarks.known.items()):
            if landmark.seen:
                self._settle(name, landmark, now_ns)

    def _settle(self, name: str, landmark: Landmark, now_ns: int) -> bool:
        """Merge a landmark into the one it is; believe a tentative one that is none of the others, or give it up.

        Returns whether the graph changed.
        """
        c = self._config
        costs = self._costs_as_others(name, landmark)
        if costs and costs[0][0] + self._gates.margin < self._gates.new:
            best, other = costs[0]
            rivals = [o for cost, o in costs[1:] if cost < best + self._gates.margin]
            if self._all_close([other, *rivals]):
                self._counters.count("landmarks", "merged")
                first = len(self._landmarks.known[other].seen)
                self._mergers.append(Merger(other, name, first, self._landmarks.merge(other, name)))
                return True
        if not landmark.is_tentative:
            return False
        for_long = landmark.last_seen_ns - landmark.first_seen_ns >= round(c.confirm_s * 1e9)
        if not costs and landmark.sightings >= c.confirm_sightings and for_long:
            landmark.is_tentative = False
        elif now_ns - landmark.last_seen_ns > round(c.give_up_s * 1e9):
            self._landmarks.give_up(name)
            self._counters.count("landmarks", "given_up")
            return True
        return False

    def _all_close(self, names: list[str]) -> bool:
        at = self._positions(np.array([self._landmarks.known[name].vertex for name in names]))
        return float(np.linalg.norm(at - at[0], axis=1).max()) <= self._gates.close_m

    def _costs_as_others(self, name: str, landmark: Landmark) -> list[tuple[float, str]]:
        """What it costs to take a landmark for each believed one nearby that was never seen together with it."""
        others = [(o, mark) for o, mark in self._landmarks.known.items() if o != name and not mark.is_tentative]
        if not others:
            return []
        at = self._positions(np.array([landmark.vertex, *(mark.vertex for _, mark in others)]))
        apart = at[1:] - at[0]
        out = []
        for k in np.argsort(np.linalg.norm(apart, axis=1), kind="stable")[:_MOST_CANDIDATES].tolist():
            other, mark = others[k]
            if (other, name) not in self._parted and not landmark.stamps & mark.stamps:
                statistic, cost = association.pair_cost(apart[k], self._apart(landmark, mark))
                if statistic < self._gates.other_chi2(len(at[0])):
                    out.append((cost, other))
        return sorted(out)

    def _apart(self, a: Landmark, b: Landmark) -> Array:
        """Covariance (n, n) of the difference of two landmarks' positions in map."""
        n, dof = self._space.dimensions, self._landmarks.kind_of(a).dof
        joint = self._solver.joint_marginal([a.vertex, b.vertex])
        j = np.zeros((n, len(joint)))
        j[:, :n], j[:, dof : dof + n] = self._axes(a), -self._axes(b)
        return j @ joint @ j.T + self._extent()

    def _axes(self, landmark: Landmark) -> Array:
        """From the landmark's tangent space to the map's axes, of its position."""
        if self._landmarks.kind_of(landmark) is self._space.point:
            return np.eye(self._space.dimensions)
        return self._space.turn(tuple(self._solver.estimate([landmark.vertex])[0].tolist()))

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
                self._parted.add((merger.kept, merger.merged))
                self._mergers.remove(merger)
                return
