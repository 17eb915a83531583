"""Condensing: the keyframes of a visit leave the problem, and an edge of the place has what they measured."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.carried import (
    Carried,
    carried_closure,
    carried_fixes,
    fused_closure,
    motions_from,
)
from graph_slam_ros.slam.lifelong.compaction import Renumbered
from graph_slam_ros.slam.lifelong.elimination import square_root
from graph_slam_ros.slam.lifelong.fit import VisitScale, fit_of
from graph_slam_ros.slam.lifelong.place import Fused, Place
from graph_slam_ros.slam.lifelong.place_edge import PlaceEdge, added_place
from graph_slam_ros.slam.lifelong.surroundings import CLOSURES, Motion, Surroundings, chained, motion_of, surroundings
from graph_slam_ros.slam.lifelong.visit import Visit, best_known, visit_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Numbers

Cell = tuple[int, ...]
CHAIN = "composed"  # label of edges that are composed of odometry
_AHEAD = 3  # landmarks of places that the keyframes after a visit must see before odometry to it is cut
_ITSELF, _PLACE = "it contradicts itself", "it contradicts its place"
_SHARE = 0.5  # of the odometry of a first visit that is in its place; the rest joins the place to what is around it


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the size of places, and of what is believed.

    Attributes
    ----------
    members : landmarks of one place, at most; places : of one cell, at most
    closures : between the same two bases, at most: those that agree are one
    gate : quantile of chi2 above which a visit contradicts itself or its place
    """

    members: int = 48
    places: int = 8
    closures: int = 4
    gate: float = 0.9999


@dataclass(frozen=True, slots=True)
class RemovedPose:
    """A removed keyframe relative to another vertex, which may be removed later."""

    vertex: int
    base: int
    T_base_vertex: Numbers


@dataclass(frozen=True, slots=True)
class Condensed:
    """The end of one visit.

    Attributes
    ----------
    how : ``first`` (of a place), ``again`` (added to a place), ``composed`` (odometry is kept, with the keyframes that
        have closures or fixes; sightings, if any, contradicted something and are lost), ``waits`` (until the keyframes
        after it see enough places), ``kept`` (it cannot be condensed)
    why : of ``composed`` and ``kept``
    statistic, degrees : chi2 of the visit against all before in its place
    without, anew : the landmark that contradicts the place and was left out, or that the place has anew
    wider : factor of the variances of the visit, without which it contradicts its place
    removed : the keyframes that left the problem, in order of time
    seen : (keyframe, landmark) of each sighting that is in the place now
    """

    how: str
    why: str = ""
    statistic: float = 0.0
    degrees: int = 0
    without: int | None = None
    anew: int | None = None
    wider: float = 1.0
    removed: tuple[RemovedPose, ...] = ()
    seen: tuple[tuple[int, int], ...] = ()

    @property
    def is_contradiction(self) -> bool:
        """Return whether the visit contradicts itself or its place."""
        return self.why in (_ITSELF, _PLACE)


