"""The search for parameters: which are searched, how a run is scored, and Optuna's study, kept in a file."""

import fnmatch
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from graph_slam_ros.config.config import parameters
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.held_out import OUTLIER_RANGE, OUTLIERS
from graph_slam_ros.tools.fleet.store import Row

OBJECTIVES = ("likelihood", "nees", "chi2", "rmse")
NEED_TRUTH = ("nees", "rmse")
SPAN = 5.0  # parameters are searched between the configured value over this, and times this
BATCH = 4  # trials at a time, whatever the number of workers is: so the search is the same with any
JOURNAL = "study.journal"
_STUDY, _ABOUT = "tune", "about"
_DIGITS = 4
_FAILED = 1e300  # the score of a failed run, in the study
_UNPREDICTED = 2.0 * math.log(OUTLIER_RANGE) - math.log(OUTLIERS)  # of a sighting that is not in the graph

Score = float
Evaluate = Callable[[Sequence[Mapping[str, float]], Sequence[int]], list[list[Score]]]
"""The scores of settings with recordings, by their numbers: a list for each setting. Infinite: the run failed."""


@dataclass(frozen=True, slots=True)
class Range:
    """A parameter that is searched, its configured value, and what it may be."""

    name: str
    value: float
    least: float
    most: float

    @property
    def low(self) -> float:
        """The least value of the search."""
        return max(self.value / SPAN, self.least)

    @property
    def high(self) -> float:
        """The greatest value of the search."""
        return min(self.value * SPAN, self.most)

    def at(self, offset: float) -> float:
        """The value at an offset of the logarithm, within what it may be, of four digits."""
        return min(max(float(f"{self.value * math.exp(offset):.{_DIGITS - 1}e}"), self.least), self.most)


def ranges_of(patterns: Sequence[str], configured: Mapping[str, Any]) -> tuple[list[Range], list[str]]:
    """Return the parameters that patterns name, which are numbers above 0, and the names of the others.

    Parameters
    ----------
    patterns : names, or patterns as ``odometry.*_density``
    configured : all parameters by name

    Raises
    ------
    GraphSlamError
        A pattern without a parameter, or a name of one that cannot be searched: no number, or 0, of which no multiple
        is another.
    """
    inputs = str(configured["inputs.names"]).split()
    known = {p.name: p for p in parameters(inputs)}
    out, others = dict[str, Range](), dict[str, None]()
    for pattern in patterns:
        found = fnmatch.filter(known, pattern)
        if not found:
            raise GraphSlamError(f"--parameters {pattern}: no parameter has this name: graph_slam params lists them")
        usable = [name for name in found if known[name].type is float and configured[name] > 0.0]
        if not usable:
            value = configured[found[0]]
            raise GraphSlamError(f"--parameters {pattern}: {found[0]} is {value!r}: only a number above 0 is tuned")
        others |= dict.fromkeys(name for name in found if name not in usable)
        for name in usable:
            least, most = known[name].low or 0.0, known[name].high
            out[name] = Range(name, float(configured[name]), least, math.inf if most is None else most)
    return list(out.values()), list(others)


def score(objective: str, row: Row, baseline: Row, dof: int) -> Score:
    """The score of a run, which is to be small, against that with the configured parameters.

    Parameters
    ----------
    objective : ``likelihood``: -log p of left-out sightings [nats]; ``rmse``: logarithm of the error over that of the
        baseline; ``nees``: squared logarithm of NEES over its expectation; ``chi2``: the same of chi2 per residual,
        the mean of all classes of edges
    dof : the expectation of NEES
    """
    if row["state"] == "failed":
        return math.inf
    if objective == "likelihood":
        nats, count = row.get("held_out_nats"), row.get("held_out_sightings")
        if nats is None or count is None:
            return math.inf
        return float(nats + _UNPREDICTED * max(0, baseline["held_out_sightings"] - count))
    if objective == "chi2":
        classes = [v for name, v in row.items() if name.startswith("chi2_per_residual.") and v]
        return float(np.mean(np.log(classes) ** 2)) if classes else math.inf
    value = row.get("rmse_m" if objective == "rmse" else "nees")
    if not value:
        return math.inf
    return math.log(value / baseline["rmse_m"]) if objective == "rmse" else math.log(value / dof) ** 2


