"""The check of bearings alone: as the robot turns to the left, bearings turn to the right."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.finding import Finding, Where
from graph_slam_ros.check.pairs import changes_by_motion, poses_at
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.typing import Array, Index

_LATER_S, _TURNED_RAD, _LEAST, _MIRRORED = 2.0, 0.25, 25, 0.5


def check_bearings(s: SightingColumns, path_ns: Index, path: Array) -> Iterator[Finding]:
    """Bearings in the plane that count to the right."""
    inside = (s.stamp_ns >= path_ns[0]) & (s.stamp_ns <= path_ns[-1])
    is_named = np.array([bool(name) for name in s.names], dtype=bool)[s.name]
    use = np.flatnonzero(np.isfinite(s.bearings) & inside & is_named)
    headings = np.stack(so3.log(tuple(poses_at(s.stamp_ns[use], path_ns, path)[:, 3:].T)), axis=1)[:, 2]
    each = changes_by_motion(s, s.bearings, headings, use, _LATER_S, _TURNED_RAD, (_turned, _turned))
    factor = float(np.median(each)) if len(each) >= _LEAST else 0.0
    if factor > _MIRRORED:
        text = (
            f"{s.topic}: bearings change by {factor:+.2f} rad for each radian that the robot turns to the left, and "
            "-1 is expected: do they count to the right, or does odometry turn the other way?"
        )
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": len(use)}
        yield Finding("mirrored", "error", factor, _MIRRORED, "rad/rad", text, **where)


def _turned(a: float, b: float) -> float:
    return float(se2.wrap(b - a))
