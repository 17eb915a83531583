"""The errors of a path: absolute and relative errors of position and angle.

The absolute error (ATE) is the error of each pose after the whole path was aligned to the truth by a rigid motion,
without scale. The relative error (RPE) is the error of the motion over one second and over one metre, which is drift.
"""

from dataclasses import dataclass

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.lie import se3
from graph_slam_ros.maps.alignment import laid_on
from graph_slam_ros.runs.trajectory import Trajectory
from graph_slam_ros.typing import Array

Statistics = dict[str, float]

MAX_STAMP_DIFFERENCE_S = 0.05
STATISTICS = ("rmse", "median", "max")
_LONGEST = 3.0  # a motion is over one second, or one metre, where it is over up to three
_ROUNDING = 1e-6  # of stamps, which are seconds since 1970


@dataclass(frozen=True, slots=True)
class Drift:
    """Relative errors (RPE) of n motions, for each second or for each metre of the true path.

    Attributes
    ----------
    position : [m/s] or [m/m]
    angle : [rad/s] or [rad/m]; None if the truth has no orientation
    n : number of motions
    """

    position: Statistics
    angle: Statistics | None
    n: int


@dataclass(frozen=True, slots=True)
class PathError:
    """Errors of a path.

    Attributes
    ----------
    position_m, angle_rad : absolute errors (ATE), each as {rmse, median, max}; angle_rad is None without true
        orientations
    n : number of poses that have a true pose within 0.05 s
    of : number of poses of the path
    per_s, per_m : relative errors (RPE); None if no two poses are one to three seconds, or metres, apart
    """

    position_m: Statistics
    angle_rad: Statistics | None
    n: int
    of: int = 0
    per_s: Drift | None = None
    per_m: Drift | None = None


@dataclass(frozen=True, slots=True)
class Matched:
    """Poses of a path in the frame of the truth, and the truth at the same stamps."""

    path: Trajectory
    truth: Trajectory
    T_truth_path: se3.Pose

    @property
    def position_errors_m(self) -> Array:
        """Position errors (n,) of all poses."""
        return np.linalg.norm(self.path.poses[:, :3] - self.truth.poses[:, :3], axis=1)


def path_error(estimate: Trajectory, truth: Trajectory, dimensions: int = 2, *, align: bool = True) -> PathError:
    """Errors of one path.

    Raises GraphSlamError: fewer than two common stamps, or positions that leave the alignment open.

    Parameters
    ----------
    dimensions : 2: height, roll and pitch of both are left out
    align : lay the path on the truth first; without, both are taken to be in one frame
    """
    found = matched(estimate, truth, dimensions, align=align)
    path, reference = found.path, found.truth
    angles = angle_between(reference.poses, path.poses) if truth.has_orientation else None
    way = np.linalg.norm(np.diff(reference.poses[:, :3], axis=0), axis=1)
    return PathError(
        statistics(found.position_errors_m),
        None if angles is None else statistics(angles),
        len(path.stamps_s),
        len(estimate.stamps_s),
        drift(path, reference, reference.stamps_s),
        drift(path, reference, np.concatenate([[0.0], np.cumsum(way)])),
    )


def matched(estimate: Trajectory, truth: Trajectory, dimensions: int = 2, *, align: bool = True) -> Matched:
    """The poses of both that belong together, in the frame of the truth. As ``path_error``."""
    if dimensions == 2:
        estimate, truth = estimate.in_plane(), truth.in_plane()
    mine, reference = associate(estimate, truth)
    T = se3.IDENTITY
    if align:
        T = alignment(mine.poses[:, :dimensions], reference.poses[:, :dimensions])
    return Matched(mine.moved(T), reference, T)


