"""A place: the joint Gaussian of all visits to it so far, and how a further visit is added."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.elimination import marginal_information, product, quadratic, solution, without
from graph_slam_ros.slam.lifelong.visit import Visit
from graph_slam_ros.typing import Array, Index, Numbers

_STEPS, _STILL = 30, 1e-12  # Gauss-Newton steps of a motion, at most; until it moves by no more [m, rad]


@dataclass(frozen=True, slots=True)
class Place:
    """The joint Gaussian of some landmarks, as seen from one pose.

    Attributes
    ----------
    members : vertices of the landmarks, ascending
    points : (m, d) their positions in the axes of the pose [m]; information : (m d, m d) of these, given the pose
    linearized_at : (m, d) the same by the whole map when each became a member. Motions of the whole place are
        linearised there for good: at changing points, visits would seem to measure how the place is turned
    visits : how many are in it
    """

    members: tuple[int, ...]
    points: Array
    linearized_at: Array
    information: Array
    visits: int = 1

    @classmethod
    def begun_by(cls, visit: Visit) -> "Place":
        """Return the place that one visit knows, seen from the pose that the visit is seen from."""
        return cls(visit.members, visit.points, visit.linearized_at, visit.information)

    def shared(self, visit: Visit) -> list[int]:
        """Return the members that a visit saw, too."""
        return sorted(set(self.members) & set(visit.members))

    def without(self, member: int) -> "Place":
        """Return the place after one of its landmarks was marginalised out."""
        kept = [k for k, one in enumerate(self.members) if one != member]
        information = marginal_information(self.information, _numbers(kept, self.points.shape[1]))
        members = tuple(self.members[k] for k in kept)
        return replace(
            self,
            members=members,
            points=self.points[kept],
            linearized_at=self.linearized_at[kept],
            information=information,
        )


@dataclass(frozen=True, slots=True)
class Fused:
    """A place with one more visit.

    Attributes
    ----------
    statistic, degrees : chi2 of the visit against all before, and its degrees of freedom; 0 where they share too little
        to contradict each other
    covariance : (dof, dof) of the pose of the visit in the axes of the place, in the tangent space there
    """

    place: Place
    statistic: float
    degrees: int
    covariance: Array


def visit_without(visit: Visit, member: int) -> Visit:
    """Return a visit after one of its landmarks was marginalised out."""
    rest = Place.begun_by(visit).without(member)
    return replace(
        visit, members=rest.members, points=rest.points, linearized_at=rest.linearized_at, information=rest.information
    )


def fewest_shared(space: Geometry) -> int:
    """Return how many landmarks lay a visit on a place: 2 in the plane, 3 in space."""
    return space.dimensions


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
    size, shared = space.dimensions, place.shared(visit)
    if len(shared) < fewest_shared(space):
        raise SingularError(f"the visit shares {len(shared)} landmarks with the place")
    at_place, at_visit = _places(place.members, shared), _places(visit.members, shared)
    weight = marginal_information(visit.information, _numbers(at_visit, size))
    turn, shift, resists = _motion(
        place.linearized_at[at_place], visit.linearized_at[at_visit], weight, space, T_place_visit
    )
    there, where = product(visit.points - shift, turn), product(visit.linearized_at - shift, turn)  # R' (p - t)
    blocks = visit.information.reshape(len(there), size, len(there), size)
    turned = np.einsum("ba,ibjc,cd->iajd", turn, blocks, turn, optimize=False).reshape(visit.information.shape)
    where[at_visit] = place.linearized_at[at_place]
    shape = without(0.5 * (turned + turned.T), rigid_motions(where))
    degrees = size * len(shared) - rigid_motions(where).shape[1]
    fusion, statistic = _sum(place, replace(visit, points=there, linearized_at=where, information=shape))
    # The place knows its landmarks no worse than one visit does: twice the covariance by the visit alone.
    return Fused(fusion, statistic, max(degrees, 0), np.asarray(2.0 * np.linalg.inv(resists)))


def rigid_motions(points: Array) -> Array:
    """Return how points (m, d) move with the whole, (m d, 3) in the plane and (m d, 6) in space, about the origin."""
    m, size = points.shape
    out = np.zeros((m, size, 3 if size == 2 else 6))
    for axis in range(size):
        out[:, axis, axis] = 1.0
    if size == 2:
        out[:, 0, 2], out[:, 1, 2] = -points[:, 1], points[:, 0]
    else:
        x, y, z = points.T
        out[:, 1, 3], out[:, 2, 3] = -z, y
        out[:, 0, 4], out[:, 2, 4] = z, -x
        out[:, 0, 5], out[:, 1, 5] = -y, x
    return out.reshape(m * size, -1)


def _sum(place: Place, visit: Visit) -> tuple[Place, float]:
    """Add a visit in the axes of the place to what the place has; returns chi2, too."""
    members, points, information, size = visit.members, visit.points, visit.information, visit.points.shape[1]
    all_members = sorted({*place.members, *members})
    mine, new = _places(all_members, place.members), _places(all_members, members)
    before, where = np.zeros((2, len(all_members), size))
    before[new], before[mine] = points, place.points
    where[new], where[mine] = visit.linearized_at, place.linearized_at
    mine_at, new_at = _numbers(mine, size), _numbers(new, size)
    whole = np.zeros((before.size, before.size))
    whole[np.ix_(mine_at, mine_at)] += place.information
    whole[np.ix_(new_at, new_at)] += information
    right_side = np.zeros(before.size)
    right_side[new_at] = product(information, (points - before[new]).ravel())
    step = solution(whole, right_side)
    after = before + step.reshape(before.shape)
    statistic = quadratic(place.information, (after[mine] - place.points).ravel())
    statistic += quadratic(information, (after[new] - points).ravel())
    return Place(tuple(all_members), after, where, whole, place.visits + 1), statistic


def _motion(
    mine: Array, theirs: Array, information: Array, space: Geometry, T_mine_theirs: Numbers
) -> tuple[Array, Array, Array]:
    """Return R and t of the motion that lays points best on theirs: ``R p + t``, weighted in the axes of theirs.

    Also the information of that motion in the tangent space there.
    """
    start = space.group.inverse(T_mine_theirs)
    turn, shift = space.turn(start), np.array(start[: space.dimensions])
    for _ in range(_STEPS):
        there = product(mine, turn.T) + shift
        columns = rigid_motions(there)
        along = product(information, columns)
        resists = product(columns.T, along)
        step = -solution(resists, product(along.T, (there - theirs).ravel()))
        linear, angular = step[: space.dimensions], step[space.dimensions :]
        if space.dimensions == 2:
            added = space.turn((0.0, 0.0, float(angular[0])))
        else:
            added = space.turn(space.group.exp((0.0, 0.0, 0.0, *angular.tolist())))
        turn, shift = product(added, turn), product(added, shift) + linear
        if np.abs(step).max() <= _STILL:
            break
    return turn, shift, resists


def _places(among: Sequence[int], wanted: Sequence[int]) -> list[int]:
    """Return where each of some members is among others."""
    at = {member: k for k, member in enumerate(among)}
    return [at[member] for member in wanted]


def _numbers(points: Sequence[int], size: int) -> Index:
    """Return the indices of the coordinates of some points."""
    return (size * np.asarray(points, dtype=np.int64)[:, None] + np.arange(size)).ravel()
