"""Frames: poses that removed keyframes move with, by the landmarks that were seen from them.

A keyframe that left the map is told relative to a *frame*, the pose of a short stretch of keyframes. The frame knows
where the landmarks that were seen from the stretch were in its axes when it left. So its present pose is the one that
lays these on the present landmarks best, and an old path becomes as good as the landmarks are now. Of a landmark that
is a pose, the frame knows the ends of its axes, too. A frame that saw little is held by the frames before and after it:
their relative pose is known as well. So all frames of a path are solved together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from graph_slam_ros.graph.geometry import Geometry, rigid_motions
from graph_slam_ros.typing import Array, Index, Numbers

LONGEST = 20  # keyframes of a frame
_SIGMA, _LEAST_M = 0.05, 0.05  # standard deviation of a sighting: by its distance, and at least
_ARM_M, _SHARE = 5.0, 0.0002  # by the base alone: points so far from the frame, with so much of the weight
_DRIFT, _DRIFT_RAD_M, _STEP_SIGMA = 0.05, 0.01, 0.01  # from a frame to the next, of what is driven or turned; least
_TIP_M = 1.0  # length of the axes of a landmark that is a pose
_OFF = 3.0  # a landmark that is farther off, in standard deviations, counts less
_ROUNDS = (32.0, 16.0, 8.0, 4.0, 2.0, 1.0, 1.0, 1.0)  # of the fit: so many times as far, as it begins at the base alone

Rows = NDArray[np.void]


@dataclass(frozen=True, slots=True)
class PresentLandmarks:
    """The landmarks that are in the map.

    Attributes
    ----------
    ids : lasting ids, ascending; points : (m, d) positions [m]
    axes : (m, d, d) rotation matrices of those that are poses, 0 of others
    """

    ids: Index
    points: Array
    axes: Array

    def ends(self, rows: Index, axis: Index) -> Array:
        """Return the positions (n, d) of some landmarks, or of the end of one of their axes, counted from 1."""
        tips = np.take_along_axis(self.axes[rows], np.maximum(axis - 1, 0)[:, None, None], axis=2)[:, :, 0]
        return self.points[rows] + np.where(axis[:, None] > 0, _TIP_M * tips, 0.0)


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames, and the landmarks of each.

    Attributes
    ----------
    rows : ``base``, the lasting id of a vertex that stays, ``T_base`` (size,), ``count`` of its landmarks; of the pose
        in the axes of the frame before, ``T_before`` (size,), and of that the ``information`` (dof,), 0 where there is
        no frame right before
    members : of all frames, in order: ``landmark``, its lasting id, ``axis``, 0 or the number of an axis of a pose,
        ``point`` (d,), its position or the end of that axis, in the axes of the frame [m], ``weight`` [1/m^2]
    """

    rows: Rows
    members: Rows

    @classmethod
    def none(cls, space: Geometry) -> "Frames":
        """Return no frame."""
        return cls(np.empty(0, frame_type(space)), np.empty(0, member_type(space)))

    @classmethod
    def joined(cls, space: Geometry, several: Sequence["Frames"]) -> "Frames":
        """Return all of several, in order."""
        parts = [cls.none(space), *several]
        return cls(np.concatenate([one.rows for one in parts]), np.concatenate([one.members for one in parts]))

    def __len__(self) -> int:
        return len(self.rows)

    def poses(self, space: Geometry, bases: Array, landmarks: PresentLandmarks) -> Array:
        """Return the present poses (n, size) of all frames.

        Parameters
        ----------
        bases : the present poses of their bases, (n, size)
        """
        count, d, group = len(self), space.dimensions, space.group
        out = np.stack(group.compose(tuple(bases.T), tuple(self.rows["T_base"].T)), axis=-1)
        frame, ids = np.repeat(np.arange(count), self.rows["count"]), landmarks.ids
        is_there = np.isin(self.members["landmark"], ids)
        frame, known = frame[is_there], self.members[is_there]
        now = landmarks.ends(np.searchsorted(ids, known["landmark"]), known["axis"])
        # The base counts, too: as if landmarks at these arms had moved with it.
        arms = _ARM_M * np.concatenate((np.eye(d), -np.eye(d)))
        of_arms, share = np.repeat(np.arange(count), len(arms)), np.bincount(frame, known["weight"], minlength=count)
        by_base = np.tile(arms, (count, 1))
        moved = np.stack(group.act(tuple(out[of_arms].T), tuple(by_base.T)), axis=-1)
        frame, is_arm = np.concatenate((frame, of_arms)), np.arange(len(frame) + len(of_arms)) >= len(frame)
        here, there = np.concatenate((known["point"], by_base)), np.concatenate((now, moved))
        weight = np.concatenate((known["weight"], (_SHARE / len(arms) * np.maximum(share, 1.0))[of_arms]))
        columns = rigid_motions(here).reshape(len(here), d, -1)
        links = np.flatnonzero(self.rows["information"].any(axis=1))
        for times in _ROUNDS:
            seen = np.stack(group.act(group.inverse(tuple(out[frame].T)), tuple(there.T)), axis=-1)
            off = seen - here
            robust = np.where(is_arm, weight, weight / (1.0 + weight * (off**2).sum(axis=1) / (times * _OFF) ** 2) ** 2)
            weighted = robust[:, None, None] * columns
            normal, right = np.zeros((count, space.dof, space.dof)), np.zeros((count, space.dof))
            np.add.at(normal, frame, np.einsum("nik,nil->nkl", weighted, columns))
            np.add.at(right, frame, np.einsum("nik,ni->nk", weighted, off))
            step = _chain_step(normal, right, *self._links(space, out, links), links)
            out = np.stack(group.compose(tuple(out.T), group.exp(tuple(step.T))), axis=-1)
        return out

    def _links(self, space: Geometry, poses: Array, links: Index) -> tuple[Array, Array, Array]:
        """Return residuals (k, dof), their derivative by the frame before (k, dof, dof), and the information (k, dof).

        That by the frame itself is the identity: residuals are small where it counts.
        """
        group, known = space.group, self.rows[links]
        between = group.between(tuple(poses[links - 1].T), tuple(poses[links].T))
        off = np.stack(group.log(group.between(tuple(known["T_before"].T), between)), axis=-1)
        back = np.stack(group.inverse(between), axis=-1)
        by_before = np.array([-group.adjoint(tuple(one)) for one in back.tolist()])
        return off, by_before.reshape(-1, space.dof, space.dof), known["information"]


