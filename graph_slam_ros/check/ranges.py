"""The check of ranges alone: from one sighting to the next a range changes by no more than the robot has driven."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.finding import Finding, Where
from graph_slam_ros.check.pairs import changes_by_motion, poses_at
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.typing import Array, Index

_LATER_S, _DRIVEN_M, _LEAST, _FASTEST = 30.0, 1.0, 20, 10.0
_MOST, _FEWEST = 1.3, 0.1  # m/m, which nearly none exceeds: feet, where beacons are ahead or behind


def check_ranges(s: SightingColumns, path_ns: Index, path: Array) -> Iterator[Finding]:
    """Ranges in other units than metres."""
    inside = (s.stamp_ns >= path_ns[0]) & (s.stamp_ns <= path_ns[-1])
    is_named = np.array([bool(name) for name in s.names], dtype=bool)[s.name]
    use = np.flatnonzero(np.isfinite(s.ranges) & inside & is_named)
    places = poses_at(s.stamp_ns[use], path_ns, path)[:, :3]
    each = changes_by_motion(s, s.ranges, places, use, _LATER_S, _DRIVEN_M, (_driven, _changed))
    factor, least = np.quantile(each, [0.5, _FEWEST]).tolist() if len(each) >= _LEAST else (0.0, 0.0)
    if factor > _FASTEST or least > _MOST:
        text = f"{s.topic}: ranges change by {factor:.3g} for each metre of odometry: are both metres?"
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": len(use)}
        yield Finding("units", "error", factor, _MOST, "m/m", text, **where)


def _driven(a: Array, b: Array) -> float:
    return float(np.linalg.norm(b - a))


def _changed(a: float, b: float) -> float:
    return abs(b - a)