def associate(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """The poses of both that belong together: nearest stamps, within 0.05 s, none before or after the truth.

    Raises GraphSlamError: fewer than two.
    """
    stamps_s, known_s = estimate.stamps_s, truth.stamps_s
    after = np.minimum(np.clip(np.searchsorted(known_s, stamps_s), 1, None), len(known_s) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(stamps_s - known_s[before] <= known_s[after] - stamps_s, before, after)
    inside = (stamps_s >= known_s[0]) & (stamps_s <= known_s[-1])
    near = np.abs(known_s[nearest] - stamps_s) <= MAX_STAMP_DIFFERENCE_S + _ROUNDING
    mine = np.flatnonzero(inside & near)
    if len(mine) < 2:
        text = f"{len(mine)} of {len(stamps_s)} stamps are within {MAX_STAMP_DIFFERENCE_S} s of the truth's: "
        text += f"the estimate spans {_span(estimate)}, the truth {_span(truth)}"
        if not inside.any():
            text += ": another clock stamps odometry (use_sim_time?), or it is another drive"
        if len(np.unique(known_s)) < 0.5 * len(known_s):  # as numpy.savetxt rounds by default
            text += ", most of whose stamps are the same: write all their digits (%.9f)"
        raise GraphSlamError(text)
    return estimate.at(mine), truth.at(nearest[mine])


def alignment(points: Array, reference: Array) -> se3.Pose:
    """The rigid motion that takes points (n, 2) or (n, 3) nearest to their reference.

    Raises GraphSlamError: all points are in one place, or in space on a line.

    Of the plane where they have two coordinates: a rotation there cannot turn into the mirror image that turning over
    in space would allow.
    """
    dimensions = points.shape[1]
    moved = laid_on(PLANAR if dimensions == 2 else SPATIAL, reference, points)
    if moved is None:
        where = "in one place" if dimensions == 2 else "on a line"
        raise GraphSlamError(f"cannot align: all positions are {where}")
    pose: se3.Pose = tuple(se3.in_space(moved).tolist()) if dimensions == 2 else moved  # type: ignore[assignment]
    return pose


def drift(path: Trajectory, truth: Trajectory, at: Array) -> Drift | None:
    """Errors of the motions over one unit of ``at`` (n,), which never decreases, for each unit; None without any.

    Where the truth has no orientation, the difference of both displacements in the axes of the truth.
    """
    first = np.arange(len(at))
    last = np.searchsorted(at, at + 1.0 - _ROUNDING)
    ends = last < len(at)
    first, last = first[ends], last[ends]
    length = at[last] - at[first]
    near = length <= _LONGEST
    first, last, length = first[near], last[near], length[near]
    if not len(first):
        return None
    if not truth.has_orientation:
        (moved, true) = (t.poses[last, :3] - t.poses[first, :3] for t in (path, truth))
        return Drift(statistics(np.linalg.norm(moved - true, axis=1) / length), None, len(first))
    moved, true = (
        np.stack(se3.between(tuple(t.poses[first].T), tuple(t.poses[last].T)), axis=1) for t in (path, truth)
    )
    off = np.stack(se3.between(tuple(true.T), tuple(moved.T)), axis=1)
    angles = angle_between(true, moved)
    return Drift(statistics(np.linalg.norm(off[:, :3], axis=1) / length), statistics(angles / length), len(first))


def angle_between(a: Array, b: Array) -> Array:
    """Angles (n,) of the rotations between poses (n, 7)."""
    turn = np.stack(se3.between(tuple(a.T), tuple(b.T)), axis=1)[:, 3:]
    return 2.0 * np.arctan2(np.linalg.norm(turn[:, :3], axis=1), np.abs(turn[:, 3]))


def statistics(errors: Array) -> Statistics:
    """Root mean square, median and largest."""
    values = (np.sqrt(np.mean(np.square(errors))), np.median(errors), np.max(errors))
    return dict(zip(STATISTICS, map(float, values), strict=True))


def interpolated(truth: Trajectory, stamps_s: Array) -> Array:
    """True poses (n, 7) at stamps (n,), between neighbours at most twice 0.05 s apart; elsewhere NaN.

    Up to 0.05 s before the first and after the last, the motion of the truth goes on.
    """
    known_s, longest_s = truth.stamps_s, 2.0 * MAX_STAMP_DIFFERENCE_S
    after = np.clip(np.searchsorted(known_s, stamps_s), 1, max(1, len(known_s) - 1))
    before = after - 1
    after = np.minimum(after, len(known_s) - 1)
    # the motion that goes on is that of 0.1 s: of two poses nearer to one another it would be their noise
    after = np.where(stamps_s < known_s[0], np.searchsorted(known_s, known_s[0] + longest_s, "right") - 1, after)
    before = np.where(stamps_s > known_s[-1], np.searchsorted(known_s, known_s[-1] - longest_s), before)
    first, gap = known_s[before], known_s[after] - known_s[before]
    fraction = (stamps_s - first) / np.where(gap > 0.0, gap, 1.0)
    out = np.stack(se3.interpolate(tuple(truth.poses[before].T), tuple(truth.poses[after].T), fraction), axis=1)
    off_s = np.minimum(np.abs(stamps_s - first), np.abs(known_s[after] - stamps_s))
    outside_s = np.maximum(known_s[0] - stamps_s, stamps_s - known_s[-1])
    known = (outside_s <= MAX_STAMP_DIFFERENCE_S + _ROUNDING) & (gap > 0.0) & (gap <= longest_s + _ROUNDING)
    out[~(known | (off_s <= _ROUNDING))] = np.nan
    return out


def _span(t: Trajectory) -> str:
    return f"{t.stamps_s[0]:.3f} to {t.stamps_s[-1]:.3f} s"
