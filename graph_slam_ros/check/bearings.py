"""The check of bearings alone: as the robot turns to the left, bearings turn to the right."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.finding import Finding, Where
from graph_slam_ros.check.pairs import poses_at
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.lie import so3
from graph_slam_ros.typing import Array, Index

_LATER_S, _TURNED_RAD, _LEAST, _MIRRORED = 2.0, 0.25, 25, 0.5


def check_bearings(s: SightingColumns, path_ns: Index, path: Array) -> Iterator[Finding]:
    """Bearings in the plane that count to the right."""
    inside = (s.stamp_ns >= path_ns[0]) & (s.stamp_ns <= path_ns[-1])
    is_named = np.array([bool(name) for name in s.names], dtype=bool)[s.name]
    use = np.flatnonzero(np.isfinite(s.bearings) & inside & is_named)
    headings = np.stack(so3.log(tuple(poses_at(s.stamp_ns[use], path_ns, path)[:, 3:].T)), axis=1)[:, 2]
    changes = [_changes(s, use[s.name[use] == k], headings[s.name[use] == k]) for k in np.unique(s.name[use])]
    each = np.concatenate(changes) if changes else np.empty(0)
    factor = float(np.median(each)) if len(each) >= _LEAST else 0.0
    if factor > _MIRRORED:
        text = (
            f"{s.topic}: bearings change by {factor:+.2f} rad for each radian that the robot turns to the left, and "
            "-1 is expected: do they count to the right, or does odometry turn the other way?"
        )
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": len(use)}
        yield Finding("mirrored", "error", factor, _MIRRORED, "rad/rad", text, **where)


def _changes(s: SightingColumns, chosen: Index, headings: Array) -> Array:
    """The change of the bearings of one landmark per radian turned, between sightings within two seconds."""
    order = np.argsort(s.stamp_ns[chosen], kind="stable")
    stamp_ns, bearings, headings = s.stamp_ns[chosen][order], s.bearings[chosen][order], headings[order]
    found, first = [], 0
    for k in range(1, len(order)):
        if (stamp_ns[k] - stamp_ns[first]) * 1e-9 > _LATER_S:
            first = k
        elif abs(turned := _wrapped(headings[k] - headings[first])) > _TURNED_RAD:
            found.append(_wrapped(bearings[k] - bearings[first]) / turned)
            first = k
    return np.array(found)


def _wrapped(angle: float) -> float:
    return float(np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi)
