"""Sightings that are far from their landmark, and those of them that have the id of another landmark."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from graph_slam_ros.check.finding import Finding, Severity, Where
from graph_slam_ros.check.sightings import SightingColumns
from graph_slam_ros.config.config import Config
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array, Index, Mask

_LEAST, _NEAR_M, _SIGMAS, _OF_MEDIAN = 5, 0.5, 4.0, 1.48
_OUTLIERS, _NOTED = 0.12, 0.02  # part of the sightings: a run leaves out a few that contradict its map
_FITS, _APART_NS, _FEWEST = 3.0, 1_000_000_000, 5
_TURNED_RAD = np.linspace(0.5, 2.0 * np.pi - 0.5, 16)
_LEAST_CHANCE, _FALSE_RATE = 0.01, 1e-5
_WRONG = 0.05


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


@dataclass(frozen=True, slots=True, eq=False)
class WrongIds:
    """Sightings that do not fit their own landmark, but another one.

    Attributes
    ----------
    share : of all sightings that are compared, less what fits by chance
    chance : part of sightings that would fit another landmark by chance
    false_rate : how often chance alone would give so many
    """

    share: float
    chance: float
    false_rate: float
    count: int
    first_ns: int


def check_outliers(
    s: SightingColumns, points: Array, inside: Mask, config: Config, others: Collection[str]
) -> Iterator[Finding]:
    """Find sightings with the id of another landmark, and others that are far from theirs.

    Parameters
    ----------
    points : (k, 3) where each sighting puts its landmark, in map
    inside : (k,) of the sightings whose poses are known
    others : identities of which another finding says that they are of two places
    """
    n = config.world.dimensions
    places = _places(s, points[:, :n], inside)
    compared = np.flatnonzero(places.of >= 0)
    if not len(compared):
        return
    far = compared[_is_far(s, points[compared, :n], compared, places)]
    wrong = wrong_ids(s, points[:, :n], places, far, others)
    if wrong is not None:
        yield _wrong(s, wrong, config)
    rest = len(far) - (wrong.count if wrong is not None else 0)
    if rest > _NOTED * len(compared):
        share, first_ns = len(far) / len(compared), int(s.stamp_ns[far].min())
        severity: Severity = "warning" if rest > _OUTLIERS * len(compared) else "note"
        limit = _OUTLIERS if severity == "warning" else _NOTED
        text = f"{s.topic}: {share:.1%} of the sightings are far from their landmark"
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


def wrong_ids(
    s: SightingColumns, points: Array, places: Places, far: Index, others: Collection[str]
) -> WrongIds | None:
    """Return how many of the far sightings fit another landmark; None if chance may give as many.

    Chance is measured: each far sighting is turned about its own landmark, which keeps its distance. Sightings of one
    identity within a second are one case, because a wrong pose makes all of them wrong.
    """
    known = np.array([name not in others for name in s.names])
    far = far[known[s.name[far]]]
    if len(far) < _FEWEST:
        return None
    tree = cKDTree(places.at)
    centre, sigma = places.at[places.of[far]], s.sigmas[far]
    fits = _fits(tree, points[far], sigma, places)
    away = points[far] - centre
    turned = [centre + _turned(away, angle) for angle in _TURNED_RAD]
    chance = np.mean([_fits(tree, at, sigma, places) for at in turned], axis=0)
    case = _cases(s, far)
    expected = max(float(chance[case].mean()), _LEAST_CHANCE)
    hits = int(fits[case].sum())
    false_rate = float(bdtrc(hits - 1, len(case), expected)) if hits else 1.0
    if hits < _FEWEST or false_rate > _FALSE_RATE:
        return None
    count = (float(fits.sum()) - expected * len(far)) / (1.0 - expected)
    first_ns = int(s.stamp_ns[far[fits]].min())
    share = count / int(np.count_nonzero(places.of >= 0))
    return WrongIds(share, expected, false_rate, round(count), first_ns)


def _fits(tree: cKDTree, points: Array, sigma: Array, places: Places) -> Mask:
    """Return which points are at the place of some landmark."""
    distance, nearest = tree.query(points)
    return np.asarray(distance <= _FITS * np.maximum(sigma, places.spread[nearest]))


def _turned(away: Array, angle: float) -> Array:
    """Vectors (k, 2 or 3), turned about the vertical."""
    if away.shape[1] == 3:
        return np.stack(se3.act((0.0, 0.0, 0.0, 0.0, 0.0, np.sin(angle / 2.0), np.cos(angle / 2.0)), tuple(away.T)), 1)
    c, s = np.cos(angle), np.sin(angle)
    return away @ np.array([[c, s], [-s, c]])


def _cases(s: SightingColumns, far: Index) -> Index:
    """The first of each run of one identity, by its number in ``far``."""
    order = np.lexsort((s.stamp_ns[far], s.name[far]))
    name, stamp_ns = s.name[far][order], s.stamp_ns[far][order]
    begins = np.concatenate([[True], (np.diff(name) != 0) | (np.diff(stamp_ns) > _APART_NS)])
    return np.asarray(order[begins])


def _wrong(s: SightingColumns, found: WrongIds, config: Config) -> Finding:
    guarded = config.robust.decide
    severity: Severity = "note" if guarded and found.share <= _WRONG else "warning"
    text = (
        f"{s.topic}: {found.share:.1%} of the sightings have the id of another landmark: they are far from their own "
        f"and at another one's place (by chance that were {found.chance:.0%} of those far from their own)"
    )
    where: Where = {"topic": s.topic, "first_ns": found.first_ns, "count": found.count}
    settings = () if guarded else ("robust.decide=true",)
    return Finding("ids_wrong", severity, found.share, _WRONG, "part", text, settings=settings, **where)
