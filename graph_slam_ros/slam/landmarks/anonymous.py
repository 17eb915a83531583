"""Landmarks whose sightings do not say which they are: begun, confirmed, merged, parted again, given up.

A landmark that nothing in the map fits is begun as a tentative one. It is in the graph at once - seen for a first time
it bends nothing - and is associated like any other, but it is given up unless it is seen again often enough for long
enough. Nothing is final: what was seen of each landmark is kept, so that two that turn out to be one are merged by
giving the sightings of one to the other, and are parted again where these do not fit; and one that moved is given up.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edge_noise import LEAST_M2
from graph_slam_ros.measurements.types import Sighting, Sightings
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.motion_compensation import KeyframeMeasurement, PoseAtStamp
from graph_slam_ros.slam.landmarks import association
from graph_slam_ros.slam.landmarks.association import NEW, UNCLEAR, Candidates, Gates
from graph_slam_ros.slam.landmarks.landmark_map import Landmark, Landmarks
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

_MOST_CANDIDATES = 24  # landmarks that one message is compared with: the nearest
_MOST_AT_ONCE = 8  # new landmarks whose pairings are weighed together: the latest
_MOST_OPTIONS = 12  # older ones that each may be: the nearest
_REACH_SIGMA = 5.0
NOT_IN_MAP = ""  # in place of a name, where the map is held and nothing in it fits
NAME = "unnamed"
"""What landmarks are called that have no name; a number follows."""
_POSITIONED = ("position", "pose", "range_bearing")


@dataclass(frozen=True, slots=True)
class LandmarkMerge:
    """Two landmarks that became one, and the sightings that changed hands, each by its stamp and itself."""

    kept: str
    merged: str
    seen: frozenset[tuple[int, Sighting]]


@dataclass(frozen=True, slots=True)
class MergeCandidate:
    """Pairs of a landmark and an older one: the differences of their positions (P n,), and their covariance."""

    pairs: list[tuple[str, str]]
    residual: Array
    covariance: Array

    def of(self, some: list[int]) -> "MergeCandidate":
        """Some of them."""
        n = len(self.residual) // max(len(self.pairs), 1)
        rows = (np.array(some, dtype=np.int64)[:, None] * n + np.arange(n)).ravel()
        return MergeCandidate([self.pairs[p] for p in some], self.residual[rows], self.covariance[rows[:, None], rows])


def last_number(names: Iterable[str]) -> int:
    """The highest that follows ``NAME``; 0 where there is none."""
    numbers = (name.removeprefix(NAME) for name in names)
    return max((int(number) for number in numbers if number.isdecimal()), default=0)


class AnonymousLandmarks:
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
        self._merges: deque[LandmarkMerge] = deque(maxlen=100)
        self._separated: set[tuple[str, str]] = set()

    def restore(self) -> None:
        """New names are other than those that there are."""
        self._begun = last_number(name for name, mark in self._landmarks.known.items() if mark.is_unnamed)

    def identified(self, m: Sightings, where: PoseAtStamp) -> list[tuple[str, Sighting]]:
        """The sightings of a message that can be used, each with an identity, or ``NOT_IN_MAP``; others are counted."""
        known = self._landmarks.known
        named = [(s.id, s) for s in m.sightings if s.id]
        out = [(name, s) for name, s in named if name not in known or not known[name].is_unnamed]
        if len(out) < len(named):  # whoever gives such names, an unnamed landmark cannot be taken back any more
            self._counters.count(m.topic, "id_of_an_unnamed", len(named) - len(out))
        unnamed = [s for s in m.sightings if not s.id and s.kind in _POSITIONED]
        if len(named) + len(unnamed) < len(m.sightings):
            self._counters.count(m.topic, "no_id", len(m.sightings) - len(named) - len(unnamed))
        found = self._associate(unnamed, where) if unnamed else []
        if len(found) < len(unnamed):
            self._counters.count(m.topic, "unclear_which", len(unnamed) - len(found))
        return out + found

    def _associate(self, sightings: list[Sighting], where: PoseAtStamp) -> list[tuple[str, Sighting]]:
        seen = [self._position(s, where) for s in sightings]
        try:
            names, what = self._expected(where, seen)
        except GraphSlamError:  # the graph has no covariance now: the solve that failed is counted
            return []
        matches = association.associate(self._gates, seen, what, jointly=self._config.association == "joint")
        out = []
        for s, match in zip(sightings, matches, strict=True):
            if match.landmark == NEW:
                name = self._new_name() if self._landmarks.begins_new else NOT_IN_MAP
                out.append((name, self._widened(s, where, None)))
            elif match.landmark != UNCLEAR:
                out.append((names[match.landmark], self._widened(s, where, match.spread)))
        return out

    def _widened(self, s: Sighting, where: PoseAtStamp, spread: Array | None) -> Sighting:
        """The sighting with a covariance (n, n) in the keyframe's axes added."""
        added = self._config.unnamed_sigma_m**2 * np.eye(self._space.dimensions)
        spread = added if spread is None else spread + added
        space = self._space
        n, covariance = space.dimensions, motion_compensation.as_matrix(s.covariance)
        axes: Array = space.turn(where.T_keyframe_base).T
        if s.kind == "pose":
            axes = space.turn(s.measured).T @ axes
        elif s.kind == "range_bearing":
            to_sensor = space.turn(s.T_base_sensor or space.identity).T
            point = motion_compensation.point_of(space, s.measured)
            axes = motion_compensation.gradient(space, s.kind, point) @ to_sensor @ axes
        covariance[:n, :n] += axes @ spread @ axes.T
        return replace(s, covariance=tuple(covariance.ravel().tolist()))

    def _extent(self) -> Array:
        """Covariance of where on a landmark, or among several close by, it is seen."""
        variance = self._config.added_sigma_m**2 + self._config.unnamed_sigma_m**2
        return max(variance, LEAST_M2) * np.eye(self._space.dimensions)

    def _new_name(self) -> str:
        self._begun += 1
        name = f"{NAME}{self._begun}"
        return name if name not in self._landmarks.known else self._new_name()

    def _position(self, s: Sighting, where: PoseAtStamp) -> KeyframeMeasurement:
        """Return where it was seen, from the keyframe."""
        if s.kind != "range_bearing":
            at = motion_compensation.position(self._space, s, where)
        else:
            at = self._by_range_and_bearing(s, where)
        rounding = motion_compensation.ROUNDING * float(np.trace(at.covariance)) * np.eye(self._space.dimensions)
        return KeyframeMeasurement(at.measured, at.covariance + self._extent() + rounding)

    def _by_range_and_bearing(self, s: Sighting, where: PoseAtStamp) -> KeyframeMeasurement:
        space, T_base_sensor = self._space, s.T_base_sensor or self._space.identity
        point = motion_compensation.point_of(space, s.measured)
        to_base = space.turn(T_base_sensor) @ motion_compensation.polar_derivative(space, s.measured)
        own = to_base @ motion_compensation.as_matrix(s.covariance) @ to_base.T
        at_base = tuple(map(float, space.group.act(T_base_sensor, tuple(point.tolist()))))
        seen = Sighting("", "position", at_base, tuple(own.ravel().tolist()))
        return motion_compensation.position(space, seen, where)

    def _expected(self, where: PoseAtStamp, seen: list[KeyframeMeasurement]) -> tuple[list[str], association.Expected]:
        """Landmarks that may be seen here, and what they look like."""
        space, n = self._space, self._space.dimensions
        self._hand_over()
        names = list(self._landmarks.known)
        vertices = np.array([self._landmarks.known[name].vertex for name in names], dtype=np.int64)
        T_map_keyframe: Numbers = tuple(self._solver.estimate([where.vertex])[0].tolist())
        if len(names):
            pose_covariance = self._solver.joint_marginal([where.vertex])
            at = np.array([space.group.act(T_map_keyframe, z.measured[:n]) for z in seen])
            distances = np.linalg.norm(self._positions(vertices)[None] - at[:, None], axis=2).min(axis=0)
            lever = max(float(np.linalg.norm(z.measured[:n])) for z in seen)
            spread = [float(np.linalg.eigvalsh(z.covariance)[-1]) for z in seen]
            turned = lever**2 * float(np.linalg.eigvalsh(pose_covariance[n:, n:])[-1])
            moved = float(np.linalg.eigvalsh(pose_covariance[:n, :n])[-1])
            reach = _REACH_SIGMA * np.sqrt(max(spread) + turned + moved)
            near = [k for k in np.argsort(distances, kind="stable").tolist() if distances[k] < reach][:_MOST_CANDIDATES]
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
        """Positions (k, n) of landmarks in map."""
        n = self._space.dimensions
        out = np.empty((len(vertices), n))
        is_point = np.array([self._landmarks.kind_of(v) is self._space.point for v in vertices.tolist()], dtype=bool)
        for some in (is_point, ~is_point):
            if some.any():
                out[some] = self._solver.estimate(vertices[some])[:, :n]
        return out

    # -- afterwards ----------------------------------------------------------------------------------------------

    def review(self, now_ns: int) -> None:
        """Review the landmarks: split, merge, confirm, prune."""
        self._split_wrong_merge()
        known = self._landmarks.known
        unnamed = [name for name, mark in known.items() if mark.is_unnamed]
        tentative = [name for name in unnamed if known[name].is_tentative and known[name].sightings > 1]
        if self._config.association == "joint":
            tentative = tentative[-_MOST_AT_ONCE:]
            self._merge(tentative, self._plausible(self._near(tentative)))
        else:
            for name in tentative:
                self._merge([name], self._plausible(self._near([name])))
        # of the others each by itself
        unnamed = [name for name in unnamed if name in known]
        plausible = self._plausible(self._near(unnamed))
        for name in unnamed:
            if name in known and not known[name].is_tentative:
                self._merge([name], plausible)
        for name in [name for name, mark in known.items() if mark.is_tentative]:
            self._confirm_or_prune(name, plausible, now_ns)

    def _merge(self, names: list[str], plausible: MergeCandidate) -> None:
        """Merge those of a group of which it is clear which others they are."""
        pairs, candidates = self._candidates(names, plausible)
        if not pairs:
            return
        likely = association.likely_pairings(self._gates, candidates)
        if likely is None:
            self._counters.count("landmarks", "undecided")
            return
        chosen = [{pairs[p][0]: pairs[p][1] for p in one} for one in likely]
        for name, other in chosen[0].items():
            if all(name in one and self._are_close(one[name], other) for one in chosen):
                self._merge_into(other, name)

    def _merge_into(self, kept: str, merged: str) -> None:
        self._counters.count("landmarks", "merged")
        seen = frozenset((one.where.stamp_ns, one.sighting) for one in self._landmarks.known[merged].seen)
        followed = (replace(m, kept=kept) if m.kept == merged else m for m in self._merges)
        self._merges = deque([*followed, LandmarkMerge(kept, merged, seen)], self._merges.maxlen)
        self._landmarks.merge(kept, merged)
        self._hand_over()

    def _plausible(self, pairs: list[tuple[str, str]]) -> MergeCandidate:
        """The pairs that fit, the likeliest first."""
        known, n = self._landmarks.known, self._space.dimensions
        if not pairs:
            return MergeCandidate([], np.empty(0), np.empty((0, 0)))
        r, covariance = self._position_differences([(known[a], known[b]) for a, b in pairs])
        fits = []
        for p in range(len(pairs)):
            own = slice(p * n, (p + 1) * n)
            statistic, cost = association.pair_cost(r[own], covariance[own, own])
            if statistic < self._gates.other_chi2(n):
                fits.append((cost, p))
        return MergeCandidate(pairs, r, covariance).of([p for _, p in sorted(fits)])

    def _candidates(self, names: list[str], plausible: MergeCandidate) -> tuple[list[tuple[str, str]], Candidates]:
        """Pairs of these with believed landmarks, as they are now."""
        known, wanted = self._landmarks.known, set(names)
        kept = []
        for p, (name, other) in enumerate(plausible.pairs):
            is_there = name in wanted and {name, other} <= known.keys()
            if is_there and not known[other].is_tentative and self._may_match(name, other):
                kept.append(p)
        some = plausible.of(kept)
        options = [[k for k, (name, _) in enumerate(some.pairs) if name == one] for one in names]
        excluded = np.array([[self._exclude_each_other(a, b) for b in some.pairs] for a in some.pairs], dtype=bool)
        return some.pairs, Candidates(options, some.residual, some.covariance, excluded)

    def _exclude_each_other(self, one: tuple[str, str], two: tuple[str, str]) -> bool:
        """Return whether two landmarks that were seen at once would be the same, or one would be two."""
        known = self._landmarks.known
        if one[0] == two[0]:
            return True
        return one[1] == two[1] and not known[one[0]].stamps.isdisjoint(known[two[0]].stamps)

    def _near(self, names: list[str]) -> list[tuple[str, str]]:
        """Pairs of each with those that it may be, by an upper bound of their covariance; of many the nearest."""
        known = self._landmarks.known
        older = [name for name, mark in known.items() if not mark.is_tentative or self._is_sure(mark)]
        if not older or not names:
            return []
        everyone = {name: k for k, name in enumerate(dict.fromkeys([*names, *older]))}
        vertices = np.array([known[name].vertex for name in everyone], dtype=np.int64)
        n = self._space.dimensions
        sigma = np.sqrt([np.trace(c[:n, :n]) for c in self._solver.marginal(vertices)])
        at = self._positions(vertices)
        is_older, extent = [everyone[o] for o in older], float(np.trace(self._extent()))
        out: list[tuple[str, str]] = []
        for name in names:
            k = everyone[name]
            distances = np.sum((at[is_older] - at[k]) ** 2, axis=1)
            reach = self._gates.other_chi2(n) * ((sigma[is_older] + sigma[k]) ** 2 + extent)
            nearest = [older[j] for j in np.argsort(distances, kind="stable").tolist() if distances[j] < reach[j]]
            out += [(name, other) for other in nearest if self._may_match(name, other)][:_MOST_OPTIONS]
        return out

    def _may_match(self, name: str, other: str) -> bool:
        a, b = self._landmarks.known[name], self._landmarks.known[other]
        if self._solver.is_held(a.vertex):
            return False
        is_later = a.is_tentative or (b.first_seen_ns, other) < (a.first_seen_ns, name)
        return name != other and is_later and (other, name) not in self._separated and a.stamps.isdisjoint(b.stamps)

    def _are_close(self, a: str, b: str) -> bool:
        at = self._positions(np.array([self._landmarks.known[name].vertex for name in (a, b)]))
        return float(np.linalg.norm(at[1] - at[0])) <= self._gates.close_m

    def _position_differences(self, pairs: Sequence[tuple[Landmark, Landmark]]) -> tuple[Array, Array]:
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
        return r, association.of_sums(j, joint) + np.kron(np.eye(len(pairs)), self._extent())

    def _dof(self, landmark: Landmark) -> int:
        return self._landmarks.kind_of(landmark.vertex).dof

    def _axes(self, landmark: Landmark) -> Array:
        """The rotation from the landmark's tangent space to the map's axes, of its position."""
        if self._landmarks.kind_of(landmark.vertex) is self._space.point:
            return np.eye(self._space.dimensions)
        return self._space.turn(tuple(self._solver.estimate([landmark.vertex])[0].tolist()))

    def _is_sure(self, landmark: Landmark) -> bool:
        """Return whether it was seen often enough, for long enough."""
        c = self._config
        for_long = landmark.last_seen_ns - landmark.first_seen_ns >= round(c.confirm_s * 1e9)
        return landmark.sightings >= c.confirm_sightings and for_long

    def _confirm_or_prune(self, name: str, plausible: MergeCandidate, now_ns: int) -> None:
        """Confirm a tentative landmark that is none of the others; prune what was not seen for long."""
        landmark = self._landmarks.known[name]
        if self._is_sure(landmark) and not self._candidates([name], plausible)[0]:
            self._landmarks.confirm(name)
        elif now_ns - landmark.last_seen_ns > round(self._config.give_up_s * 1e9):
            self._landmarks.prune(name)
            self._counters.count("landmarks", "given_up")

    def _split_wrong_merge(self) -> None:
        """Take back a merge whose sightings do not fit."""
        for merge in list(self._merges):
            landmark = self._landmarks.known.get(merge.kept)
            moved = (
                [one for one in landmark.seen if (one.where.stamp_ns, one.sighting) in merge.seen] if landmark else []
            )
            if not moved:
                self._merges.remove(merge)
                continue
            fits, dof = self._landmarks.chi2_of([one.edge for one in moved])
            if fits > association.quantile(1.0 - 1e-6, dof) and fits > 4.0 * dof:
                self._counters.count("landmarks", "parted")
                self._landmarks.split(merge.kept, merge.merged, moved)
                self._hand_over()
                self._separated.add((merge.kept, merge.merged))
                self._merges.remove(merge)
                return
