"""Condensing: the keyframes of a visit leave the problem, and an edge of the place has what they measured."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Edge, Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.slam.levels import ENOUGH, GATE
from graph_slam_ros.slam.lifelong.elimination import square_root, symmetric
from graph_slam_ros.slam.lifelong.place import Cell, Place, PlaceEdge, added_place, fit_of
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.lifelong.visit import best_known, visit_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index, Numbers

CLOSURES, FIXES, LANDMARKS = "closures", "fixes", "landmarks"  # labels
CHAIN = "composed"  # label of edges that are composed of odometry
ITSELF, PLACE = "it contradicts itself", "it contradicts its place"
"""Why the sightings of a visit are lost."""
_MOST_MEMBERS, _MOST_PLACES = 48, 8  # landmarks of one place; places of one cell


@dataclass(frozen=True, slots=True)
class RemovedPose:
    """A removed keyframe relative to its base, a vertex that stays."""

    vertex: int
    base: int
    T_base_vertex: Numbers


@dataclass(frozen=True, slots=True)
class Condensed:
    """The end of one visit.

    Attributes
    ----------
    how : ``first`` (of a place), ``again`` (added to a place), ``composed`` (one edge has its odometry; sightings, if
        any, contradicted something and are lost), ``waits`` (until the keyframes after it see enough places), ``kept``
        (it cannot be condensed)
    why : of ``composed`` and ``kept``
    wider : factor of the variances of the visit, without which it contradicts its place
    removed : the keyframes that left the problem, in order of time
    """

    how: str
    why: str = ""
    wider: float = 1.0
    removed: tuple[RemovedPose, ...] = ()

    @property
    def is_contradiction(self) -> bool:
        """Return whether the visit contradicts itself or its place."""
        return self.why in (ITSELF, PLACE)


@dataclass(slots=True)
class Surroundings:
    """The edges that count on the keyframes of a visit, by id.

    Attributes
    ----------
    inside : between its keyframes; sightings : of landmarks
    into : from elsewhere to the first keyframe; onward : from the last one to the keyframe after the visit
    steps : of each keyframe but the last, the edge of odometry to the next
    factors : of ``inside`` and ``sightings``: how much each counts, by its weight and loss
    unfit : why these cannot be condensed; empty where they can
    """

    inside: dict[int, Edge] = field(default_factory=dict)
    sightings: dict[int, Edge] = field(default_factory=dict)
    into: dict[int, Edge] = field(default_factory=dict)
    onward: dict[int, Edge] = field(default_factory=dict)
    steps: list[Edge] = field(default_factory=list)
    factors: dict[int, float] = field(default_factory=dict)
    unfit: str = ""

    @property
    def own(self) -> list[int]:
        """The edges that are within the visit and its landmarks."""
        return [*self.inside, *self.sightings]

    @property
    def seen(self) -> set[int]:
        """The landmarks that are seen."""
        return {edge.vertices[1] for edge in self.sightings.values()}


def surroundings(space: Geometry, solver: Solver, visit: Sequence[int], after: int) -> Surroundings:
    """Return the edges on the keyframes of a visit.

    Parameters
    ----------
    visit : vertices of its keyframes, in order of time; after : the keyframe that follows
    """
    graph, out = solver.graph, Surroundings()
    on_it = sorted({int(edge) for vertex in visit for edge in solver.edges_on(vertex)})
    edges = {number: edge for number in on_it if (edge := graph.edge(number)).weight}
    members = set(visit)
    for number, edge in edges.items():
        first, last = edge.vertices[0], edge.vertices[-1]
        if len(edge.vertices) == 2 and (edge.label == LANDMARKS or graph.kind_of(last) is space.point):
            out.sightings[number] = edge
        elif edge.type is space.relative_pose:
            if members >= {first, last}:
                out.inside[number] = edge
            elif edge.label != CLOSURES and (first, last) == (visit[-1], after):
                out.onward[number] = edge
            elif edge.label != CLOSURES and last == visit[0] and first not in members:
                out.into[number] = edge
            else:
                out.unfit = f"edge {number} leads from the visit to vertex {last if first in members else first}"
        else:
            out.unfit = f"edge {number} is a {edge.type.name}"
    by_ends = {edge.vertices: edge for edge in reversed(out.inside.values()) if edge.label != CLOSURES}
    out.steps = [by_ends[ends] for ends in pairwise(visit) if ends in by_ends]
    if len(out.steps) < len(visit) - 1 or len(out.onward) != 1 or len(out.into) > 1:
        out.unfit = out.unfit or "odometry does not join its keyframes one by one"
    out.factors = _factors(solver, {**out.inside, **out.sightings})
    return out


def seen_from(space: Geometry, solver: Solver, keyframes: Index) -> list[set[int] | None]:
    """Return the landmarks that are seen from each keyframe, by vertices; None for one that cannot be condensed.

    One can be if it is free, with edges of odometry, sightings, closures and fixes alone. One that is not free is of a
    frozen map, or of a map that the robot is located in.
    """
    graph = solver.graph
    held = np.isin(keyframes, solver.held).tolist()
    out: list[set[int] | None] = [None if is_held else set() for is_held in held]
    is_point = np.array([kind is space.point for kind in graph.kinds])
    place = np.full(graph.vertex_ids.next, -1)
    place[keyframes] = np.arange(len(keyframes))
    for table, rows in graph.by_table(solver.edges).items():
        ends, numbers = table.at(rows).vertices, table.at(rows).ids
        is_fit = graph.has_label(numbers, (CLOSURES, FIXES))
        if table.type is space.relative_pose:
            is_fit |= graph.has_label(numbers, ("odometry", CHAIN))
        if ends.shape[1] == 2:
            is_seen = graph.has_label(numbers, (LANDMARKS,)) | is_point[graph.kind_codes(ends[:, 1])]
            is_fit |= is_seen
            for row, mark in zip(place[ends[is_seen, 0]].tolist(), ends[is_seen, 1].tolist(), strict=True):
                if row >= 0 and (of_row := out[row]) is not None:
                    of_row.add(mark)
        for row in place[ends[~is_fit]].ravel().tolist():
            if row >= 0:
                out[row] = None
    return out


def composed(space: Geometry, edges: Sequence[Edge]) -> tuple[Numbers, Array]:
    """Return odometry, one edge after the other, as one relative pose, and the square root of its information."""
    pose, covariance = space.identity, np.zeros((space.dof, space.dof))
    for edge in edges:
        step: Numbers = tuple(edge.measured.tolist())
        information = edge.weight * edge.sqrt_information.T @ edge.sqrt_information
        covariance = space.group.propagate(covariance, step, _inverse(information))
        pose = tuple(map(float, space.group.compose(pose, step)))
    return space.normalized(pose), square_root(symmetric(_inverse(covariance)))


def _inverse(matrix: Array) -> Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _factors(solver: Solver, edges: dict[int, Edge]) -> dict[int, float]:
    chi2, _ = solver.chi2_of(list(edges))
    out = {}
    for (number, edge), one in zip(edges.items(), chi2.tolist(), strict=True):
        loss = solver.settings.last_loss(edge.label, edge.source)
        out[number] = edge.weight * float(weight_and_cost(loss.kind, loss.scale, edge.weight * one)[0])
    return out


class Condenser:
    """Condenses visits in a graph and its solver, in order of time. The caller updates the solver after each.

    Parameters
    ----------
    state : whose places and scale change
    """

    def __init__(self, space: Geometry, solver: Solver, state: BoundedState) -> None:
        self.space, self.solver, self.state = space, solver, state

    def condense(
        self, visit: Sequence[int], after: int, cell: Cell, ahead: Collection[int], *, waits: bool = True
    ) -> Condensed:
        """Condense a visit. Where ``waits`` or ``kept`` is returned nothing was changed.

        Parameters
        ----------
        visit : vertices of its keyframes, in order of time; after : the keyframe that follows
        ahead : landmarks that the keyframes after the visit see, as far as odometry joins them
        waits : whether it may wait until these see enough places; if not, it begins a place instead, if it can
        """
        around = surroundings(self.space, self.solver, visit, after)
        if around.unfit:
            return Condensed("kept", around.unfit)
        in_cell, seen = self.state.places.get(cell, []), around.seen
        best = max(in_cell, key=lambda one: len(seen & set(one.place.members)), default=None)
        fits = best is not None and len(seen | set(best.place.members)) <= _MOST_MEMBERS
        is_again = fits and best is not None and self._lay(seen & set(best.place.members))
        has_room = len(in_cell) < _MOST_PLACES and self._lay(seen)
        if is_again and len(self._known() & set(ahead)) < ENOUGH:
            if waits or not has_room:
                return Condensed("waits")
            is_again = False
        if not (is_again or has_room):
            return self._without_place(visit, after, around, "it sees too few landmarks, or the cell is full")
        try:
            at, ends = len(visit) // 2, self._kept_end(visit, around)
            if not is_again:
                at = best_known(self.space, self.solver.graph, self.solver.estimate, visit, around.factors)
                ends = {visit[-1], *([visit[0]] if around.into else [])} - {visit[at]}
            inside = [vertex for vertex in visit if vertex not in ends]
            if visit[at] in ends:
                return Condensed("kept", "it is one keyframe, which odometry joins to one that is in no place")
            one, chi2, degrees = visit_of(
                self.space, self.solver.graph, self.solver.estimate, inside, visit[at], around.factors
            )
            if not ends <= set(one.members):
                raise SingularError("odometry does not determine the visit")
            if degrees > 0 and chi2 > quantile(GATE, degrees):
                return self._composed(visit, after, around, ITSELF)
            one = replace(one, information=one.information / self.state.scale.factor)
            if is_again and best is not None:
                return self._again(visit, after, around, one, best)
            return self._first(visit, visit[at], around, one, cell)
        except SingularError as error:
            return self._without_place(visit, after, around, str(error))

    def forget_removed(self) -> None:
        """Forget landmarks that are not in the graph any more."""
        for one in self._all():
            one.strikes = {mark: count for mark, count in one.strikes.items() if self.solver.graph.vertex_ids.has(mark)}

    def rescale(self) -> None:
        """Scale all places, where visits so far say that their variances are larger or smaller."""
        if (by := self.state.scale.change()) != 1.0:
            for one in self._all():
                place = replace(one.place, information=one.place.information / by)
                now = added_place(self.space, self.solver.graph, one.base, place)
                self.solver.add([], [now.edge])
                self.solver.set_weight(one.edge, 0.0)
                one.place, one.edge = now.place, now.edge

    # -- what becomes of a visit -------------------------------------------------------------------------------------

    def _first(self, visit: Sequence[int], base: int, around: Surroundings, one: Place, cell: Cell) -> Condensed:
        """Begin a place, which has the ends of the visit as well: the odometry to what is around it stays as it is."""
        if lonely := self._left_alone(around, one.members):
            return Condensed("kept", f"landmark {lonely[0]} would be left without a measurement")
        begun = added_place(self.space, self.solver.graph, base, one)
        self.state.places.setdefault(cell, []).append(begun)
        gone = [vertex for vertex in visit if vertex != base and vertex not in one.members]
        return Condensed("first", removed=self._replace(gone, base, around.own, [begun.edge]))

    def _again(self, visit: Sequence[int], after: int, around: Surroundings, one: Place, at: PlaceEdge) -> Condensed:
        """Add a visit to a place, and cut the odometry on both sides of it."""
        guess = self._between(*self.solver.estimate([at.base, visit[len(visit) // 2]]).tolist())
        fit = fit_of(self.space, at.place, one, guess, GATE, at.strikes)
        if fit.result is not None and (lonely := self._left_alone(around, fit.result.place.members)):
            return Condensed("kept", f"landmark {lonely[0]} would be left without a measurement")
        self.state.scale.add(fit.as_is, GATE)
        if (result := fit.result) is None:
            return self._composed(visit, after, around, PLACE)
        now = added_place(self.space, self.solver.graph, at.base, result.place)
        gone = [vertex for vertex in visit if vertex not in one.members]
        cut = [*around.onward, *(around.into if gone[0] == visit[0] else ())]
        removed = self._replace(gone, at.base, [*around.own, *cut, at.edge], [now.edge])
        if fit.anew is not None:
            at.strikes.pop(fit.anew, None)
        elif fit.without is not None:
            at.strikes[fit.without] = at.strikes.get(fit.without, 0) + 1
        else:
            at.strikes = {mark: count for mark, count in at.strikes.items() if mark not in one.members}
        at.place, at.edge = now.place, now.edge
        return Condensed("again", wider=fit.wider, removed=removed)

    def _without_place(self, visit: Sequence[int], after: int, around: Surroundings, why: str) -> Condensed:
        """Keep a visit that cannot be in a place if something but odometry was measured, else its odometry alone."""
        measures = around.sightings or any(edge.label == CLOSURES for edge in around.inside.values())
        return Condensed("kept", why) if measures else self._composed(visit, after, around, why)

    def _composed(self, visit: Sequence[int], after: int, around: Surroundings, why: str) -> Condensed:
        """Put one edge in place of the odometry of a visit. Sightings are lost."""
        if lonely := self._left_alone(around, ()):
            return Condensed("kept", f"{why}; landmark {lonely[0]} would be left without a measurement")
        way, gone = [*around.into.values(), *around.steps, *around.onward.values()], list(visit)
        added, bases = list[int](), [one.base for one in self._all()]
        if not around.into and bases:  # nothing leads to it: all that it says is where its keyframes are
            at = self.solver.estimate([visit[0], *bases])[:, : self.space.dimensions]
            base = bases[int(np.argmin(np.linalg.norm(at[1:] - at[0], axis=1)))]
        else:
            base = way[0].vertices[0]
            measured, root = composed(self.space, way)
            noise = Gaussian(root)
            added = [self.solver.graph.add_edge(self.space.relative_pose, [base, after], measured, noise, CHAIN)]
            gone = [vertex for vertex in visit if vertex != base]
        removed = self._replace(gone, base, [*around.own, *around.into, *around.onward], added)
        return Condensed("composed", why, removed=removed)

    # -- edits of the graph ------------------------------------------------------------------------------------------

    def _kept_end(self, visit: Sequence[int], around: Surroundings) -> set[int]:
        """Return the first keyframe of a visit if odometry joins it to one that stays, and is in no place."""
        known = {vertex for one in self._all() for vertex in (one.base, *one.place.members)}
        return {visit[0] for edge in around.into.values() if edge.vertices[0] not in known}

    def _between(self, begin: Sequence[float], pose: Sequence[float]) -> Numbers:
        return tuple(map(float, self.space.group.between(tuple(begin), tuple(pose))))

    def _lay(self, marks: Collection[int]) -> bool:
        """Return whether landmarks say how a constellation lies: one that is a pose does, or two or three points."""
        is_pose = any(self.solver.graph.kind_of(mark) is self.space.pose for mark in marks)
        return is_pose or len(marks) >= self.space.dimensions

    def _all(self) -> list[PlaceEdge]:
        return [one for in_cell in self.state.places.values() for one in in_cell]

    def _known(self) -> set[int]:
        return {mark for one in self._all() for mark in one.place.members}

    def _left_alone(self, around: Surroundings, members: Collection[int]) -> list[int]:
        """Return the landmarks of a visit that are not among the members, and that little else measures."""
        graph, out = self.solver.graph, []
        for mark in sorted(around.seen - set(members) - self._known()):
            others = (graph.edge(int(edge)) for edge in self.solver.edges_on(mark) if int(edge) not in around.sightings)
            sizes = [edge.type.residual_size for edge in others if edge.weight]
            if max(sizes, default=0) < graph.kind_of(mark).dof and len(sizes) < ENOUGH:
                out.append(mark)
        return out

    def _replace(
        self, gone: Sequence[int], base: int, edges: Sequence[int], added: Sequence[int]
    ) -> tuple[RemovedPose, ...]:
        """Put edges in place of others, and remove keyframes, in order of time, that are known relative to a base."""
        begin, *poses = self.solver.estimate([base, *gone]).tolist()
        out = (RemovedPose(one, base, self._between(begin, pose)) for one, pose in zip(gone, poses, strict=True))
        removed = tuple(out)
        self.solver.add([], added)
        self.solver.leave_out(sorted(edges))
        self.solver.remove(list(gone))
        return removed
