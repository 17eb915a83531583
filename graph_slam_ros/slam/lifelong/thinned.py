"""A visit that is in no place: a few of its keyframes stay, and all others are known relative to one that stays.

A keyframe that goes has a *centre*: the vertex that its least noisy edge leads to, which is odometry from the keyframe
before, or a closure. Its other edges begin at the centre from now on, and have the noise of both. So has the odometry
to the keyframe after it. The edge to the centre is in each of these with an equal share of its information, so nothing
counts twice (a star instead of the clique that exact marginalisation makes; Carlevaris-Bianco, Kaess and Eustice,
"Generic node removal for factor-graph SLAM", 2014).
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graph_slam_ros.graph import Edge
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.carried import Carried, fused_motion, inverse, inverted
from graph_slam_ros.slam.lifelong.elimination import square_root, symmetric
from graph_slam_ros.slam.lifelong.surroundings import CHAIN, CLOSURES, Motion, Surroundings, chained, motion_of
from graph_slam_ros.typing import Array

_HELD = 1e-3  # of the information of a composed closure: so much holds the path where the closure is doubted
_COUNTS = 1e-9  # factor of a closure below which it says nothing


@dataclass(frozen=True, slots=True)
class Arm:
    """An edge of a keyframe: the vertex at its other end, and the motion from there to the keyframe.

    Attributes
    ----------
    source : of the closure that is in it; None where it is of odometry alone
    """

    vertex: int
    motion: Motion
    source: str | None = None


@dataclass(slots=True)
class Thinned:
    """The end of a visit.

    Attributes
    ----------
    centres : of each keyframe, the vertex that it is known relative to, and the covariance of the motion from there;
        one that stays is its own
    added : edges in place of others
    stay : ids of closures and fixes that stay as they are
    fixes : of each centre, the ids of the fixes that are carried to it
    shares : of each keyframe with such a fix, the covariance of its motion that the fix has
    """

    centres: dict[int, tuple[int, Array]] = field(default_factory=dict)
    added: list[Carried] = field(default_factory=list)
    stay: set[int] = field(default_factory=set)
    fixes: dict[int, list[int]] = field(default_factory=dict)
    shares: dict[int, Array] = field(default_factory=dict)


class Thinning:
    """Thins one visit.

    Parameters
    ----------
    visit : its vertices, in order of time; after : the keyframe that follows
    is_kept : whether a keyframe stays
    arm_m : length by which rotations are compared with distances
    gate : quantile of chi2 above which two edges to one vertex do not agree
    """

    def __init__(
        self,
        space: Geometry,
        visit: Sequence[int],
        after: int,
        around: Surroundings,
        is_kept: Callable[[int], bool],
        arm_m: float,
        gate: float,
    ) -> None:
        self._space, self._visit, self._after, self._around = space, visit, after, around
        self._is_kept, self._arm_m, self._gate = is_kept, arm_m, gate
        self._legs = [motion_of(edge) for edge in (*around.steps, *around.onward.values())]
        self._at = {vertex: k for k, vertex in enumerate(visit)}
        self._closures = self._closures_by_keyframe()
        self._fixes: dict[int, list[int]] = {}
        for number, edge in around.fixes.items():
            self._fixes.setdefault(edge.vertices[0], []).append(number)
        inside = (edge for edge in around.inside.values() if edge.label == CLOSURES)
        self._begins = Counter(min(edge.vertices, key=self._at.__getitem__) for edge in inside)
        self._centres: dict[int, Arm] = {}  # of each keyframe so far, with the share of what begins at it
        self.out = Thinned()

    def run(self) -> Thinned:
        """Return what becomes of the visit."""
        link = [Arm(edge.vertices[0], motion_of(edge)) for edge in self._around.into.values()]
        unjoined: list[int] = []  # keyframes that nothing joins to what was before
        for k, vertex in enumerate(self._visit):
            arms = self._merged([*link, *self._carried(vertex)])
            now = self._thin(vertex, arms)
            if now is None:
                unjoined.append(vertex)
                continue
            for one in unjoined:
                way = inverse(self._space, chained(self._space, self._legs[self._at[one] : k]))
                self._join(one, replace(now, motion=chained(self._space, [self._centres[vertex].motion, way])))
            unjoined, link = [], [replace(now, motion=chained(self._space, [now.motion, self._legs[k]]))]
        for arm in link:
            self._lead(arm, self._after)
        nothing = self._space.identity, np.zeros((self._space.dof, self._space.dof))
        for one in unjoined:
            way = inverse(self._space, chained(self._space, [nothing, *self._legs[self._at[one] :]]))
            self._join(one, Arm(self._after, way))
        return self.out

    def _closures_by_keyframe(self) -> dict[int, list[tuple[int, Arm]]]:
        """Return the closures of each keyframe, with their ids; those within the visit are of the later one."""
        out: dict[int, list[tuple[int, Arm]]] = {}
        for number, edge in self._around.closures_and_fixes.items():
            if edge.label != CLOSURES:
                continue
            first, last = edge.vertices
            motion = _scaled(edge, self._around.factors[number])
            if motion is None:
                continue
            later = max((v for v in (first, last) if v in self._at), key=self._at.__getitem__)
            other = first if later == last else last
            way = motion if later == last else inverse(self._space, motion)
            out.setdefault(later, []).append((number, Arm(other, way, edge.source)))
        return out

    def _carried(self, vertex: int) -> list[Arm]:
        """Return the closures of a keyframe, from the centres of those within the visit that have gone."""
        out = []
        for _, arm in self._closures.get(vertex, ()):
            centre = self._centres.get(arm.vertex)
            if centre is not None:
                arm = replace(arm, vertex=centre.vertex, motion=chained(self._space, [centre.motion, arm.motion]))
            out.append(arm)
        return out

    def _thin(self, vertex: int, arms: Sequence[Arm]) -> Arm | None:
        """Decide what becomes of a keyframe, and of its edges; returns how the next one is joined.

        None where nothing joins it to what was before, and nothing was measured there.
        """
        fixes = self._fixes.get(vertex, [])
        nothing = self._space.identity, np.zeros((self._space.dof, self._space.dof))
        old = [arm for arm in arms if arm.vertex < self._after]
        if self._is_kept(vertex) or (not old and (arms or fixes or vertex in self._begins)):
            self._stay(vertex, arms, fixes)
            return self._join(vertex, Arm(vertex, nothing))
        if not old:
            return None
        centre = min(old, key=lambda arm: self._size(arm.motion[1]))
        others = [arm for arm in arms if arm is not centre]
        uses = len(others) + 1 + bool(fixes) + self._begins[vertex]
        share = centre.motion[0], uses * centre.motion[1]
        for arm in others:
            if arm.vertex != centre.vertex:
                way = chained(self._space, [share, inverse(self._space, arm.motion)])
                self._add(centre.vertex, arm.vertex, way, centre.source if arm.source is None else arm.source)
        if fixes:
            self.out.fixes.setdefault(centre.vertex, []).extend(fixes)
            self.out.shares[vertex] = share[1]
        self._join(vertex, centre)
        self._centres[vertex] = replace(centre, motion=share)
        return self._centres[vertex]

    def _stay(self, vertex: int, arms: Sequence[Arm], fixes: Sequence[int]) -> None:
        """Keep a keyframe, with its fixes and with closures of which the other end stays as well."""
        self.out.stay.update(fixes)
        kept = set[int]()
        for number, arm in self._closures.get(vertex, ()):
            is_in = arm.vertex in self._at
            if not is_in or self._centres[arm.vertex].vertex == arm.vertex:
                self.out.stay.add(number)
                kept.add(arm.vertex)
        for arm in arms:
            if arm.vertex not in kept:
                self._lead(arm, vertex)

    def _join(self, vertex: int, centre: Arm) -> Arm:
        self._centres[vertex] = centre
        self.out.centres[vertex] = centre.vertex, centre.motion[1]
        return centre

    def _lead(self, arm: Arm, vertex: int) -> None:
        """Add an edge to a vertex that stays. If it has a closure in it, it may be doubted: a part holds the path."""
        pose, covariance = arm.motion
        if arm.source is not None:
            self._add(arm.vertex, vertex, (pose, covariance / (1.0 - _HELD)), arm.source)
            covariance = covariance / _HELD
        self._add(arm.vertex, vertex, (pose, covariance), None)

    def _add(self, first: int, last: int, motion: Motion, source: str | None) -> None:
        label = CHAIN if source is None else CLOSURES
        pose, covariance = motion
        root = square_root(symmetric(inverted(covariance)))
        self.out.added.append(Carried((first, last), self._space.normalized(pose), root, label, source or ""))

    def _merged(self, arms: Sequence[Arm]) -> list[Arm]:
        """Return edges of a keyframe, with those to one vertex that agree as one."""
        out: dict[int, Arm] = {}
        apart = list[Arm]()
        for arm in arms:
            before = out.get(arm.vertex)
            if before is None:
                out[arm.vertex] = arm
            elif (both := fused_motion(self._space, before.motion, arm.motion, self._gate)) is None:
                apart.append(arm)
            else:
                out[arm.vertex] = Arm(arm.vertex, both, arm.source if before.source is None else before.source)
        return [*out.values(), *apart]

    def _size(self, covariance: Array) -> float:
        n = self._space.dimensions
        return float(np.trace(covariance[:n, :n]) + self._arm_m**2 * np.trace(covariance[n:, n:]))


def _scaled(edge: Edge, factor: float) -> Motion | None:
    """Return what a closure measured, with its information times a factor; None where that is nearly nothing."""
    return motion_of(edge, factor) if factor > _COUNTS else None
