"""Condensing: the keyframes of a visit leave the problem, and an edge of the place has what they measured."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Edge, Gaussian
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
from graph_slam_ros.slam.lifelong.outcome import ITSELF, PLACE, Condensed, Limits, RemovedPose
from graph_slam_ros.slam.lifelong.place import Fused, Place
from graph_slam_ros.slam.lifelong.place_edge import PlaceEdge, added_place
from graph_slam_ros.slam.lifelong.skeleton import Skeleton
from graph_slam_ros.slam.lifelong.surroundings import (
    CHAIN,
    CLOSURES,
    Motion,
    Surroundings,
    chained,
    motion_of,
    surroundings,
)
from graph_slam_ros.slam.lifelong.thinned import Thinning
from graph_slam_ros.slam.lifelong.visit import Visit, best_known, visit_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

Cell = tuple[int, ...]
_FEWEST = 3  # ranges or bearings that are enough for a landmark whose visit is condensed
_AHEAD = 3  # landmarks of places that the keyframes after a visit must see before odometry to it is cut


class Condenser:
    """Condenses visits in a graph and its solver, in order of time. The caller updates the solver after each.

    Attributes
    ----------
    places : by cell
    scale : of the variances of visits
    skeleton : where keyframes of visits that are in no place stay
    serves_closures : whether closures may come that begin at removed keyframes
    """

    def __init__(
        self,
        space: Geometry,
        solver: Solver,
        limits: Limits | None = None,
        *,
        serves_closures: bool = False,
    ) -> None:
        self.space, self.solver, self.limits = space, solver, limits or Limits()
        self.serves_closures = serves_closures
        self.places: dict[Cell, list[PlaceEdge]] = {}
        self.scale, self.skeleton = VisitScale(), Skeleton()

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
            at, ends = len(visit) // 2, set[int]()
            if not is_again:
                at = best_known(self.space, self.solver.graph, self.solver.estimate, visit, around.local)
                ends = {visit[-1], *([visit[0]] if around.into else [])} - {visit[at]}
            inside = [vertex for vertex in visit if vertex not in ends]
            one = visit_of(self.space, self.solver.graph, self.solver.estimate, inside, visit[at], around.local)
            if not ends <= set(one.members):
                raise SingularError("odometry does not determine the visit")
            if one.degrees > 0 and one.chi2 > quantile(self.limits.gate, one.degrees):
                return self._thinned(visit, after, around, ITSELF)
            one = replace(one, information=one.information / self.scale.factor)
            if is_again and best is not None:
                return self._again(visit, after, around, one, best)
            return self._first(visit, at, around, one, cell)
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

    def _first(self, visit: Sequence[int], at: int, around: Surroundings, one: Visit, cell: Cell) -> Condensed:
        """Begin a place, which has the ends of the visit as well: the odometry to what is around it stays as it is."""
        base, ends = visit[at], set(one.members).intersection(visit)
        if lonely := self._left_alone(around, one.members):
            return Condensed("kept", f"landmark {lonely[0]} would be left without a measurement")
        closures = {number: edge for number, edge in around.closures.items() if ends.isdisjoint(edge.vertices)}
        around = replace(around, closures=closures)  # those of the ends stay as well
        motions = self._motions(visit, around, base, at, None)
        added, also = self._add_carried(self._carried(around, base, motions, []))
        begun = added_place(self.space, self.solver.graph, base, Place.begun_by(one), square_root(one.information))
        self.places.setdefault(cell, []).append(begun)
        bases = _all_from(base, visit, motions) | {end: (end, None) for end in ends}
        replaced = sorted({*around.all, *also} - {*around.into, *around.onward})
        removed = self._replace(bases, replaced, [*added, begun.edge])
        return Condensed("first", removed=removed, seen=_seen(around, one.members))

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
            return self._thinned(visit, after, around, PLACE, fit.as_is)
        bases = {v for in_cell in self.places.values() for one in in_cell for v in (one.base, *one.place.members)}
        from_kept = [edge for edge in around.into.values() if edge.vertices[0] not in bases]
        motions = self._motions(visit, around, at.base, k, (guess, result.covariance), also=bool(from_kept))
        carried = self._carried(around, at.base, motions, from_kept)
        now = added_place(self.space, self.solver.graph, at.base, result.place, square_root(result.place.information))
        added, also = self._add_carried(carried)
        removed = self._replace(_all_from(at.base, visit, motions), [*around.all, at.edge, *also], [now.edge, *added])
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
        return Condensed("kept", why) if around.sightings else self._thinned(visit, after, around, why)

    def _thinned(
        self, visit: Sequence[int], after: int, around: Surroundings, why: str, done: Fused | None = None
    ) -> Condensed:
        """Compose odometry and closures; a keyframe of each cell and direction may stay. Sightings are lost."""
        if lonely := self._left_alone(around, ()):
            return Condensed("kept", f"{why}; landmark {lonely[0]} would be left without a measurement")
        poses = dict(zip(visit, self.solver.estimate(list(visit)).tolist(), strict=True))
        keeps = self.serves_closures or bool(around.closures_and_fixes)

        def is_kept(vertex: int) -> bool:
            return keeps and self.skeleton.adds(self.space, poses[vertex])

        reach_m = self.skeleton.apart_m
        thin = Thinning(self.space, visit, after, around, is_kept, reach_m, self.limits.gate).run()
        carried = [*thin.added]
        for base, fixes in thin.fixes.items():
            (begin,) = self.solver.estimate([base]).tolist()
            of = {self.solver.graph.edge(fix).vertices[0] for fix in fixes}
            motions = {one: (self._between(begin, poses[one]), thin.shares[one]) for one in of}
            some = {fix: around.fixes[fix] for fix in fixes}
            carried.append(
                carried_fixes(self.space, self.solver, base, some, around.factors, motions, self._prior_of(base))
            )
        added, also = self._add_carried(carried)
        removed = self._replace(thin.centres, [*(edge for edge in around.all if edge not in thin.stay), *also], added)
        statistic, degrees = (done.statistic, done.degrees) if done else (0.0, 0)
        return Condensed("composed", why, statistic, degrees, removed=removed)

    # -- edits of the graph ------------------------------------------------------------------------------------------

    def _motions(
        self, visit: Sequence[int], around: Surroundings, base: int, k: int, to_k: Motion | None, *, also: bool = False
    ) -> dict[int, Motion]:
        """Return the motions from a base to the keyframes of a visit, if something is carried to it, or may be later.

        Parameters
        ----------
        k : the keyframe of the visit that the others are joined to by odometry
        to_k : the motion from the base to this one, where the base is another
        also : whether something else is carried
        """
        if not (self.serves_closures or around.closures or around.fixes or also):
            return {}
        begin, *poses = self.solver.estimate([base, *visit]).tolist()
        by_odometry = motions_from(self.space, visit, [motion_of(edge) for edge in around.steps], k)
        out = dict[int, Motion]()
        for vertex, pose in zip(visit, poses, strict=True):
            _, covariance = chained(self.space, [*([to_k] if to_k else ()), by_odometry[vertex]])
            out[vertex] = self._between(begin, pose), covariance
        return out

    def _between(self, begin: Sequence[float], pose: Sequence[float]) -> Numbers:
        return tuple(map(float, self.space.group.between(tuple(begin), tuple(pose))))

    def _carried(
        self, around: Surroundings, base: int, motions: Mapping[int, Motion], from_kept: Sequence[Edge]
    ) -> list[Carried]:
        """Return the closures and fixes of a visit as edges of a base.

        Parameters
        ----------
        motions : from the base to the keyframes of the visit
        from_kept : odometry from a keyframe that has no place
        """
        space, out = self.space, list[Carried]()
        out += [replace(carried_closure(space, edge, base, motions, edge.weight), label=CHAIN) for edge in from_kept]
        for number, edge in around.closures.items():
            one = carried_closure(space, edge, base, motions, around.factors[number])
            if len(set(one.vertices)) > 1:  # else the place knows it
                out.append(one)
        if around.fixes:
            prior = self._prior_of(base)
            out.append(carried_fixes(space, self.solver, base, around.fixes, around.factors, motions, prior))
        return out

    def _prior_of(self, base: int) -> Edge | None:
        """Return the prior that a base has of fixes that were carried to it."""
        on_it = [self.solver.graph.edge(int(edge)) for edge in self.solver.edges_on(base)]
        return next((one for one in on_it if one.weight and one.label == CHAIN and len(one.vertices) == 1), None)

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
                if (
                    found is None
                    and label == CLOSURES
                    and (len(others) >= self.limits.closures or (not others and self._have_enough(one.vertices)))
                ):
                    continue
                fusion = found or one
            noise, ends = Gaussian(fusion.root), list(fusion.vertices)
            added.append(graph.add_edge(edge_type, ends, fusion.measured, noise, label, fusion.source))
            replaced |= set() if fusion.replaces is None else {fusion.replaces}
        graph.set_weights(np.array(sorted(replaced & set(added)), dtype=np.int64), 0.0)
        return [edge for edge in added if edge not in replaced], sorted(replaced - set(added))

    def _have_enough(self, vertices: Collection[int]) -> bool:
        """Return whether vertices that no closure joins have closures to so many others that one more says little."""
        graph = self.solver.graph
        for vertex in vertices:
            edges = map(graph.edge, self.solver.edges_on(vertex).tolist())
            others = {v for edge in edges if edge.label == CLOSURES and edge.weight for v in edge.vertices}
            if len(others) <= self.limits.others:  # one of these is the vertex itself
                return False
        return True

    def _lay(self, marks: Collection[int]) -> bool:
        """Return whether landmarks say how a constellation lies: one that is a pose does, or two or three points."""
        is_pose = any(self.solver.graph.kind_of(mark) is self.space.pose for mark in marks)
        return is_pose or len(marks) >= self.space.dimensions

    def _known(self) -> set[int]:
        return {mark for in_cell in self.places.values() for one in in_cell for mark in one.place.members}

    def _left_alone(self, around: Surroundings, members: Collection[int]) -> list[int]:
        """Return the landmarks of a visit that are not among the members, and that little else measures."""
        seen = {edge.vertices[1] for edge in around.sightings.values()} - set(members) - self._known()
        graph, out = self.solver.graph, []
        for mark in sorted(seen):
            others = (graph.edge(int(edge)) for edge in self.solver.edges_on(mark) if int(edge) not in around.sightings)
            sizes = [edge.type.residual_size for edge in others if edge.weight]
            if max(sizes, default=0) < graph.kind_of(mark).dof and len(sizes) < _FEWEST:
                out.append(mark)
        return out

    def _replace(
        self, bases: Mapping[int, tuple[int, Array | None]], edges: Sequence[int], added: Sequence[int]
    ) -> tuple[RemovedPose, ...]:
        """Put edges in place of others, and remove keyframes.

        Parameters
        ----------
        bases : of each keyframe of a visit, in order of time, the vertex relative to which it is known from now on, and
            the covariance of the motion from there; one that is its own base stays
        """
        gone = {vertex: base for vertex, (base, _) in bases.items() if vertex != base}
        seen_from, poses = self.solver.estimate(list(gone.values())).tolist(), self.solver.estimate(list(gone)).tolist()
        out = [
            RemovedPose(vertex, base, self._between(begin, pose), bases[vertex][1])
            for (vertex, base), begin, pose in zip(gone.items(), seen_from, poses, strict=True)
        ]
        self.solver.add([], added)
        self.solver.leave_out(list(edges))
        self.solver.remove(list(gone))
        return tuple(out)


def _all_from(base: int, visit: Sequence[int], motions: Mapping[int, Motion]) -> dict[int, tuple[int, Array | None]]:
    """Return one base for all keyframes of a visit, with the covariances of the motions from there that are known."""
    return {vertex: (base, motions[vertex][1] if vertex in motions else None) for vertex in visit}


def _seen(around: Surroundings, members: Collection[int]) -> tuple[tuple[int, int], ...]:
    """Return keyframe and landmark of the sightings of some landmarks."""
    ends = ((edge.vertices[0], edge.vertices[1]) for edge in around.sightings.values())
    return tuple(dict.fromkeys(both for both in ends if both[1] in members))
