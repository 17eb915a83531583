"""Sightings that are far from their landmark."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.check.finding import Finding, Severity
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.typing import Array, Index, Mask

_LEAST, _NEAR_M, _SIGMAS, _OF_MEDIAN = 5, 0.5, 4.0, 1.48
_OUTLIERS, _NOTED = 0.12, 0.02  # part of the sightings: a run leaves out a few that contradict its map


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The place of each identity, and of which place each sighting is.

    Attributes
    ----------
    at, spread : (m, n) the medians, and (m,) how far sightings are from them [m]
    of : (k,) the place of each sighting; -1 of those that are not compared
    """

    at: Array
    spread: Array
    of: Index


def check_outliers(s: SightingColumns, points: Array, inside: Mask, dimensions: int) -> Iterator[Finding]:
    """Find sightings that are far from their landmark.

    Parameters
    ----------
    points : (k, 3) where each sighting puts its landmark, in map
    inside : (k,) of the sightings whose poses are known
    """
    places = _places(s, points[:, :dimensions], inside)
    compared = np.flatnonzero(places.of >= 0)
    far = compared[_is_far(s, points[compared, :dimensions], compared, places)] if len(compared) else compared
    if len(far) > _NOTED * len(compared):
        share, first_ns = len(far) / len(compared), int(s.stamp_ns[far].min())
        severity: Severity = "warning" if share > _OUTLIERS else "note"
        limit = _OUTLIERS if severity == "warning" else _NOTED
        text = f"{s.topic}: {share:.1%} of the sightings are far from their landmark: a wrong place, or a wrong id"
        yield Finding("outliers", severity, share, limit, "part", text, s.topic, first_ns, len(far))


def _places(s: SightingColumns, points: Array, inside: Mask) -> Places:
    usable = inside & np.isfinite(points).all(axis=1)
    at: list[Array] = []
    spread: list[float] = []
    of = np.full(len(points), -1)
    for number, name in enumerate(s.names):
        chosen = np.flatnonzero((s.name == number) & usable)
        if name and len(chosen) >= _LEAST:
            of[chosen] = len(at)
            at.append(np.median(points[chosen], axis=0))
            spread.append(_OF_MEDIAN * float(np.median(np.linalg.norm(points[chosen] - at[-1], axis=1))))
    return Places(np.array(at).reshape(-1, points.shape[1]), np.array(spread), of)


def _is_far(s: SightingColumns, points: Array, chosen: Index, places: Places) -> Mask:
    """Return which are beyond their noise, and that of the others with their identity."""
    own = places.of[chosen]
    limit = np.maximum(_NEAR_M, _SIGMAS * np.maximum(s.sigmas[chosen], places.spread[own]))
    return np.asarray(np.linalg.norm(points - places.at[own], axis=1) > limit)
