"""A place: the joint Gaussian of all visits to it so far, one edge of the graph; and how a further visit is added.

What is wrong with a calibration makes errors that last. The covariance of a visit does not have them, because they are
alike in the visit. But visits differ by them: the robot drove another way. So the variances of visits are multiplied by
chi2 per degree of freedom of all visits to places so far, which is never less than 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Edge, Gaussian, Graph, place_edge
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.graph.place import LABEL
from graph_slam_ros.slam.levels import PRIOR_DOF
from graph_slam_ros.slam.lifelong.constellation import Constellation, combined, turned
from graph_slam_ros.slam.lifelong.elimination import marginal_information, solution, square_root, without
from graph_slam_ros.typing import Array, Numbers

Cell = tuple[int, ...]
"""A cell of the grid, by which visits and places are found."""
_STRIKES = 2  # visits in a row that contradict a place in the same landmark: then that begins anew
_WIDER = (2.0, 4.0, 9.0)  # factors of the variances of a visit that contradicts its place, the first that fits
_CHANGE = 0.05  # of the factor, from which on places are scaled anew
_STEPS, _STILL = 30, 1e-12  # Gauss-Newton steps of a motion, at most; until it moves by no more [m, rad]


@dataclass(frozen=True, slots=True)
class Place:
    """The joint Gaussian of some landmarks, as seen from one pose: a visit, or all visits so far.

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

    def __deepcopy__(self, memo: object) -> "Place":
        return self  # nothing in it changes

    def shared(self, visit: "Place") -> list[int]:
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


def fused(space: Geometry, place: Place, visit: Place, T_place_visit: Numbers) -> Fused:
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


def _sum(space: Geometry, place: Place, visit: Place) -> tuple[Place, float]:
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
    right_side[new_at] = visit.information @ visit.seen.minus(space, before.part(rows[0]))
    after = before.plus(space, solution(whole, right_side))
    mine, theirs = after.part(rows[1]).minus(space, place.seen), after.part(rows[0]).minus(space, visit.seen)
    statistic = mine @ place.information @ mine + theirs @ visit.information @ theirs
    return Place(tuple(members), after, where, whole, place.visits + 1), float(statistic)


def _motion(
    mine: Constellation, theirs: Constellation, information: Array, space: Geometry, T_mine_theirs: Numbers
) -> Numbers:
    """Return the motion ``T_theirs_mine`` that lays a constellation best on theirs, weighted in the axes of theirs."""
    group, d = space.group, space.dimensions
    motion = group.inverse(T_mine_theirs)
    for _ in range(_STEPS):
        there = mine.moved(space, motion)
        columns = there.rigid_motions(space)
        along = information @ columns
        step = -solution(columns.T @ along, along.T @ there.minus(space, theirs))
        added = *step[:d].tolist(), *group.exp((*[0.0] * d, *step[d:].tolist()))[d:]
        motion = space.normalized(tuple(map(float, group.compose(added, motion))))
        if np.abs(step).max() <= _STILL:
            break
    return motion


def _by_kind(one: Place) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the members that are points, and those that are poses."""
    first = len(one.members) - len(one.seen.turns)
    return one.members[:first], one.members[first:]


def _rows(among: Sequence[int], wanted: Sequence[int]) -> list[int]:
    """Return where each of some members is among others."""
    at = {member: k for k, member in enumerate(among)}
    return [at[member] for member in wanted]


@dataclass(slots=True)
class VisitScale:
    """The factor by which the variances of visits are larger than stated.

    Attributes
    ----------
    chi2, degrees : of all visits against their places, with variances as stated
    factor : in use
    """

    chi2: float = 0.0
    degrees: int = 0
    factor: float = 1.0

    def add(self, fit: Fused, gate: float) -> None:
        """Add the statistic of a visit, with variances in use. None counts for more than the quantile ``gate``."""
        if fit.degrees > 0:
            self.chi2 += self.factor * min(fit.statistic, quantile(gate, fit.degrees))
            self.degrees += fit.degrees

    def change(self) -> float:
        """Use the factor by all visits so far. Returns by how much it changed; 1 where that is next to nothing."""
        now = max(1.0, (self.chi2 + PRIOR_DOF) / (self.degrees + PRIOR_DOF))
        by = now / self.factor
        if abs(by - 1.0) < _CHANGE:
            return 1.0
        self.factor = now
        return by


@dataclass(frozen=True, slots=True)
class Fit:
    """A visit laid on its place.

    Attributes
    ----------
    as_is : the place with the whole visit; its statistic is how well that fits
    result : the place with that part of the visit; None if nothing is added
    without, anew : the landmark that contradicts the place and was left out, or that the place has anew
    wider : the factor of the variances of the visit
    """

    as_is: Fused
    result: Fused | None
    without: int | None = None
    anew: int | None = None
    wider: float = 1.0


def fit_of(space: Geometry, place: Place, visit: Place, guess: Numbers, gate: float, strikes: Mapping[int, int]) -> Fit:
    """Return how a visit fits its place: as it is, without one landmark, or with larger variances.

    Parameters
    ----------
    guess : about where the pose of the visit is in the axes of the place
    gate : quantile of chi2 above which a visit contradicts its place
    strikes : visits in a row that contradicted the place, of each landmark

    Raises
    ------
    SingularError
        As for ``fused``.
    """
    done = fused(space, place, visit, guess)
    if _passes(done, gate):
        return Fit(done, done)
    without = _contradicting(space, place, visit, guess, gate)
    if without is not None and strikes.get(without, 0) + 1 >= _STRIKES:
        return Fit(done, fused(space, place.without(without), visit, guess), anew=without)
    if without is not None:
        return Fit(done, fused(space, place, visit.without(without), guess), without=without)
    for wider in _WIDER:
        result = fused(space, place, replace(visit, information=visit.information / wider), guess)
        if _passes(result, gate):
            return Fit(done, result, wider=wider)
    return Fit(done, None)


def _passes(done: Fused, gate: float) -> bool:
    return done.degrees < 1 or done.statistic <= quantile(gate, done.degrees)


def _contradicting(space: Geometry, place: Place, visit: Place, guess: Numbers, gate: float) -> int | None:
    """Return the landmark without which a visit fits its place best; None where it fits without none of them."""
    shared, found = place.shared(visit), list[tuple[float, int]]()
    for k, mark in enumerate(shared):
        rest = [place.members.index(one) for one in (*shared[:k], *shared[k + 1 :])]
        if not place.seen.part(rest).lays(space):
            continue
        done = fused(space, place, visit.without(mark), guess)
        if _passes(done, gate):
            found.append((done.statistic, mark))
    return min(found)[1] if found else None


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
    information = edge.sqrt_information.T @ edge.sqrt_information
    seen, at = (Constellation.from_numbers(space, numbers, len(members)) for numbers in (edge.measured, linearized_at))
    return PlaceEdge(base, Place(tuple(members), seen, at, information, visits), edge.id, dict(strikes or {}))


def added_place(space: Geometry, graph: Graph, base: int, place: Place) -> PlaceEdge:
    """Add the edge of a place to a graph, in which it is seen from the vertex ``base``."""
    root, poses = square_root(place.information), len(place.seen.turns)
    kind = place_edge(space.pose, len(place.members) - poses, poses)
    edge = graph.edge(graph.add_edge(kind, [base, *place.members], place.seen.numbers, Gaussian(root), LABEL))
    return place_of(edge, place.linearized_at.numbers, place.visits)
