"""The same landmark, seen twice within a few seconds: drift is negligible in so short a time.

Ranges alone change from one sighting to the next by no more than the robot has driven; bearings alone turn to the right
as the robot turns to the left.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from graph_slam_ros.check.columns import Columns, SightingColumns
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.typing import Array, Index, Mask

LATER_S = 6.0
"""Most time between both."""
ASSUMED_RANGE_M, ASSUMED_BEARING_RAD = 0.5, 0.02
"""Standard deviations of ranges and bearings whose noise nobody has stated."""
_TYPICAL_M = 0.05  # what odometry and a detector err within a few seconds, at most, where nothing is wrong
_SOONEST_S, _MOVED, _MOST_PAIRS = 0.3, 0.15, 4000
_RANGE_LATER_S, _DRIVEN_M, _LEAST_RANGES, _FASTEST = 30.0, 1.0, 20, 10.0
_MOST, _FEWEST = 1.3, 0.1  # m/m, which nearly none exceeds: feet, where beacons are ahead or behind
_QUARTILE, _OF_RAYLEIGH, _WORSE = 0.25, 0.7585, 3.0
_RAISED, _TINY, _TOO_SMALL = 0.5, 1e-3, 10.0
_BEARING_LATER_S, _TURNED_RAD, _LEAST_BEARINGS, _MIRRORED = 2.0, 0.25, 25, 0.5


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

    def some(self, which: Mask) -> "Pairs":
        """Return some of the pairs."""
        return replace(self, a=self.a[which], b=self.b[which], motion=self.motion[which])

    def apart_m(self, points: Array, motion: Array | None = None) -> float:
        """The median of the residuals."""
        return float(np.median(self.residuals(points, motion)))

    @property
    def turned(self) -> Array:
        """(n,) The rotation between both [rad]."""
        return np.linalg.norm(np.stack(so3.log(tuple(self.motion[:, 3:].T)), axis=1), axis=1)


def poses_at(stamp_ns: Index, path_ns: Index, path: Array) -> Array:
    """Poses (n, 7) at stamps within the path, interpolated."""
    after = np.clip(np.searchsorted(path_ns, stamp_ns), 1, len(path_ns) - 1)
    before = after - 1
    part = np.clip((stamp_ns - path_ns[before]) / (path_ns[after] - path_ns[before]), 0.0, 1.0)
    return np.stack(se3.interpolate(tuple(path[before].T), tuple(path[after].T), part), axis=1)


def pairs_of(c: Columns, s: SightingColumns) -> Pairs:
    """Pairs of sightings between which the robot moved, at most 6 s apart."""
    use = np.flatnonzero(s.located(c.path_ns))
    order = use[np.argsort(s.stamp_ns[use], kind="stable")]
    seconds = ((s.stamp_ns - c.path_ns[0]) * 1e-9).tolist()
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
    at = [poses_at(s.stamp_ns[k], c.path_ns, c.path) for k in (a, b)]
    motion = np.stack(np.broadcast_arrays(*se3.between(tuple(at[0].T), tuple(at[1].T))), axis=1)
    moved = (np.linalg.norm(motion[:, :3], axis=1) > _MOVED) | (Pairs(a, b, motion).turned > _MOVED)
    chosen = np.flatnonzero(moved)
    if len(chosen) > _MOST_PAIRS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, _MOST_PAIRS).astype(np.int64)]
    return Pairs(a[chosen], b[chosen], motion[chosen], c.config.world.dimensions)


def noise_of(s: SightingColumns, pairs: Pairs) -> float:
    """Return by how much two sightings of a landmark differ within a few seconds [m], where nothing is wrong."""
    return 1.5 * (float(np.median(s.sigmas[pairs.a])) * 2.0**0.5 + _TYPICAL_M)


def noisier(s: SightingColumns, pairs: Pairs) -> Iterator[Finding]:
    """Sightings that are far worse than their noise says, by the smaller residuals of pairs, which no outlier has."""
    if not len(pairs.a):  # ranges or bearings alone
        return
    sigmas = np.hypot(s.sigmas[pairs.a], _TYPICAL_M) * 2.0**0.5
    factor = float(np.quantile(pairs.residuals(s.points) / sigmas, _QUARTILE)) / _OF_RAYLEIGH
    if factor > _WORSE:
        text = f"two sightings of a landmark differ by {factor:.1f} times what their noise says"
        yield s.finding(
            "over_confident", "warning", factor, _WORSE, "times", text, len(pairs.a), settings=_sigmas(s, pairs)
        )


def check_noise(c: Columns, s: SightingColumns, pairs: Pairs) -> Iterator[Finding]:
    """A covariance that nobody has measured: it was raised to the least that a replay allows, and that is too small."""
    raised, sigma_m = _raised(c, s), float(np.median(s.sigmas))
    if not raised or not len(pairs.a):
        return
    factor = float(np.median(pairs.residuals(s.points) / s.sigmas[pairs.a]))
    if factor > _TOO_SMALL:
        few = f"the covariance of {raised} of {len(s.stamp_ns)} sightings is nearly zero"
        text = f"{few}, and two sightings of a landmark differ by {factor * sigma_m:.2g} m"
        yield s.finding("noise_zero", "warning", factor, _TOO_SMALL, "sigmas", text, raised, settings=_sigmas(s, pairs))


def check_noise_alone(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """The same of ranges or bearings alone, of which no two can be compared: no sensor is so exact."""
    raised = _raised(c, s)
    if raised and not np.isfinite(s.points).any():
        text = f"the covariance of {raised} of {len(s.stamp_ns)} sightings is nearly zero"
        has_ranges = np.isfinite(s.ranges).any()
        sigma = f"sigma_m={ASSUMED_RANGE_M}" if has_ranges else f"sigma_rad={ASSUMED_BEARING_RAD}"
        settings, share = (f"{s.input}.noise=sigmas", f"{s.input}.{sigma}"), raised / len(s.stamp_ns)
        yield s.finding("noise_zero", "warning", share, _RAISED, "part", text, raised, settings=settings)


def _raised(c: Columns, s: SightingColumns) -> int:
    """The number of variances of an input that were raised; 0 unless it is most, and they are nearly zero."""
    raised = c.counters[s.input, "covariance_floored"]
    return raised if raised >= _RAISED * len(s.stamp_ns) and float(np.median(s.sigmas)) <= _TINY else 0


def _sigmas(s: SightingColumns, pairs: Pairs) -> tuple[str, ...]:
    """Settings that state the noise as pairs have it."""
    sigma_m = float(np.quantile(pairs.residuals(s.points), _QUARTILE)) / _OF_RAYLEIGH / 2.0**0.5
    sigma_rad = sigma_m / max(float(np.median(np.linalg.norm(s.points[pairs.a], axis=1))), sigma_m)
    sigmas = f"sigma_m={max(round(sigma_m, 3), 1e-3)}", f"sigma_rad={max(round(sigma_rad, 4), 1e-4)}"
    return tuple(f"{s.input}.{setting}" for setting in ("noise=sigmas", *sigmas))


def check_ranges(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """Ranges alone in other units than metres."""
    use = np.flatnonzero(np.isfinite(s.ranges) & s.named(c.path_ns))
    places = poses_at(s.stamp_ns[use], c.path_ns, c.path)[:, :3]
    each = _changes(s, use, s.ranges, places, _RANGE_LATER_S, _DRIVEN_M, lambda a, b: float(np.linalg.norm(b - a)))
    factor, least = np.quantile(np.abs(each), [0.5, _FEWEST]).tolist() if len(each) >= _LEAST_RANGES else (0.0, 0.0)
    if factor > _FASTEST or least > _MOST:
        text = f"ranges change by {factor:.3g} for each metre of odometry: are both metres?"
        yield s.finding("units", "error", factor, _MOST, "m/m", text, len(use))


def check_bearings(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """Bearings alone, in the plane, that count to the right."""
    use = np.flatnonzero(np.isfinite(s.bearings) & s.named(c.path_ns))
    headings = np.stack(so3.log(tuple(poses_at(s.stamp_ns[use], c.path_ns, c.path)[:, 3:].T)), axis=1)[:, 2]
    turned = lambda a, b: float(se2.wrap(b - a))  # noqa: E731
    each = _changes(s, use, s.bearings, headings, _BEARING_LATER_S, _TURNED_RAD, turned, turned)
    factor = float(np.median(each)) if len(each) >= _LEAST_BEARINGS else 0.0
    if factor > _MIRRORED:
        text = f"bearings change by {factor:+.2f} rad for each radian that the robot turns to the left, and "
        text += "-1 is expected: do they count to the right, or does odometry turn the other way?"
        yield s.finding("mirrored", "error", factor, _MIRRORED, "rad/rad", text, len(use))


def _changes(
    s: SightingColumns,
    chosen: Index,
    measured: Array,
    at: Array,
    later_s: float,
    least: float,
    moved_between: Callable[[Any, Any], float],
    changed: Callable[[float, float], float] = lambda a, b: b - a,
) -> Array:
    """Return the change of what is measured (k,) of each landmark, per metre or radian that the robot has moved.

    ``at`` is where it is at each ``chosen`` sighting, ``moved_between`` the motion between two of these, ``least`` in
    so many seconds.
    """
    found = []
    for name in np.unique(s.name[chosen]):
        own = np.flatnonzero(s.name[chosen] == name)
        rows = own[np.argsort(s.stamp_ns[chosen[own]], kind="stable")].tolist()
        first = rows[0]
        for k in rows[1:]:
            if (s.stamp_ns[chosen[k]] - s.stamp_ns[chosen[first]]) * 1e-9 > later_s:
                first = k
            elif abs(moved := moved_between(at[first], at[k])) > least:
                found.append(changed(float(measured[chosen[first]]), float(measured[chosen[k]])) / moved)
                first = k
    return np.array(found)
