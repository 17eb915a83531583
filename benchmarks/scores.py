"""How well contenders did in a cell: the rows of the table, from what they believed."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.stats import chi2

from benchmarks import judge
from benchmarks.contenders import OURS, Believed
from benchmarks.courses import Course
from benchmarks.trials import Trial

Row = dict[str, Any]
Stage = Literal["online", "batch"]

_FITS = 0.99  # of who tells no weight: what is within this quantile of chi2 was believed
_HALF, _FULL = 0.5, 0.99  # of a weight


@dataclass(frozen=True, slots=True)
class Score:
    """Of one run; what there is not is None.

    Attributes
    ----------
    error_m, chi2 : see ``Course``
    believed, full : false measurements that keep more than half of their weight, and all of it
    lost : true ones that keep less than half
    """

    cpu_s: float
    fault: str
    error_m: float | None = None
    chi2: float | None = None
    believed: int | None = None
    full: int | None = None
    lost: int | None = None


def stages(who: str) -> tuple[Stage, ...]:
    """When a contender has a path: after the last measurement came, or after everything was solved."""
    return ("online", "batch") if who.startswith(OURS) else ("online",) if who.startswith("isam2") else ("batch",)


def score(course: Course, trial: Trial, found: Believed, stage: Stage) -> Score:
    """Judge a run at one of its stages."""
    poses = found.online if stage == "online" else found.batch
    cpu_s = found.online_s + (found.batch_s if stage == "batch" else 0.0)
    if found.fault or not len(poses) or not np.isfinite(poses).all():
        return Score(cpu_s, found.fault or "no finite path")
    counts: dict[str, int] = {}
    weights = found.online_weights if stage == "online" else found.weights
    if not len(weights) and not len(trial.odometry.sightings):
        fit = judge.fits(trial.closures, poses)
        weights = np.where(fit <= chi2.ppf(_FITS, trial.closures.root.shape[-1]), 1.0, 0.0)
    if len(weights):
        false, true = weights[trial.false], weights[~trial.false]
        counts = {"believed": int((false > _HALF).sum()), "full": int((false > _FULL).sum())}
        counts["lost"] = int((true <= _HALF).sum())
    cost = None if course.chi2 is None else course.chi2(poses)
    return Score(cpu_s, "", course.error_m(poses), cost, **counts)


def row(about: Row, scores: Sequence[tuple[int, Score]]) -> Row:
    """Of one contender in a cell; each number a list over the seeds."""
    several = [asdict(one) for _, one in scores]
    return about | {"seeds": [seed for seed, _ in scores]} | {key: [one[key] for one in several] for key in several[0]}
