"""Pairs of sightings of the same landmark, seen twice within a few seconds: drift is negligible in so short a time."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from graph_slam_ros.check.columns import Columns
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Array, Index, Mask

LATER_S = 6.0
"""Most time between both."""
_SOONEST_S, _MOVED, _MOST_PAIRS = 0.3, 0.15, 4000


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Two sightings of one landmark each, with the motion of odometry between them.

    Attributes
    ----------
    a, b : (n,) numbers of the earlier and later sighting
    motion : (n, 7) of the base from the earlier to the later
    dimensions : 2 where heights do not count
    """

    a: Index
    b: Index
    motion: Array
    dimensions: int = 3

    def residuals(self, points: Array, motion: Array | None = None) -> Array:
        """(n,) How far apart both sightings put the landmark, given (k, 3) the points of all in the base frame."""
        by = self.motion if motion is None else motion
        apart = np.stack(se3.act(tuple(by.T), tuple(points[self.b].T)), axis=1) - points[self.a]
        return np.linalg.norm(apart[:, : self.dimensions], axis=1)

    @property
    def turned(self) -> Array:
        """(n,) The rotation between both [rad]."""
        return np.linalg.norm(np.stack(so3.log(tuple(self.motion[:, 3:].T)), axis=1), axis=1)


def path_of(c: Columns) -> tuple[Index, Array]:
    """Odometry as a replay uses it, in order of stamp, one pose for each."""
    usable = np.isfinite(c.path).all(axis=1) & (np.abs(c.path).max(axis=1, initial=0.0) < 1e9)
    stamp_ns, first = np.unique(c.path_ns[usable], return_index=True)
    return stamp_ns, c.path[usable][first]


def poses_at(stamp_ns: Index, path_ns: Index, path: Array) -> Array:
    """Poses (n, 7) at stamps within the path, interpolated."""
    after = np.clip(np.searchsorted(path_ns, stamp_ns), 1, len(path_ns) - 1)
    before = after - 1
    part = np.clip((stamp_ns - path_ns[before]) / (path_ns[after] - path_ns[before]), 0.0, 1.0)
    return np.stack(se3.interpolate(tuple(path[before].T), tuple(path[after].T), part), axis=1)


def usable(s: SightingColumns, path_ns: Index) -> Mask:
    """Sightings (k,) with an identity and a point, within the time of odometry."""
    inside = (s.stamp_ns >= path_ns[0]) & (s.stamp_ns <= path_ns[-1])
    is_named = np.array([bool(name) for name in s.names], dtype=bool)[s.name]
    return np.asarray(inside & is_named & (np.abs(s.points) < 1e9).all(axis=1))


def pairs_of(s: SightingColumns, path_ns: Index, path: Array, dimensions: int) -> Pairs:
    """Pairs of sightings between which the robot moved, at most 6 s apart."""
    use = np.flatnonzero(usable(s, path_ns))
    order = use[np.argsort(s.stamp_ns[use], kind="stable")]
    seconds = ((s.stamp_ns - path_ns[0]) * 1e-9).tolist()
    names, found = s.name.tolist(), []
    recent: dict[int, deque[int]] = {}
    for k in order.tolist():
        held = recent.setdefault(names[k], deque())
        while held and seconds[k] - seconds[held[0]] > LATER_S:
            held.popleft()
        if held and seconds[k] - seconds[held[0]] > _SOONEST_S:
            found.append((held[0], k))
        held.append(k)
    a, b = np.array(found, dtype=np.int64).reshape(-1, 2).T
    at = [poses_at(s.stamp_ns[k], path_ns, path) for k in (a, b)]
    motion = np.stack(np.broadcast_arrays(*se3.between(tuple(at[0].T), tuple(at[1].T))), axis=1)
    out = Pairs(a, b, motion)
    moved = (np.linalg.norm(motion[:, :3], axis=1) > _MOVED) | (out.turned > _MOVED)
    chosen = np.flatnonzero(moved)
    if len(chosen) > _MOST_PAIRS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, _MOST_PAIRS).astype(np.int64)]
    return Pairs(a[chosen], b[chosen], motion[chosen], dimensions)


def changes_by_motion(
    s: SightingColumns,
    measured: Array,
    at: Array,
    chosen: Index,
    later_s: float,
    least: float,
    differ: tuple[Callable[[Any, Any], float], Callable[[float, float], float]],
) -> Array:
    """Return the change of what is measured of each landmark, per metre or radian that the robot has moved.

    Parameters
    ----------
    measured : (k,) of all sightings
    at : (m, ...) the pose of the robot at each chosen sighting, or a part of it
    chosen : (m,) the sightings that count
    later_s, least : how long after one sighting another may be, and how far the robot has moved in between
    differ : the motion between two of ``at``, and the change between two measured values
    """
    moved_between, changed_between = differ
    found = []
    for name in np.unique(s.name[chosen]):
        own = np.flatnonzero(s.name[chosen] == name)
        rows = own[np.argsort(s.stamp_ns[chosen[own]], kind="stable")].tolist()
        first = rows[0]
        for k in rows[1:]:
            if (s.stamp_ns[chosen[k]] - s.stamp_ns[chosen[first]]) * 1e-9 > later_s:
                first = k
            elif abs(moved := moved_between(at[first], at[k])) > least:
                found.append(changed_between(float(measured[chosen[first]]), float(measured[chosen[k]])) / moved)
                first = k
    return np.array(found)
