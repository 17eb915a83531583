"""The surface of scores about the best point of a search: it is moved until the best point stays at its centre."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.search import Range
from graph_slam_ros.tools.fleet.surface import LONGEST, STEP, Surface, design
from graph_slam_ros.typing import Array

_ROUNDS = 8
_NEAR = 0.4 * STEP  # a best point so near to the centre is found
_HELPS = 1e-3  # of the sum of scores: a step that gains less does not help
_CLEAR = 2.0  # nats, by which a point is clearly better than another (95 % of a likelihood ratio)
_CLEAR_EACH = 0.02  # the same of another score, for each recording


class Scorer(Protocol):
    """Scores points: ``is_likelihood`` says whether scores are -log p [nats]."""

    is_likelihood: bool

    def scores(self, points: Sequence[Mapping[str, float]], recordings: Sequence[int]) -> list[list[float]]:
        """The scores of each point with each recording, a list for each point."""


@dataclass(frozen=True, slots=True)
class Fit:
    """The surface about the best point.

    Attributes
    ----------
    centre : what was searched, with the centre as its value
    free : (p,) which of these are determined
    sigmas : of the logarithms of all that were searched
    recordings : those of the surface
    longest : how far from the centre the best values are looked for, as a factor's logarithm
    """

    centre: list[Range]
    surface: Surface
    free: NDArray[np.bool_]
    sigmas: dict[str, float]
    recordings: list[int]
    longest: float = LONGEST

    def values(self, without: int | None = None) -> dict[str, float]:
        """The best values, as all recordings have them, or all but one."""
        left = None if without is None else self.recordings.index(without)
        moved = zip(self.centre, self.surface.offset(self.free, left, self.longest), self.free, strict=True)
        return {one.name: one.at(x) for one, x, is_free in moved if is_free}


def fit_about(used: Sequence[Range], best: Mapping[str, float], runs: Scorer, recordings: Sequence[int]) -> Fit:
    """Put surfaces about the best point, and about theirs, until it stays. What they do not determine is configured."""
    centre, sigmas = [replace(one, value=best[one.name]) for one in used], dict[str, float]()
    before: tuple[float, Fit] | None = None
    doubtful: set[str] = set()
    for left in reversed(range(_ROUNDS)):
        fit, sums = _surface(centre, runs, recordings, sigmas)
        if before is not None and sums[0] > before[0] - _HELPS:  # the last step did not help: it is there, or near
            return replace(fit if sums[0] <= before[0] else before[1], longest=_NEAR)
        clear = _CLEAR if runs.is_likelihood else _CLEAR_EACH * len(fit.recordings)
        offset = fit.surface.offset(fit.free) + np.where(fit.free, 0.0, _downhill(sums, len(centre), clear))
        is_far = bool((np.abs(offset) > _NEAR).any())
        if not left or (fit.free.all() and not is_far) or not (fit.free.any() or is_far):
            break
        flat = {one.name for one, x, is_free in zip(centre, offset, fit.free, strict=True) if not is_free and not x}
        dropped = flat if not is_far else flat & doubtful
        before, doubtful = None if dropped else (float(sums[0]), fit), flat
        moved = [replace(one, value=one.at(x)) for one, x in zip(centre, offset, strict=True)]
        centre = [one for one in moved if one.name not in dropped]
    return fit


def _surface(
    centre: list[Range], runs: Scorer, recordings: Sequence[int], sigmas: dict[str, float]
) -> tuple[Fit, Array]:
    """The surface about a centre, and the sums of the scores at its design. It changes ``sigmas``."""
    points = [{one.name: one.at(x) for one, x in zip(centre, xs, strict=True)} for xs in design(len(centre))]
    scores = np.array(runs.scores(points, recordings)).T
    kept = np.isfinite(scores).all(axis=1)
    if not kept.any():
        raise GraphSlamError("no trial finished about the best one: each recording has a run that failed")
    surface = Surface.through(scores[kept], is_likelihood=runs.is_likelihood)
    free = surface.determined()
    for k, one in enumerate(centre):
        sigmas[one.name] = float(surface.sigmas(free | (np.arange(len(free)) == k))[k])
    some = [k for k, is_kept in zip(recordings, kept, strict=True) if is_kept]
    return Fit(centre, surface, free, dict(sigmas), some), scores[kept].sum(axis=0)


def _downhill(sums: Array, count: int, clear: float) -> Array:
    """Steps (count,) of parameters far from the least value, where no bowl is: to the side that is clearly lower."""
    sides = np.stack([sums[1 : 2 * count : 2], sums[2 : 2 * count + 1 : 2]])
    steps = np.where(sides[0] < sides[1], LONGEST, -LONGEST)
    return np.asarray(np.where(sides.min(axis=0) < sums[0] - clear, steps, 0.0))
