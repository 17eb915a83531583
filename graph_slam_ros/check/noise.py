"""Checks of the noise that sightings state, by pairs of sightings."""

from collections.abc import Iterator

import numpy as np

from graph_slam_ros.check.columns import Columns
from graph_slam_ros.check.finding import Finding, Where
from graph_slam_ros.check.pairs import Pairs
from graph_slam_ros.check.sightings import SightingColumns

TYPICAL_M = 0.05
"""What odometry and a detector err within a few seconds, at most, where nothing is wrong."""
ASSUMED_RANGE_M, ASSUMED_BEARING_RAD = 0.5, 0.02
"""Standard deviations of ranges and bearings whose noise nobody has stated."""
_QUARTILE, _OF_RAYLEIGH, _WORSE = 0.25, 0.7585, 3.0
_RAISED, _TINY, _TOO_SMALL = 0.5, 1e-3, 10.0


def noise_of(s: SightingColumns, pairs: Pairs) -> float:
    """Return by how much two sightings of a landmark differ within a few seconds [m], where nothing is wrong."""
    return 1.5 * (float(np.median(s.sigmas[pairs.a])) * 2.0**0.5 + TYPICAL_M)


def noisier(s: SightingColumns, pairs: Pairs) -> Iterator[Finding]:
    """Sightings that are far worse than their noise says, by the smaller residuals of pairs, which no outlier has."""
    if not len(pairs.a):  # ranges or bearings alone
        return
    sigmas = np.hypot(s.sigmas[pairs.a], TYPICAL_M) * 2.0**0.5
    factor = float(np.quantile(pairs.residuals(s.points) / sigmas, _QUARTILE)) / _OF_RAYLEIGH
    if factor > _WORSE:
        text = f"{s.topic}: two sightings of a landmark differ by {factor:.1f} times what their noise says"
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": len(pairs.a)}
        yield Finding("over_confident", "warning", factor, _WORSE, "times", text, settings=_sigmas(s, pairs), **where)


def check_noise(c: Columns, s: SightingColumns, pairs: Pairs) -> Iterator[Finding]:
    """A covariance that nobody has measured: it was raised to the least that a replay allows, and that is too small."""
    raised, sigma_m = _raised(c, s), float(np.median(s.sigmas))
    if not raised or not len(pairs.a):
        return
    factor = float(np.median(pairs.residuals(s.points) / s.sigmas[pairs.a]))
    if factor > _TOO_SMALL:
        text = (
            f"{s.topic}: the covariance of {raised} of {len(s.stamp_ns)} sightings is nearly zero, and two sightings "
            f"of a landmark differ by {factor * sigma_m:.2g} m"
        )
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": raised}
        settings = _sigmas(s, pairs)
        yield Finding("noise_zero", "warning", factor, _TOO_SMALL, "sigmas", text, settings=settings, **where)


def check_noise_alone(c: Columns, s: SightingColumns) -> Iterator[Finding]:
    """The same of ranges or bearings alone, of which no two can be compared: no sensor is so exact."""
    raised = _raised(c, s)
    if raised and not np.isfinite(s.points).any():
        text = f"{s.topic}: the covariance of {raised} of {len(s.stamp_ns)} sightings is nearly zero"
        has_ranges = np.isfinite(s.ranges).any()
        sigma = f"sigma_m={ASSUMED_RANGE_M}" if has_ranges else f"sigma_rad={ASSUMED_BEARING_RAD}"
        settings = (f"{s.input}.noise=sigmas", f"{s.input}.{sigma}")
        where: Where = {"topic": s.topic, "first_ns": int(s.stamp_ns[0]), "count": raised, "settings": settings}
        yield Finding("noise_zero", "warning", raised / len(s.stamp_ns), _RAISED, "part", text, **where)


def _raised(c: Columns, s: SightingColumns) -> int:
    """The number of variances of an input that were raised; 0 unless it is most, and they are nearly zero."""
    raised = c.counters.as_dict().get(s.input, {}).get("covariance_floored", 0)
    return raised if raised >= _RAISED * len(s.stamp_ns) and float(np.median(s.sigmas)) <= _TINY else 0


def _sigmas(s: SightingColumns, pairs: Pairs) -> tuple[str, ...]:
    """Settings that state the noise as pairs have it."""
    sigma_m = float(np.quantile(pairs.residuals(s.points), _QUARTILE)) / _OF_RAYLEIGH / 2.0**0.5
    sigma_rad = sigma_m / max(float(np.median(np.linalg.norm(s.points[pairs.a], axis=1))), sigma_m)
    settings = (
        "noise=sigmas",
        f"sigma_m={max(round(sigma_m, 3), 1e-3)}",
        f"sigma_rad={max(round(sigma_rad, 4), 1e-4)}",
    )
    return tuple(f"{s.input}.{setting}" for setting in settings)
