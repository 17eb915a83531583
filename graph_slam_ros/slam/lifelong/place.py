"""A place: the joint Gaussian of all visits to it so far, one edge of the graph; and how a further visit is added."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Edge, Gaussian, Graph, place_edge
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.graph.place import LABEL
from graph_slam_ros.slam.lifelong.constellation import Constellation, combined, turned
from graph_slam_ros.slam.lifelong.elimination import (
    marginal_information,
    product,
    quadratic,
    solution,
    without,
)
from graph_slam_ros.slam.lifelong.visit import Visit
from graph_slam_ros.typing import Array, Numbers

Cell = tuple[int, ...]
"""A cell of the grid, by which visits and places are found."""
_STEPS, _STILL = 30, 1e-12  # Gauss-Newton steps of a motion, at most; until it moves by no more [m, rad]


@dataclass(frozen=True, slots=True)
class Place:
    """The joint Gaussian of some landmarks, as seen from one pose.

    Attributes
    ----------
    members : vertices of the landmarks: points, ascending, and then poses, ascending
    seen : how they lie in the axes of the pose; information : (n, n) of a step of that, given the pose
    linearized_at : the same by the whole map when each became a member. Motions of the whole place are linearised
        there for good: at changing positions, visits would seem to measure how the place is turned
    visits : how many are in it
    """

    members: tuple[int, ...]
    seen: Constellation
    linearized_at: Constellation
    information: Array
    visits: int = 1

    @classmethod
    def begun_by(cls, visit: Visit) -> "Place":
        """Return the place that one visit knows, seen from the pose that the visit is seen from."""
        return cls(visit.members, visit.seen, visit.linearized_at, visit.information)

    def shared(self, visit: Visit) -> list[int]:
        """Return the members that a visit saw, too, in their order here."""
        theirs = set(visit.members)
        return [one for one in self.members if one in theirs]

    def without(self, member: int) -> "Place":
        """Return the place after one of its landmarks was marginalised out."""
        kept = [k for k, one in enumerate(self.members) if one != member]
        return replace(
            self,
            members=tuple(self.members[k] for k in kept),
            seen=self.seen.part(kept),
            linearized_at=self.linearized_at.part(kept),
            information=marginal_information(self.information, self.seen.indices(kept)),
        )


@dataclass(frozen=True, slots=True)
class Fused:
    """A place with one more visit.

    Attributes
    ----------
    statistic, degrees : chi2 of the visit against all before, and its degrees of freedom; 0 where they share too little
        to contradict each other
    """

    place: Place
    statistic: float
    degrees: int


def visit_without(visit: Visit, member: int) -> Visit:
    """Return a visit after one of its landmarks was marginalised out."""
    rest = Place.begun_by(visit).without(member)
    return replace(
        visit, members=rest.members, seen=rest.seen, linearized_at=rest.linearized_at, information=rest.information
    )


def fused(space: Geometry, place: Place, visit: Visit, T_place_visit: Numbers) -> Fused:
    """Add a visit to a place.

    The pose that the visit is seen from is freed, so that it says nothing of where the place is seen from. Before, the
    visit is laid on the place by the motion that fits the shared landmarks best, as the whole map has both.

    Parameters
    ----------
    T_place_visit : about where the pose of the visit is in the axes of the place: where the best motion is looked for

    Raises
    ------
    SingularError
        The shared landmarks do not determine that motion.
    """
    shared = place.shared(visit)
    at_place, at_visit = _rows(place.members, shared), _rows(visit.members, shared)
    mine, theirs = place.linearized_at.part(at_place), visit.linearized_at.part(at_visit)
    if not mine.lays(space):
        raise SingularError(f"the visit shares {len(shared)} landmarks with the place")
    weight = marginal_information(visit.information, visit.seen.indices(at_visit))
    motion = _motion(mine, theirs, weight, space, T_place_visit)
    back = space.group.inverse(motion)
    count, poses = len(visit.members), len(visit.seen.turns)
    in_place = [(range(count), visit.linearized_at.moved(space, back)), (at_visit, mine)]
    where = combined(in_place, count, poses, space)
    columns = where.rigid_motions(space)
    shape = without(turned(visit.information, space.turn(motion), count), columns)
    moved = replace(visit, seen=visit.seen.moved(space, back), linearized_at=where, information=shape)
    fusion, statistic = _sum(space, place, moved)
    return Fused(fusion, statistic, max(mine.size - space.dof, 0))


def _sum(space: Geometry, place: Place, visit: Visit) -> tuple[Place, float]:
    """Add a visit in the axes of the place to what the place has; returns chi2, too."""
    points, poses = (sorted({*one, *other}) for one, other in zip(_by_kind(place), _by_kind(visit), strict=True))
    members = [*points, *poses]
    rows = _rows(members, visit.members), _rows(members, place.members)
    before, where = (
        combined([*zip(rows, both, strict=True)], len(members), len(poses), space)
        for both in ((visit.seen, place.seen), (visit.linearized_at, place.linearized_at))
    )
    new_at, mine_at = (before.indices(one) for one in rows)
    whole = np.zeros((before.size, before.size))
    whole[np.ix_(mine_at, mine_at)] += place.information
    whole[np.ix_(new_at, new_at)] += visit.information
    right_side = np.zeros(before.size)
    right_side[new_at] = product(visit.information, visit.seen.minus(space, before.part(rows[0])))
    after = before.plus(space, solution(whole, right_side))
    statistic = quadratic(place.information, after.part(rows[1]).minus(space, place.seen))
    statistic += quadratic(visit.information, after.part(rows[0]).minus(space, visit.seen))
    return Place(tuple(members), after, where, whole, place.visits + 1), statistic


def _motion(
    mine: Constellation, theirs: Constellation, information: Array, space: Geometry, T_mine_theirs: Numbers
) -> Numbers:
    """Return the motion ``T_theirs_mine`` that lays a constellation best on theirs, weighted in the axes of theirs."""
    group, d = space.group, space.dimensions
    motion = group.inverse(T_mine_theirs)
    for _ in range(_STEPS):
        there = mine.moved(space, motion)
        columns = there.rigid_motions(space)
        along = product(information, columns)
        step = -solution(product(columns.T, along), product(along.T, there.minus(space, theirs)))
        added = *step[:d].tolist(), *group.exp((*[0.0] * d, *step[d:].tolist()))[d:]
        motion = space.normalized(tuple(map(float, group.compose(added, motion))))
        if np.abs(step).max() <= _STILL:
            break
    return motion


def _by_kind(one: Place | Visit) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the members that are points, and those that are poses."""
    first = len(one.members) - len(one.seen.turns)
    return one.members[:first], one.members[first:]


