"""The check of ranges alone: from one sighting to the next a range changes by no more than the robot has driven."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.finding import Finding, Where
from graph_slam_ros.check.pairs import poses_at
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
    changes = [_changes(s, use[s.name[use] == k], places[s.name[use] == k]) for k in np.unique(s.name[use])]
    each = np.concatenate(changes) if changes else np.empty(0)
    factor, least = np.quantile(each, [0.5, _FEWEST]).tolist() if len(each) >= _LEAST else (0.0, 0.0)
    if factor > _FASTEST or least > _MOST:
        text = f"{s.topic}: ranges change by {factor:.3g} for each metre of odometry: are both metres?"
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": len(use)}
        yield Finding("units", "error", factor, _MOST, "m/m", text, **where)


def _changes(s: SightingColumns, chosen: Index, places: Array) -> Array:
    """The change of the ranges of one landmark per metre driven, between sightings a metre or more apart."""
    order = np.argsort(s.stamp_ns[chosen], kind="stable")
    stamp_ns, ranges, places = s.stamp_ns[chosen][order], s.ranges[chosen][order], places[order]
    found, first = [], 0
    for k in range(1, len(order)):
        if (stamp_ns[k] - stamp_ns[first]) * 1e-9 > _LATER_S:
            first = k
        elif (driven_m := float(np.linalg.norm(places[k] - places[first]))) > _DRIVEN_M:
            found.append(abs(ranges[k] - ranges[first]) / driven_m)
            first = k
    return np.array(found)
