"""The same landmark, seen twice within a few seconds: drift is negligible in so short a time.

Ranges alone change from one sighting to the next by no more than the robot has driven; bearings alone turn to the right
as the robot turns to the left.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.check.columns import MOST, Columns, SightingColumns
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.typing import Array, Index, Mask

LATER_S = 6.0
"""Most time between both."""
ASSUMED_RANGE_M, ASSUMED_BEARING_RAD = 0.5, 0.02
"""Standard deviations of ranges and bearings whose noise nobody has stated."""
HALF = 0.5
"""Of the residuals: where so little is left with another explanation, that is right."""
TURNED_RAD, LEAST_TURNED = 0.25, 25
"""The least turn between two sightings that tells a mirror, and how many of these."""
_TYPICAL_M = 0.05  # what odometry and a detector err within a few seconds, at most, where nothing is wrong
_SOONEST_S, _MOVED, _MOST_PAIRS = 0.3, 0.15, 4000  # between both, at least: m or rad; of more, some at equal steps
_DRIVEN_M, _FASTEST = 1.0, 10.0  # _FASTEST: m/m, which no outliers make
_MOST, _FEWEST = 1.3, 0.1  # m/m, which nearly none exceeds: feet, where beacons are ahead or behind
_QUARTILE, _WORSE = 0.25, 3.0  # as a run allows for
_OF_RAYLEIGH = quantile(_QUARTILE, 2) ** 0.5  # the quartile of distances, in sigmas of an axis
_TINY = 1e-3  # m or rad: sigmas that were raised, and are less
_TOO_SMALL = 10.0  # of their sigmas, by which two of them differ
_BEARING_LATER_S, _MIRRORED = 2.0, 0.5  # in which a bearing changes by the turn; rad/rad, half-way from 0 to 1


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


def pairs_of(c: Columns, s: SightingColumns, which: Mask | None = None, later_s: float = LATER_S) -> Pairs:
    """Pairs of sightings between which the robot moved, at most so much later; of those with a position by default."""
    use = np.flatnonzero(s.located(c.path_ns) if which is None else which)
    order = use[np.argsort(s.stamp_ns[use], kind="stable")]
    seconds = ((s.stamp_ns - c.path_ns[0]) * 1e-9).tolist()
    names, found = s.name.tolist(), []
    recent: dict[int, deque[int]] = {}
    for k in order.tolist():
        held = recent.setdefault(names[k], deque())
        while held and seconds[k] - seconds[held[0]] > later_s:
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


def check_noise(c: Columns, s: SightingColumns, pairs: Pairs | None = None) -> Iterator[Finding]:
    """A covariance that nobody has measured: it was raised to the least that a replay allows, and that is too small.

    Pairs tell how small. No two ranges or bearings alone can be compared, but no sensor is so exact.
    """
    raised, sigma_m = _raised(c, s), float(np.median(s.sigmas))
    few = f"the covariance of {raised} of {len(s.stamp_ns)} sightings is nearly zero"
    if raised and pairs is not None and len(pairs.a):
        factor = float(np.median(pairs.residuals(s.points) / s.sigmas[pairs.a]))
        if factor > _TOO_SMALL:
            text, settings = (
                f"{few}, and two sightings of a landmark differ by {factor * sigma_m:.2g} m",
                _sigmas(s, pairs),
            )
            yield s.finding("noise_zero", "warning", factor, _TOO_SMALL, "sigmas", text, raised, settings=settings)
    elif raised and not np.isfinite(s.points).any():
        has_ranges = np.isfinite(s.ranges).any()
        sigma = f"sigma_m={ASSUMED_RANGE_M}" if has_ranges else f"sigma_rad={ASSUMED_BEARING_RAD}"
        settings, share = (f"{s.input}.noise=sigmas", f"{s.input}.{sigma}"), raised / len(s.stamp_ns)
        yield s.finding("noise_zero", "warning", share, MOST, "part", few, raised, settings=settings)


def _raised(c: Columns, s: SightingColumns) -> int:
    """The number of variances of an input that were raised; 0 unless it is most, and they are nearly zero."""
    raised = c.counters[s.input, "covariance_floored"]
    return raised if raised >= MOST * len(s.stamp_ns) and float(np.median(s.sigmas)) <= _TINY else 0


def _sigmas(s: SightingColumns, pairs: Pairs) -> tuple[str, ...]:
    """Settings that state the noise as pairs have it."""
    sigma_m = float(np.quantile(pairs.residuals(s.points), _QUARTILE)) / _OF_RAYLEIGH / 2.0**0.5
    sigma_rad = sigma_m / max(float(np.median(np.linalg.norm(s.points[pairs.a], axis=1))), sigma_m)
    sigmas = f"sigma_m={max(round(sigma_m, 3), 1e-3)}", f"sigma_rad={max(round(sigma_rad, 4), 1e-4)}"
    return tuple(f"{s.input}.{setting}" for setting in ("noise=sigmas", *sigmas))


def check_ranges(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """Ranges alone in other units than metres."""
    use = np.isfinite(s.ranges) & s.named(c.path_ns)
    pairs = pairs_of(c, s, use)
    driven_m = np.linalg.norm(pairs.motion[:, :3], axis=1)
    pairs, driven_m = pairs.some(driven_m > _DRIVEN_M), driven_m[driven_m > _DRIVEN_M]
    each = np.abs(s.ranges[pairs.b] - s.ranges[pairs.a]) / driven_m
    factor, least = np.quantile(each, [0.5, _FEWEST]).tolist() if len(each) >= LEAST_TURNED else (0.0, 0.0)
    if factor > _FASTEST or least > _MOST:
        text = f"ranges change by {factor:.3g} for each metre of odometry: are both metres?"
        yield s.finding("units", "error", factor, _MOST, "m/m", text, use.sum())


def check_bearings(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """Bearings alone, in the plane, that count to the right."""
    use = np.isfinite(s.bearings) & s.named(c.path_ns)
    pairs = pairs_of(c, s, use, _BEARING_LATER_S)
    turned = np.asarray(so3.log(tuple(pairs.motion[:, 3:].T))[2])
    pairs, turned = pairs.some(np.abs(turned) > TURNED_RAD), turned[np.abs(turned) > TURNED_RAD]
    each = se2.wrap(s.bearings[pairs.b] - s.bearings[pairs.a]) / turned
    factor = float(np.median(each)) if len(each) >= LEAST_TURNED else 0.0
    if factor > _MIRRORED:
        text = f"bearings change by {factor:+.2f} rad for each radian that the robot turns to the left, and "
        text += "-1 is expected: do they count to the right, or does odometry turn the other way?"
        yield s.finding("mirrored", "error", factor, _MIRRORED, "rad/rad", text, use.sum())
