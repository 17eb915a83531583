"""Checks of identities by an estimate that puts each sighting into the map.

One id is at two places, a landmark was moved, or sightings are far from their landmark.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.check.columns import SightingColumns
from graph_slam_ros.chi_square import quantile
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.slam.levels import SIGMAS
from graph_slam_ros.typing import Array, Index, Mask

_LEAST, _IN_EACH, _PART = 12, 5, 0.05  # sightings of an id, and at each of its places
_APART_M, _SIGMAS, _WIDTHS = 0.5, 8.0, 6.0  # between both places, at least: of a sighting, of what lies around them
_ROUNDS, _QUANTILE, _FIRST = 10, 95.0, 6  # of two medians; percent that are no outliers; one part that is the first
_IN_TURN, _EXCHANGED, _MOST_MOVED = 0.9, 0.4, 3  # part on one side of a cut; of the way between two; landmarks
_OUTLIERS, _NOTED = 0.12, 0.02  # part of the sightings: a run leaves out a few that contradict its map


@dataclass(frozen=True, slots=True, eq=False)
class TwoPlaces:
    """An identity whose sightings are at two places, with nothing between them.

    Attributes
    ----------
    first, second : (3,) in map; ``first`` is the earlier, or the one of most sightings
    share : part of the sightings at the second
    since_ns : when it moved; None where both places are seen in turn
    first_ns : of its sightings at the second place, the first
    """

    name: str
    first: Array
    second: Array
    share: float
    count: int
    since_ns: int | None
    first_ns: int

    @property
    def apart_m(self) -> float:
        """The distance between both."""
        return float(np.linalg.norm(self.second - self.first))


def at_two_places(s: SightingColumns, points: Array, path_ns: Index, dimensions: int) -> list[TwoPlaces]:
    """Identities that are of two places, by turns or one after the other."""
    points = points[:, :dimensions]
    use = s.located(path_ns) & np.isfinite(points).all(axis=1)
    found = []
    for number, name in enumerate(s.names):
        chosen = np.flatnonzero(use & (s.name == number))
        if len(chosen) >= _LEAST and (two := _two_places(name, chosen, s, points)) is not None:
            found.append(two)
    return found


def _two_places(name: str, chosen: Index, s: SightingColumns, points: Array) -> TwoPlaces | None:
    chosen = chosen[np.argsort(s.stamp_ns[chosen], kind="stable")]
    at, sigma_m = points[chosen], float(np.median(s.sigmas[chosen]))
    near = _parted(at)
    if near.all() or not near.any():
        return None
    a, b = np.median(at[near], axis=0), np.median(at[~near], axis=0)
    widths = [float(np.median(np.linalg.norm(at[part] - centre, axis=1))) for part, centre in ((near, a), (~near, b))]
    apart_m, fewest = float(np.linalg.norm(b - a)), int(min(near.sum(), (~near).sum()))
    least_m = max(_APART_M, _SIGMAS * sigma_m, _WIDTHS * sum(widths))
    if fewest < max(_IN_EACH, _PART * len(at)) or not apart_m >= least_m:
        return None
    before = np.cumsum(near)[:-1] / np.arange(1, len(at))
    after = (near.sum() - np.cumsum(near)[:-1]) / np.arange(len(at) - 1, 0, -1)
    cut = int(np.argmax(np.abs(before - after)))
    in_turn = abs(before[cut] - after[cut]) <= _IN_TURN or min(cut + 1, len(at) - cut - 1) < _IN_EACH
    first_is_near = near.mean() > 0.5 if in_turn else before[cut] > 0.5
    first, second = (a, b) if first_is_near else (b, a)
    at_second = ~near if first_is_near else near
    stamps_ns = s.stamp_ns[chosen]
    since_ns = None if in_turn else int(stamps_ns[cut + 1])
    return TwoPlaces(name, first, second, float(at_second.mean()), len(at), since_ns, int(stamps_ns[at_second][0]))


def _parted(at: Array) -> Mask:
    """Two medians: from the first sightings, and from the farthest of them but for outliers."""
    a = np.median(at[: max(4, len(at) // _FIRST)], axis=0)
    away = np.linalg.norm(at - a, axis=1)
    b = at[np.argmax(np.where(away <= np.percentile(away, _QUANTILE), away, -1.0))]
    near = np.ones(len(at), dtype=bool)
    for _ in range(_ROUNDS):
        near = np.asarray(np.linalg.norm(at - a, axis=1) <= np.linalg.norm(at - b, axis=1))
        if near.all() or not near.any():
            break
        a, b = np.median(at[near], axis=0), np.median(at[~near], axis=0)
    return near


def check_moved(s: SightingColumns, found: list[TwoPlaces]) -> Iterator[Finding]:
    """Landmarks that stand elsewhere from some time on; two that change places have exchanged their identities."""
    moved, exchanged = [one for one in found if one.since_ns is not None], set()
    for k, one in enumerate(moved):
        for other in moved[k + 1 :]:
            ends = np.linalg.norm(one.second - other.first), np.linalg.norm(other.second - one.first)
            if max(ends) < _EXCHANGED * one.apart_m:
                exchanged |= {one.name, other.name}
                both = f"landmarks {one.name} and {other.name}, {one.apart_m:.1f} m apart,"
                yield _of(one, "ids_exchanged", f"{s.topic}: {both} exchange their ids", s)
    rest = [one for one in moved if one.name not in exchanged]
    if len(rest) > _MOST_MOVED:
        text = f"{s.topic}: {len(rest)} landmarks are elsewhere after some time: the robot was carried, or slipped"
        first_ns = min(one.first_ns for one in rest)
        yield Finding("map_breaks", "note", len(rest), _MOST_MOVED, "landmarks", text, s.topic, first_ns, len(rest))
        return
    for one in rest:
        text = f"{s.topic}: landmark {one.name} was moved: after some time it is {one.apart_m:.1f} m away"
        yield _of(one, "landmark_moved", text, s)


def _of(one: TwoPlaces, code: str, text: str, s: SightingColumns) -> Finding:
    return Finding(code, "warning", one.apart_m, _APART_M, "m", text, s.topic, one.first_ns, one.count)


def check_reused(s: SightingColumns, found: list[TwoPlaces]) -> Iterator[Finding]:
    """Identities that are seen at two places by turns."""
    reused = [one for one in found if one.since_ns is None]
    if len(reused) > _MOST_MOVED:
        text = f"{s.topic}: {len(reused)} of {sum(map(bool, s.names))} ids are seen at more than one place"
        first_ns = min(one.first_ns for one in reused)
        yield Finding("ids_unsure", "warning", len(reused), _MOST_MOVED, "identities", text, s.topic, first_ns)
        return
    for one in reused:
        apart = f"{one.apart_m:.1f} m apart ({one.share:.0%} of its sightings are at the second)"
        text = f"{s.topic}: id {one.name} is seen at two places, {apart}"
        yield _of(one, "id_reused", text, s)


def check_outliers(s: SightingColumns, points: Array, inside: Mask, dimensions: int) -> Iterator[Finding]:
    """Find sightings that put their landmark (``points`` in map) beyond their noise, and that of the others."""
    at, far, compared = points[:, :dimensions], np.zeros(len(points), dtype=bool), 0
    usable = inside & np.isfinite(at).all(axis=1)
    for number, name in enumerate(s.names):
        own = np.flatnonzero((s.name == number) & usable)
        if name and len(own) >= _IN_EACH:
            away = np.linalg.norm(at[own] - np.median(at[own], axis=0), axis=1)
            spread = float(np.median(away)) / quantile(0.5, 1) ** 0.5
            far[own] = away > np.maximum(_APART_M, SIGMAS * np.maximum(s.sigmas[own], spread))
            compared += len(own)
    if (count := int(far.sum())) > _NOTED * compared:
        share, first_ns = count / compared, int(s.stamp_ns[far].min())
        severity: Severity = "warning" if share > _OUTLIERS else "note"
        limit = _OUTLIERS if severity == "warning" else _NOTED
        text = f"{s.topic}: {share:.1%} of the sightings are far from their landmark: a wrong place, or a wrong id"
        yield Finding("outliers", severity, share, limit, "part", text, s.topic, first_ns, count)