def _chain_step(normal: Array, right: Array, off: Array, by_before: Array, information: Array, links: Index) -> Array:
    """Return the Gauss-Newton step (n, dof) of frames, some of which are linked to the one before.

    Parameters
    ----------
    normal, right : (n, dof, dof) and (n, dof), of what each frame knows by itself
    """
    n, dof = right.shape
    normal, right, across = normal.copy(), right.copy(), np.zeros((n, dof, dof))
    weighted = information[:, :, None] * by_before
    normal[links] += information[:, :, None] * np.eye(dof)
    right[links] -= information * off
    normal[links - 1] += np.einsum("nki,nkj->nij", by_before, weighted)
    right[links - 1] -= np.einsum("nki,nk->ni", weighted, off)
    across[links] = weighted.transpose(0, 2, 1)  # rows of the frame before, columns of the frame
    banded = np.zeros((2 * dof, n, dof))  # upper diagonals, as solveh_banded has them
    for i in range(dof):
        for j in range(dof):
            if i <= j:
                banded[2 * dof - 1 + i - j, :, j] = normal[:, i, j]
            banded[dof - 1 + i - j, :, j] = across[:, i, j]
    return np.asarray(solveh_banded(banded.reshape(2 * dof, -1), right.ravel())).reshape(n, dof)


def chained(space: Geometry, several: Sequence[tuple["Frames", range]], poses: Array) -> "Frames":
    """Return frames one after the other, each linked to the one before where no keyframe is between them.

    Parameters
    ----------
    several : each a frame, and which keyframes are its stretch
    poses : (n, size) of all keyframes; a frame is at the middle one of its stretch
    """
    out, group, n = Frames.joined(space, [frame for frame, _ in several]), space.group, space.dimensions
    for k, ((_, before), (_, stretch)) in enumerate(pairwise(several), start=1):
        if before.stop != stretch.start:
            continue
        first, last = before[len(before) // 2], stretch[len(stretch) // 2]
        way = np.stack(group.between(tuple(poses[first:last].T), tuple(poses[first + 1 : last + 1].T)), axis=-1)
        driven = float(np.linalg.norm(way[:, :n], axis=1).sum())
        turned = sum(space.angle(tuple(one)) for one in way.tolist())
        sigmas = _STEP_SIGMA + _DRIFT * driven, _STEP_SIGMA + _DRIFT * turned + _DRIFT_RAD_M * driven
        out.rows["T_before"][k] = group.between(tuple(poses[first].tolist()), tuple(poses[last].tolist()))
        out.rows["information"][k] = np.square(space.sigmas(*sigmas)) ** -1.0
    return out


def frame_of(
    space: Geometry, base: tuple[int, Numbers], at: Numbers, landmarks: Mapping[int, tuple[Numbers, float]]
) -> Frames:
    """Return one frame.

    Parameters
    ----------
    base : lasting id and pose of a vertex that stays; at : pose of the frame
    landmarks : that were seen from its keyframes: by lasting id the position or pose [m, rad] and the weight [1/m^2]
    """
    group, d, members = space.group, space.dimensions, list[tuple[int, int, Numbers, float]]()
    for landmark, (value, weight) in sorted(landmarks.items()):
        ends = np.array(value[:d])[None]
        if len(value) == space.pose.size:
            ends = np.concatenate((ends, ends + _TIP_M * space.turn(value).T))
        for axis, end in enumerate(ends.tolist()):
            members.append((landmark, axis, group.act(group.inverse(at), tuple(end)), weight))
    out = Frames(np.empty(1, frame_type(space)), np.array(members, dtype=member_type(space)))
    out.rows[0] = base[0], group.between(base[1], at), len(members), space.identity, np.zeros(space.dof)
    return out


def weight_at(distance_m: float) -> float:
    """Return the weight of a sighting of a landmark at a distance [1/m^2]."""
    return max(_LEAST_M, _SIGMA * distance_m) ** -2


def frame_type(space: Geometry) -> np.dtype[np.void]:
    """Return the type of the rows of frames."""
    poses = [(name, "<f8", (space.pose.size,)) for name in ("T_base", "T_before")]
    return np.dtype([("base", "<i8"), poses[0], ("count", "<i8"), poses[1], ("information", "<f8", (space.dof,))])


def member_type(space: Geometry) -> np.dtype[np.void]:
    """Return the type of the rows of their landmarks."""
    return np.dtype([("landmark", "<i8"), ("axis", "<i8"), ("point", "<f8", (space.dimensions,)), ("weight", "<f8")])