class Condenser:
    """Condenses visits in a graph and its solver, in order of time. The caller updates the solver after each.

    Attributes
    ----------
    places : by cell
    scale : of the variances of visits
    """

    def __init__(self, space: Geometry, solver: Solver, limits: Limits | None = None) -> None:
        self.space, self.solver, self.limits = space, solver, limits or Limits()
        self.places: dict[Cell, list[PlaceEdge]] = {}
        self.scale = VisitScale()

    def condense(
        self, visit: Sequence[int], after: int, cell: Cell, ahead: Collection[int], *, waits: bool = True
    ) -> Condensed:
        """Condense a visit. Where ``waits`` or ``kept`` is returned nothing was changed.

        Parameters
        ----------
        visit : vertices of its keyframes, in order of time; after : the keyframe that follows
        ahead : landmarks that the keyframes after the visit see
        waits : whether it may wait until these see enough places; if not, it begins a place instead, if it can
        """
        around = surroundings(self.space, self.solver, visit, after)
        if around.unfit:
            return Condensed("kept", around.unfit)
        in_cell = self.places.get(cell, [])
        seen = {edge.vertices[1] for edge in around.sightings.values()}
        best = max(in_cell, key=lambda one: len(seen & set(one.place.members)), default=None)
        fits = best is not None and len(seen | set(best.place.members)) <= self.limits.members
        is_again = fits and best is not None and self._lay(seen & set(best.place.members))
        has_room = len(in_cell) < self.limits.places and self._lay(seen)
        if is_again and len(self._known() & set(ahead)) < _AHEAD:
            if waits or not has_room:
                return Condensed("waits")
            is_again = False
        if not (is_again or has_room):
            return self._without_place(visit, after, around, "it sees too few landmarks, or the cell is full")
        try:
            factors, at = around.local if is_again else around.local | _halved(around), len(visit) // 2
            if not is_again:
                at = best_known(self.space, self.solver.graph, self.solver.estimate, visit, factors)
            one = visit_of(self.space, self.solver.graph, self.solver.estimate, visit, visit[at], factors)
            if one.degrees > 0 and one.chi2 > quantile(self.limits.gate, one.degrees):
                return self._composed(visit, after, around, _ITSELF)
            one = replace(one, information=one.information / self.scale.factor)
            if is_again and best is not None:
                return self._again(visit, after, around, one, best)
            return self._first(visit, at, after, around, one, cell)
        except SingularError as error:
            return self._without_place(visit, after, around, str(error))

    def renumber(self, new: Renumbered) -> None:
        """Take over new ids after a compaction."""
        for one in (one for in_cell in self.places.values() for one in in_cell):
            one.base, one.edge = int(new.vertices[one.base]), int(new.edges[one.edge])
            one.place = replace(one.place, members=tuple(new.vertices[list(one.place.members)].tolist()))
            strikes = {int(new.vertices[mark]): count for mark, count in one.strikes.items()}
            one.strikes = {mark: count for mark, count in strikes.items() if mark >= 0}

    def rescale(self) -> None:
        """Scale all places, where visits so far say that their variances are larger or smaller."""
        by = self.scale.change()
        for one in (one for in_cell in self.places.values() for one in in_cell if by != 1.0):
            place = replace(one.place, information=one.place.information / by)
            now = added_place(self.space, self.solver.graph, one.base, place, square_root(place.information))
            self.solver.add([], [now.edge])
            self.solver.set_weight(one.edge, 0.0)
            one.place, one.edge = now.place, now.edge

    # -- what becomes of a visit -------------------------------------------------------------------------------------

    def _first(
        self, visit: Sequence[int], at: int, after: int, around: Surroundings, one: Visit, cell: Cell
    ) -> Condensed:
        """Begin a place: a part of the odometry is in its edge, the rest joins its base to what is around it."""
        base = visit[at]
        if lonely := self._left_alone(around, one.members):
            return Condensed("kept", f"landmark {lonely[0]} would be left without a measurement")
        root = square_root(one.information)
        added, also = self._joined(visit, at, after, around, 1.0 - _SHARE)
        begun = added_place(self.space, self.solver.graph, base, Place.begun_by(one), root)
        self.places.setdefault(cell, []).append(begun)
        removed = self._replace(dict.fromkeys(visit, base), [*around.all, *also], [*added, begun.edge])
        return Condensed("first", removed=removed, seen=_seen(around, one.members))

    def _joined(
        self, visit: Sequence[int], k: int, after: int, around: Surroundings, share: float
    ) -> tuple[list[int], list[int]]:
        """Join keyframe ``k`` of the visit to what is around it, and carry closures and fixes to it.

        Parameters
        ----------
        share : part of the odometry inside the visit that joins it

        Returns
        -------
        The new edges, and those that they replace.
        """
        legs = [motion_of(edge, share * around.factors[edge.id]) for edge in around.steps]
        carried = self._carried(visit, around, visit[k], [], [motion_of(edge) for edge in around.steps])
        onward = [motion_of(edge) for edge in around.onward.values()]
        joins = [(edge.vertices[0], visit[k], [motion_of(edge), *legs[:k]]) for edge in around.into.values()]
        added = self._join([*joins, (visit[k], after, [*legs[k:], *onward])])
        more, also = self._add_carried(carried)
        return [*added, *more], also

    def _again(self, visit: Sequence[int], after: int, around: Surroundings, one: Visit, at: PlaceEdge) -> Condensed:
        """Add a visit to a place, and cut the odometry on both sides of it."""
        k = len(visit) // 2
        base, mine = self.solver.estimate([at.base, visit[k]]).tolist()
        guess = tuple(map(float, self.space.group.between(tuple(base), tuple(mine))))
        fit = fit_of(self.space, at.place, one, guess, self.limits.gate, at.strikes)
        if fit.result is not None and (lonely := self._left_alone(around, fit.result.place.members)):
            return Condensed("kept", f"landmark {lonely[0]} would be left without a measurement")
        self.scale.add(fit.as_is, self.limits.gate)
        if (result := fit.result) is None:
            return self._composed(visit, after, around, _PLACE, fit.as_is)
        legs = [motion_of(edge) for edge in around.steps]
        carried = self._carried(visit, around, at.base, [(guess, result.covariance)], legs)
        now = added_place(self.space, self.solver.graph, at.base, result.place, square_root(result.place.information))
        added, also = self._add_carried(carried)
        bases = dict.fromkeys(visit, at.base)
        removed = self._replace(bases, [*around.all, at.edge, *also], [now.edge, *added])
        if fit.anew is not None:
            at.strikes.pop(fit.anew, None)
        elif fit.without is not None:
            at.strikes[fit.without] = at.strikes.get(fit.without, 0) + 1
        else:
            at.strikes = {mark: count for mark, count in at.strikes.items() if mark not in one.members}
        at.place, at.edge = now.place, now.edge
        seen, (chi2, degrees) = _seen(around, fit.visit.members), (fit.as_is.statistic, fit.as_is.degrees)
        return Condensed("again", "", chi2, degrees, fit.without, fit.anew, fit.wider, removed, seen)

    def _without_place(self, visit: Sequence[int], after: int, around: Surroundings, why: str) -> Condensed:
        """Keep a visit that cannot be in a place if it sees a landmark, else its odometry alone: nothing is lost."""
        return Condensed("kept", why) if around.sightings else self._composed(visit, after, around, why)

    def _composed(
        self, visit: Sequence[int], after: int, around: Surroundings, why: str, done: Fused | None = None
    ) -> Condensed:
        """Compose the odometry between keyframes with closures or fixes, which stay; sightings are lost."""
        held = around.closures_and_fixes
        ends = {vertex for edge in held.values() for vertex in edge.vertices}
        stops = [k for k, vertex in enumerate(visit) if vertex in ends]
        if len(stops) == len(visit):
            return Condensed("kept", f"{why}; all of its keyframes have closures or fixes")
        if lonely := self._left_alone(around, ()):
            return Condensed("kept", f"{why}; landmark {lonely[0]} would be left without a measurement")
        legs, way = [motion_of(edge) for edge in (*around.steps, *around.onward.values())], [*visit, after]
        first = stops[0] if stops else len(visit)
        joins = [(edge.vertices[0], way[first], [motion_of(edge), *legs[:first]]) for edge in around.into.values()]
        joins += [(way[k], way[end], legs[k:end]) for k, end in pairwise([*stops, len(visit)])]
        before = [max((stop for stop in stops if stop <= k), default=first) for k in range(len(visit))]
        bases = {vertex: way[stop] for vertex, stop in zip(visit, before, strict=True)}
        edges = [edge for edge in around.all if edge not in held]
        removed = self._replace(bases, edges, self._join(joins))
        statistic, degrees = (done.statistic, done.degrees) if done else (0.0, 0)
        return Condensed("composed", why, statistic, degrees, removed=removed)

    # -- edits of the graph ------------------------------------------------------------------------------------------

    def _carried(
        self, visit: Sequence[int], around: Surroundings, base: int, to_visit: Sequence[Motion], legs: Sequence[Motion]
    ) -> list[Carried]:
        """Return the closures and fixes of a visit as edges of a base, and odometry from a keyframe that has no place.

        Parameters
        ----------
        to_visit : the motion from the base to the middle keyframe, where that is another one
        legs : odometry from each keyframe but the last to the next
        """
        bases = {one.base for in_cell in self.places.values() for one in in_cell}
        from_kept = [edge for edge in around.into.values() if to_visit and edge.vertices[0] not in bases]
        if not (around.closures or around.fixes or from_kept):
            return []
        space, out = self.space, list[Carried]()
        begin, *poses = self.solver.estimate([base, *visit]).tolist()
        by_odometry, motions = motions_from(space, visit, legs), dict[int, Motion]()
        for vertex, pose in zip(visit, poses, strict=True):
            _, covariance = chained(space, [*to_visit, by_odometry[vertex]])
            motions[vertex] = tuple(map(float, space.group.between(tuple(begin), tuple(pose)))), covariance
        out += [replace(carried_closure(space, edge, base, motions, edge.weight), label=CHAIN) for edge in from_kept]
        for number, edge in around.closures.items():
            one = carried_closure(space, edge, base, motions, around.factors[number])
            if len(set(one.vertices)) > 1:  # else the place knows it
                out.append(one)
        if around.fixes:
            on_it = [self.solver.graph.edge(int(edge)) for edge in self.solver.edges_on(base)]
            prior = next((one for one in on_it if one.weight and one.label == CHAIN and len(one.vertices) == 1), None)
            out.append(carried_fixes(space, self.solver, base, around.fixes, around.factors, motions, prior))
        return out

    def _add_carried(self, carried: Sequence[Carried]) -> tuple[list[int], list[int]]:
        """Add closures and fixes of a base; returns the new edges and those that they replace."""
        graph, space, added, replaced = self.solver.graph, self.space, list[int](), set[int]()
        for one in carried:
            edge_type, label, fusion = space.pose_prior, CHAIN, one
            if len(one.vertices) == 2:
                on_it = {*map(int, self.solver.edges_on(one.vertices[0])), *added} - replaced
                edge_type, label = space.relative_pose, one.label
                others = [edge for edge in map(graph.edge, sorted(on_it)) if edge.label == CLOSURES and edge.weight]
                others = [edge for edge in others if set(edge.vertices) == set(one.vertices)]
                found = fused_closure(space, one, others, self.limits.gate) if label == CLOSURES else None
                if found is None and label == CLOSURES and len(others) >= self.limits.closures:
                    continue
                fusion = found or one
            noise, ends = Gaussian(fusion.root), list(fusion.vertices)
            added.append(graph.add_edge(edge_type, ends, fusion.measured, noise, label, fusion.source))
            replaced |= set() if fusion.replaces is None else {fusion.replaces}
        graph.set_weights(np.array(sorted(replaced & set(added)), dtype=np.int64), 0.0)
        return [edge for edge in added if edge not in replaced], sorted(replaced - set(added))

    def _lay(self, marks: Collection[int]) -> bool:
        """Return whether landmarks say how a constellation lies: one that is a pose does, or two or three points."""
        is_pose = any(self.solver.graph.kind_of(mark) is self.space.pose for mark in marks)
        return is_pose or len(marks) >= self.space.dimensions

    def _known(self) -> set[int]:
        return {mark for in_cell in self.places.values() for one in in_cell for mark in one.place.members}

    def _left_alone(self, around: Surroundings, members: Collection[int]) -> list[int]:
        """Return the landmarks of a visit that would have no edge without it and are not among the members."""
        seen = {edge.vertices[1] for edge in around.sightings.values()} - set(members) - self._known()
        graph, out = self.solver.graph, []
        for mark in sorted(seen):
            others = (int(edge) for edge in self.solver.edges_on(mark) if int(edge) not in around.sightings)
            if not any(graph.edge(edge).weight for edge in others):
                out.append(mark)
        return out

    def _join(self, joins: Sequence[tuple[int, int, Sequence[Motion]]]) -> list[int]:
        """Add edges of odometry, each of several motions."""
        out = []
        for first, last, motions in joins:
            pose, covariance = chained(self.space, motions)
            noise = Gaussian.from_covariance(covariance)
            edge = self.solver.graph.add_edge(self.space.relative_pose, [first, last], pose, noise, CHAIN)
            out.append(edge)
        return out

    def _replace(self, bases: Mapping[int, int], edges: Sequence[int], added: Sequence[int]) -> tuple[RemovedPose, ...]:
        """Put edges in place of others, and remove keyframes.

        Parameters
        ----------
        bases : of each keyframe of a visit, in order of time, the vertex relative to which it is known from now on; one
            that is its own base stays
        """
        gone = {vertex: base for vertex, base in bases.items() if vertex != base}
        group, out = self.space.group, list[RemovedPose]()
        seen_from, poses = self.solver.estimate(list(gone.values())).tolist(), self.solver.estimate(list(gone)).tolist()
        for (vertex, base), begin, pose in zip(gone.items(), seen_from, poses, strict=True):
            out.append(RemovedPose(vertex, base, tuple(map(float, group.between(tuple(begin), tuple(pose))))))
        self.solver.add([], added)
        for edge in edges:
            self.solver.set_weight(edge, 0.0)
        for vertex in gone:
            self.solver.remove(vertex)
        return tuple(out)


def poses_of(space: Geometry, removed: Sequence[RemovedPose], kept: Mapping[int, Numbers]) -> dict[int, Numbers]:
    """Return the present poses of keyframes, removed ones included.

    Parameters
    ----------
    removed : in the order of their removal; kept : the present poses of all others that are a base
    """
    out = dict(kept)
    for one in reversed(removed):
        out[one.vertex] = tuple(map(float, space.group.compose(out[one.base], one.T_base_vertex)))
    return out


def _halved(around: Surroundings) -> dict[int, float]:
    """Return the factors of the odometry inside a visit, half of which joins the place to what is around it."""
    steps = {edge.id for edge in around.steps}
    return {number: _SHARE * around.factors[number] for number in steps}


def _seen(around: Surroundings, members: Collection[int]) -> tuple[tuple[int, int], ...]:
    """Return keyframe and landmark of the sightings of some landmarks."""
    ends = ((edge.vertices[0], edge.vertices[1]) for edge in around.sightings.values())
    return tuple(dict.fromkeys(both for both in ends if both[1] in members))