def _rows(among: Sequence[int], wanted: Sequence[int]) -> list[int]:
    """Return where each of some members is among others."""
    at = {member: k for k, member in enumerate(among)}
    return [at[member] for member in wanted]


@dataclass(slots=True)
class PlaceEdge:
    """A place, the vertex that it is seen from and its edge; ``strikes`` of each landmark that visits contradict."""

    base: int
    place: Place
    edge: int
    strikes: dict[int, int] = field(default_factory=dict)


def place_of(edge: Edge, linearized_at: Array, visits: int, strikes: Mapping[int, int] | None = None) -> PlaceEdge:
    """Return the place of an edge, which has its other numbers.

    Parameters
    ----------
    linearized_at : numbers as those that the edge measured
    """
    base, *members = edge.vertices
    space = PLANAR if PLANAR.pose in edge.type.accepts[0] else SPATIAL
    information = product(edge.sqrt_information.T, edge.sqrt_information)
    seen, at = (Constellation.from_numbers(space, numbers, len(members)) for numbers in (edge.measured, linearized_at))
    return PlaceEdge(base, Place(tuple(members), seen, at, information, visits), edge.id, dict(strikes or {}))


def added_place(space: Geometry, graph: Graph, base: int, place: Place, root: Array) -> PlaceEdge:
    """Add the edge of a place to a graph.

    Parameters
    ----------
    base : the vertex that the place is seen from
    root : square root of its information
    """
    poses = len(place.seen.turns)
    kind = place_edge(space.pose, len(place.members) - poses, poses)
    edge = graph.edge(graph.add_edge(kind, [base, *place.members], place.seen.numbers, Gaussian(root), LABEL))
    return place_of(edge, place.linearized_at.numbers, place.visits)
