"""Stretches in which odometry and the map do not agree on the motion: wheels that slip, a robot that is carried."""

import numpy as np

from graph_slam_ros.check.columns import Columns
from graph_slam_ros.check.finding import Finding, Severity, Where
from graph_slam_ros.lie import se3
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.typing import Array, Index

_TOGETHER = 5  # steps between keyframes that are summed: one is as rough as its landmarks
_LEAST_WINDOWS = 20
_SIGMA = 1.4826  # of a median absolute deviation
_SIGMAS, _PART = 6.0, 0.1
_LEAST_M, _LEAST_RAD = 0.15, 0.3
_LARGE_SIGMAS, _LARGE_M, _LARGE_RAD = 12.0, 0.5, 0.8


def check_slips(c: Columns, slam: GraphSlam) -> tuple[Finding, int] | None:
    """Find the stretch in which odometry is worst, if it is far worse there than in the rest of the drive.

    The errors of odometry's motion are summed over a few steps between keyframes. Their scale is that of the middle
    half of them, so a wrong factor, which all of them have, is none.

    Returns
    -------
    The finding, from the stamp on at which the stretch begins, and the stamp at which it ends.
    """
    errors, size, stamps_ns = _errors(slam)
    if len(errors) < _LEAST_WINDOWS:
        return None
    errors = errors - np.median(errors, axis=0)
    scale = _SIGMA * np.median(np.abs(errors), axis=0)
    least, large = np.array([_LEAST_M, _LEAST_RAD]), np.array([_LARGE_M, _LARGE_RAD])
    excess = np.abs(errors) / np.maximum(np.maximum(_SIGMAS * scale, least), _PART * size)
    k, part = np.unravel_index(int(np.argmax(excess)), excess.shape)
    if excess[k, part] <= 1.0:
        return None
    error, unit = float(errors[k, part]), ("m", "rad")[part]
    is_large = abs(error) > max(large[part], _LARGE_SIGMAS * scale[part])
    severity: Severity = "warning" if is_large else "note"
    many = np.count_nonzero((excess > 1.0).any(axis=1))
    by = f"{('drives', 'turns')[part]} {abs(error):.2f} {unit} {'less' if error < 0.0 else 'more'} than odometry says"
    if abs(error) > size[k, part]:
        by = f"is elsewhere than odometry says, by {abs(error):.2f} {unit}"
    text = (
        f"{c.odometry.topic}: by the landmarks the robot {by}, in a stretch of "
        f"{1e-9 * (stamps_ns[k + _TOGETHER] - stamps_ns[k]):.0f} s, where {scale[part]:.2f} {unit} is usual: its "
        "wheels slip, or it is carried or held"
    )
    where: Where = {"topic": c.odometry.topic, "first_ns": int(stamps_ns[k]), "count": int(many)}
    limit = float(np.abs(error) / excess[k, part])
    return Finding("odometry_slips", severity, abs(error), limit, unit, text, **where), int(stamps_ns[k + _TOGETHER])


def _errors(slam: GraphSlam) -> tuple[Array, Array, Index]:
    """Errors (n, 2) of odometry ahead and in heading over a few steps, how much it says it moved, and stamps."""
    own, estimate = (se3.in_space(poses).reshape(-1, 7) for poses in (slam.keyframes.poses, slam.trajectory()))
    order = np.argsort(slam.keyframes.stamps_ns, kind="stable")
    stamps_ns, own, estimate = slam.keyframes.stamps_ns[order], own[order], estimate[order]
    if len(own) <= _TOGETHER:
        return np.empty((0, 2)), np.empty((0, 2)), stamps_ns
    stated, found = (se3.between(tuple(poses[:-1].T), tuple(poses[1:].T)) for poses in (own, estimate))
    error = np.stack(se3.local(found, stated), axis=1)
    decided = {index for alarm in slam.alarms if (index := getattr(alarm, "segment", None)) is not None}
    begins = np.isin(order, [index for index in slam.segments if index not in decided])
    error[begins[1:]] = 0.0  # odometry was restarted or jumps there, which is another finding
    moved = np.stack(se3.local(stated, se3.IDENTITY), axis=1)
    sizes = np.stack([np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)], axis=1)
    kernel = np.ones(_TOGETHER)
    columns = (error[:, [0, 5]], sizes)
    summed = [np.stack([np.convolve(x, kernel, "valid") for x in rows.T], axis=1) for rows in columns]
    return summed[0], summed[1], stamps_ns
