"""A constellation: how some landmarks lie, in the axes of one pose.

A landmark is a point, or a pose: a tag whose orientation is known. The poses come last. A step has the positions of all
landmarks, in the axes of the pose, and then the rotation vectors of those that are poses, each in its own axes (in the
plane: its angle). So the information of rotations does not change where the whole is seen from another pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.graph.geometry import Geometry, rigid_motions
from graph_slam_ros.typing import Array, Index, Numbers


@dataclass(frozen=True, slots=True)
class Constellation:
    """Landmarks in the axes of one pose.

    Attributes
    ----------
    points : (m, d) positions of all landmarks [m]
    turns : (b, 1) or (b, 4) rotations of the last b of them: angles [rad] or quaternions x, y, z, w
    """

    points: Array
    turns: Array

    @classmethod
    def from_numbers(cls, space: Geometry, numbers: ArrayLike, members: int) -> "Constellation":
        """Return that of so many landmarks, from the numbers that a place edge measures."""
        given = np.asarray(numbers, dtype=np.float64)
        end = space.dimensions * members
        return cls(given[:end].reshape(members, -1), given[end:].reshape(-1, space.pose.size - space.dimensions))

    @classmethod
    def from_poses(cls, space: Geometry, points: Array, poses: Array) -> "Constellation":
        """Return that of points (a, d) and poses (b, size)."""
        d = space.dimensions
        return cls(np.concatenate((points.reshape(-1, d), poses[:, :d])), poses[:, d:].copy())

    @property
    def numbers(self) -> Array:
        """The numbers that a place edge measures."""
        return np.concatenate((self.points.ravel(), self.turns.ravel()))

    @property
    def size(self) -> int:
        """The numbers of a step."""
        return self.points.size + len(self.turns) * (1 if self.turns.shape[1] == 1 else 3)

    def indices(self, rows: Sequence[int]) -> Index:
        """Return the numbers of a step that are those of some landmarks, which ascend."""
        (m, d), count = self.points.shape, np.asarray(rows, dtype=np.int64)
        each = 1 if self.turns.shape[1] == 1 else 3
        posed = count[count >= m - len(self.turns)] - (m - len(self.turns))
        positions = d * count[:, None] + np.arange(d)
        rotations = d * m + each * posed[:, None] + np.arange(each)
        return np.concatenate((positions.ravel(), rotations.ravel()))

    def part(self, rows: Sequence[int]) -> "Constellation":
        """Return some of its landmarks, which ascend."""
        first = len(self.points) - len(self.turns)
        return Constellation(self.points[list(rows)], self.turns[[row - first for row in rows if row >= first]])

    def lays(self, space: Geometry) -> bool:
        """Return whether its landmarks say how the whole lies: a pose, or two points in the plane, three in space."""
        return len(self.turns) > 0 or len(self.points) >= space.dimensions

    def moved(self, space: Geometry, T: Numbers) -> "Constellation":
        """Return it in the axes of another pose, in which its own pose is T."""
        points = np.stack(space.group.act(T, tuple(self.points.T)), axis=-1).reshape(self.points.shape)
        turns = _turns(space, space.group.compose(T, _at_origin(space, self.turns)))
        return Constellation(points, turns)

    def minus(self, space: Geometry, other: "Constellation") -> Array:
        """Return the step (n,) from another one of the same landmarks to this one."""
        group = space.group
        off = group.log(group.between(_at_origin(space, other.turns), _at_origin(space, self.turns)))
        rotations = np.stack(off[space.dimensions :], axis=-1)
        return np.concatenate(((self.points - other.points).ravel(), rotations.ravel()))

    def plus(self, space: Geometry, step: Array) -> "Constellation":
        """Return it after a step (n,)."""
        end, group = self.points.size, space.group
        by = _at_origin(space, step[end:].reshape(len(self.turns), space.dof - space.dimensions))
        turns = _turns(space, group.compose(_at_origin(space, self.turns), group.exp(by)))
        return Constellation(self.points + step[:end].reshape(self.points.shape), turns)

    def rigid_motions(self, space: Geometry) -> Array:
        """Return how the landmarks move with the whole, (n, dof), about the origin of the axes."""
        b, d = len(self.turns), space.dimensions
        turns = np.zeros((b, space.dof - d, space.dof))
        for k, turn in enumerate(self.turns.tolist()):
            turns[k, :, d:] = space.turn((*space.identity[:d], *turn)).T if d > 2 else 1.0
        return np.concatenate((rigid_motions(self.points), turns.reshape(-1, space.dof)))


def turned(information: Array, turn: Array, points: int) -> Array:
    """Return the information (n, n) of a step whose first numbers are positions of so many points, in other axes.

    Parameters
    ----------
    turn : (d, d) from the new axes to the present ones
    """
    end, size = points * len(turn), len(turn)
    out = information.copy()
    blocks = information[:end, :end].reshape(points, size, points, size)
    of_points = np.einsum("ba,ibjc,cd->iajd", turn, blocks, turn, optimize=False).reshape(end, end)
    out[:end, :end] = 0.5 * (of_points + of_points.T)
    with_turns = information[:end, end:].reshape(points, size, -1)
    out[:end, end:] = np.einsum("ba,ibj->iaj", turn, with_turns, optimize=False).reshape(end, -1)
    out[end:, :end] = out[:end, end:].T
    return out


def combined(
    several: Sequence[tuple[Sequence[int], Constellation]], count: int, poses: int, space: Geometry
) -> Constellation:
    """Return the constellation of so many landmarks, of which the last ``poses`` are poses.

    Parameters
    ----------
    several : constellations, and which of all landmarks those of each are, ascending; later ones count
    """
    out = Constellation(np.zeros((count, space.dimensions)), np.zeros((poses, space.pose.size - space.dimensions)))
    for rows, one in several:
        out.points[list(rows)] = one.points
        posed = list(rows)[len(rows) - len(one.turns) :]
        out.turns[[row - (count - poses) for row in posed]] = one.turns
    return out


def _at_origin(space: Geometry, rotations: Array) -> Numbers:
    """Return rotations (b, k) as poses at the origin, or rotation vectors as their logarithms, in arrays."""
    return *(np.zeros(len(rotations)) for _ in range(space.dimensions)), *rotations.T


def _turns(space: Geometry, poses: Numbers) -> Array:
    """Return the rotations (b, 1) or (b, 4) of poses in arrays."""
    return np.stack([np.asarray(one) for one in poses[space.dimensions :]], axis=-1)