class Search:
    """A study of Optuna in a folder, which a search that was stopped goes on with.

    Parameters
    ----------
    about : what it is of: recordings, settings, objective
    recordings : numbers of those that it is tuned on

    Raises
    ------
    GraphSlamError
        The study in the folder is of something else.
    """

    def __init__(
        self, folder: Path, ranges: Sequence[Range], about: Mapping[str, Any], recordings: Sequence[int], seed: int
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._ranges, self._recordings, self._seed = ranges, list(recordings), seed
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            pruner = optuna.pruners.WilcoxonPruner(p_threshold=0.1, n_startup_steps=2)
        storage = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
        self._study = optuna.create_study(storage=storage, study_name=_STUDY, load_if_exists=True, pruner=pruner)
        known = self._study.user_attrs.get(_ABOUT)
        if known is None:
            self._study.set_user_attr(_ABOUT, dict(about))
            self._study.enqueue_trial({one.name: one.value for one in ranges})
        elif known != dict(about):
            changed = sorted(key for key in known.keys() | about.keys() if known.get(key) != about.get(key))
            raise GraphSlamError(f"{folder}: has a study with another {', '.join(changed)}: choose another --out")
        for left in self._study.get_trials(states=(TrialState.RUNNING,)):
            self._study.tell(left.number, state=TrialState.FAIL)
            self._study.enqueue_trial(left.params)

    @property
    def counts(self) -> dict[str, int]:
        """The number of trials, and of those that were pruned."""
        return {"trials": len(self._ended()), "pruned": len(self._ended(TrialState.PRUNED))}

    def _ended(self, *states: TrialState) -> list[optuna.trial.FrozenTrial]:
        return self._study.get_trials(deepcopy=False, states=states or (TrialState.COMPLETE, TrialState.PRUNED))

    def run(self, trials: int, evaluate: Evaluate) -> dict[str, float]:
        """Try so many settings in all, and return the best one."""
        while (done := len(self._ended())) < trials:
            # The sampler is a function of the trials before: so a search that was stopped goes on as if it was not.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)
                self._study.sampler = optuna.samplers.TPESampler(
                    seed=self._seed + done, multivariate=True, constant_liar=True, n_startup_trials=2 * BATCH
                )
            batch = [self._study.ask() for _ in range(min(BATCH - done % BATCH, trials - done))]
            self._run(batch, evaluate)
        whole = [one for one in self._ended(TrialState.COMPLETE) if one.value is not None and one.value < _FAILED]
        if not whole:
            raise GraphSlamError("no trial finished: each has a run that failed")
        best = min(whole, key=lambda one: (one.value, one.number)).params
        return {one.name: one.at(math.log(best[one.name] / one.value)) for one in self._ranges}

    def _run(self, batch: Sequence[optuna.Trial], evaluate: Evaluate) -> None:
        """Run trials on the recordings, some at a time. Those that are worse than the best so far end there."""
        settings = [self._suggested(trial) for trial in batch]
        going, sums = list(range(len(batch))), np.zeros(len(batch))
        for some in _parts(self._recordings):
            found = evaluate([settings[k] for k in going], some)
            for k, scores in zip(going, found, strict=True):
                for recording, value in zip(some, scores, strict=True):
                    batch[k].report(min(value, _FAILED), recording)
                sums[k] += min(sum(scores), _FAILED)
            is_last = some[-1] == self._recordings[-1]
            pruned = [k for k in going if not is_last and (batch[k].should_prune() or sums[k] >= _FAILED)]
            for k in pruned:
                self._study.tell(batch[k], state=TrialState.PRUNED)
            going = [k for k in going if k not in pruned]
        for k in going:
            self._study.tell(batch[k], float(sums[k]))

    def _suggested(self, trial: optuna.Trial) -> dict[str, float]:
        tried = {one: trial.suggest_float(one.name, one.low, one.high, log=True) for one in self._ranges}
        return {one.name: one.at(math.log(value / one.value)) for one, value in tried.items()}


def _parts(recordings: Sequence[int]) -> Iterator[Sequence[int]]:
    """A third of the recordings at a time, at least two."""
    size = max(2, -(-len(recordings) // 3))
    for first in range(0, len(recordings), size):
        yield recordings[first : first + size]
