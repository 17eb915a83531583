"""Tunes parameters on recordings: a search, a surface about its best point, and proof on recordings left out of both.

Every run is a job of the fleet, named by the hash of all that it depends on: so none runs twice, and a tuning that was
stopped goes on where it was.
"""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import Client

from graph_slam_ros import __version__
from graph_slam_ros.config import Config
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.compare import Change, change_of
from graph_slam_ros.tools.fleet.engine import Progress, Workers, connected, fingerprints
from graph_slam_ros.tools.fleet.fit import Fit, fit_about
from graph_slam_ros.tools.fleet.job import Job
from graph_slam_ros.tools.fleet.recordings import Source, find_sources
from graph_slam_ros.tools.fleet.replay import run_missing, settings_of, truth_of
from graph_slam_ros.tools.fleet.search import NEED_TRUTH, OBJECTIVES, Range, Search, ranges_of, score
from graph_slam_ros.tools.fleet.store import Row, Store, job_key
from graph_slam_ros.tools.fleet.surface import held_out_of, interval
from graph_slam_ros.tools.fleet.table import write_table

TUNED = "tuned.yaml"
_PROBE = math.log(1.5)  # from the configured value: whether a parameter changes anything
_COMPARED = ("objective", "rmse_m", "map_rmse_m", "nees")

Point = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Tuning:
    """The work of a tuning.

    Attributes
    ----------
    recordings, out, truth, limit_s, memory : as of ``Fleet``
    parameters : names, or patterns as ``odometry.*_density``
    objective : of ``OBJECTIVES``
    configs, settings : what is configured: at most one file, and ``KEY=VALUE`` with single values
    trials : of the search, before the surface
    """

    recordings: Sequence[str]
    out: Path
    parameters: Sequence[str]
    objective: str = "likelihood"
    truth: str = ""
    configs: Sequence[Path] = ()
    settings: Sequence[str] = ()
    trials: int = 24
    limit_s: float = 3600.0
    memory: int = 0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class TunedParameter:
    """The result for a parameter.

    Attributes
    ----------
    before, value : configured, and found; the same where it is not changed
    sigma : of the logarithm of what was found; infinite where it is not known
    found : where the score is best; NaN where that is not known
    state : ``changed``; ``same``: the interval of 95 % has the configured value; ``undetermined``: the recordings
        cannot tell it; ``unused``: it changes no result
    """

    name: str
    before: float
    value: float
    sigma: float
    found: float
    state: str

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of 95 %."""
        return interval(self.found, self.sigma)


@dataclass(frozen=True, slots=True)
class Tuned:
    """The result of a tuning.

    Attributes
    ----------
    parameters : those of the patterns
    others : names that a pattern has, and that are no numbers above 0
    proof : ``held out``, ``cross validation``, or ``none``: a single recording
    changes : of the objective (below 1 is better) and of errors, on recordings that the values were not tuned on;
        without any, on the one that they were
    tuned_on, held_out : names of recordings
    left_out : recordings without a score, with the reason
    counts : ``trials``, ``pruned`` and ``runs``
    """

    parameters: list[TunedParameter]
    others: list[str]
    objective: str
    proof: str
    changes: list[Change]
    tuned_on: list[str]
    held_out: list[str]
    left_out: list[str]
    counts: Mapping[str, int]

    @property
    def settings(self) -> dict[str, float]:
        """The parameters that change. Empty where recordings that were left out are worse with them."""
        if self.changes and self.changes[0].verdict == "worse":
            return {}
        return {one.name: one.value for one in self.parameters if one.state == "changed"}


class _Runs:
    """Runs of recordings with other values of parameters, and their scores."""

    def __init__(
        self,
        tuning: Tuning,
        client: Client,
        store: Store,
        known: Sequence[tuple[Source, str]],
        configured: Mapping[str, Any],
        progress: Callable[[str], Progress],
    ) -> None:
        self._tuning, self._client, self._store, self._known = tuning, client, store, known
        self._configured, self._progress = configured, progress
        self.is_likelihood = tuning.objective == "likelihood"
        self._dof = Config.from_mapping(configured).space.dof
        self.baseline = self.rows([{}], range(len(known)))[0]

    @property
    def count(self) -> int:
        """The number of runs in the folder."""
        return sum(1 for _ in self._store.rows())

    def rows(self, points: Sequence[Point], recordings: Sequence[int]) -> list[list[Row]]:
        """The rows of each point with each recording."""
        jobs = [[self._job(point, recording) for recording in recordings] for point in points]
        every = [job for some in jobs for job in some]
        by_key, _ = run_missing(self._client, self._store, every, self._progress("tune"))
        return [[by_key[job.key] for job in some] for some in jobs]

    def scores(self, points: Sequence[Point], recordings: Sequence[int]) -> list[list[float]]:
        """The scores of each point with each recording."""
        return [
            [self.score(row, k) for k, row in zip(recordings, some, strict=True)]
            for some in self.rows(points, recordings)
        ]

    def score(self, row: Row, recording: int) -> float:
        """The score of a row of a recording."""
        return score(self._tuning.objective, row, self.baseline[recording], self._dof)

    def about(self, ranges: Sequence[Range], recordings: Sequence[int]) -> dict[str, Any]:
        """Describe what a search is of."""
        tuning, whole = self._tuning, json.dumps(self._configured, sort_keys=True)
        return {
            "objective": tuning.objective,
            "parameters": [one.name for one in ranges],
            "recordings": [self._known[k][1] for k in recordings],
            "seed": tuning.seed,
            "settings": hashlib.sha256(whole.encode()).hexdigest(),
            "truth": tuning.truth,
            "version": __version__,
        }

    def why_not(self, recording: int) -> str:
        """Return why a recording has no score as it is configured; empty if it has one."""
        row = self.baseline[recording]
        try:
            has_score = math.isfinite(self.score(row, recording))
        except (KeyError, TypeError):
            has_score = False
        return "" if has_score else row["reason"] or f"its run has no {self._tuning.objective}"

    def compared(self, metric: str, pairs: Sequence[tuple[int, Row]]) -> Change | None:
        """The change of a metric from the configured parameters to other rows."""
        before, after = {}, {}
        for recording, new in pairs:
            key = (self._known[recording][0].name, "")
            before[key], after[key] = self._metric(self.baseline[recording], recording), self._metric(new, recording)
        return change_of(metric, list(before), before, after)

    def _metric(self, row: Row, recording: int) -> Row:
        """A row with the objective as a number above 0: for a likelihood, of one sighting."""
        whole = self.score(row, recording)
        each = whole / self.baseline[recording]["held_out_sightings"] if self.is_likelihood else whole
        return row | {"objective": math.exp(min(each, 700.0))}

    def _job(self, point: Point, recording: int) -> Job:
        source, fingerprint = self._known[recording]
        values, truth = {**self._configured, **point}, truth_of(self._tuning.truth, source)
        return Job(
            key=job_key(fingerprint, values | {"": f"tune {self.is_likelihood}"}, truth),
            url=source.url,
            recording=source.name,
            setting=" ".join(f"{name}={value}" for name, value in point.items()) or "configured",
            values=values,
            truth=truth,
            out=str(self._tuning.out.absolute()),
            limit_s=self._tuning.limit_s,
            memory=self._tuning.memory,
            with_report=False,
            held_out=self.is_likelihood,
            keeps_run=False,
        )


def tune(
    tuning: Tuning,
    workers: Workers,
    progress: Callable[[str], Progress] = lambda _: lambda items, _total: items,
    on_start: Callable[[str], None] = lambda _: None,
) -> Tuned:
    """Tune parameters on recordings.

    Parameters
    ----------
    progress, on_start : as of ``replay_all``

    Raises
    ------
    GraphSlamError
        A parameter, an objective, a truth or a recording that cannot be used, or another study in the folder.
    """
    configured, ranges, others = _checked(tuning)
    sources = find_sources(tuning.recordings)
    for source in sources:
        truth_of(tuning.truth, source)
    store = Store(tuning.out, new=True)
    with store.locked():
        store.forget_attempts()
        with connected(workers) as client:
            on_start(client.dashboard_link)
            prints = fingerprints(client, store, sources, progress("hash"))
            known, unused = _distinct(sources, prints)
            try:
                runs = _Runs(tuning, client, store, known, configured, progress)
                return _tuned(tuning, runs, known, ranges, others, unused)
            finally:
                write_table(store.folder, store.rows())


def _checked(tuning: Tuning) -> tuple[Mapping[str, Any], list[Range], list[str]]:
    """Return what is configured, what is searched, and the names that are not."""
    if tuning.objective not in OBJECTIVES:
        raise GraphSlamError(f"--objective {tuning.objective}: is none of {', '.join(OBJECTIVES)}")
    if tuning.objective in NEED_TRUTH and not tuning.truth:
        raise GraphSlamError(f"--objective {tuning.objective}: needs the truth: --truth PATTERN")
    if (tuning.out / TUNED).exists():
        raise GraphSlamError(f"{tuning.out / TUNED}: exists already, and is not replaced: move it to go on")
    configured = settings_of(tuning.configs, tuning.settings)
    if len(configured) > 1:
        raise GraphSlamError("fleet tune: begins at one configuration: one file in --config, one value in --set")
    (values,) = configured.values()
    return values, *ranges_of(tuning.parameters, values)


def _distinct(sources: Sequence[Source], prints: Mapping[str, str]) -> tuple[list[tuple[Source, str]], list[str]]:
    """Recordings with their fingerprints, in order of these; and those that are not used, with the reason.

    A copy is none of its own: it would be held out from what it was tuned on.
    """
    first: dict[str, Source] = {}
    unused = []
    for source in sources:
        if source.url not in prints:
            unused.append(f"{source.name}: cannot be read")
        elif (same := first.setdefault(prints[source.url], source)) is not source:
            unused.append(f"{source.name}: a copy of {same.name}")
    return sorted(((one, fingerprint) for fingerprint, one in first.items()), key=lambda one: one[1]), unused


def _tuned(
    tuning: Tuning,
    runs: _Runs,
    known: Sequence[tuple[Source, str]],
    ranges: Sequence[Range],
    others: list[str],
    unused: list[str],
) -> Tuned:
    reasons = [runs.why_not(k) for k in range(len(known))]
    usable = [k for k, reason in enumerate(reasons) if not reason]
    names = [source.name for source, _ in known]
    left_out = unused + [f"{names[k]}: {reason}" for k, reason in enumerate(reasons) if reason]
    if not usable:
        raise GraphSlamError(f"no trial finished: no recording has a score, as {(left_out or ['none can be read'])[0]}")
    held = [usable[k] for k in held_out_of([known[k][1] for k in usable])]
    tuned_on = [k for k in usable if k not in held]
    used = _used(ranges, runs, tuned_on)
    fit, counts = None, {"trials": 0, "pruned": 0}
    if used:
        about = runs.about(used, tuned_on)
        search = Search(tuning.out, used, about, tuned_on, tuning.seed)
        fit = fit_about(used, search.run(tuning.trials, runs.scores), runs, tuned_on)
        counts = search.counts
    found = [_found(one, fit) for one in ranges]
    values = {one.name: one.value for one in found if one.state == "changed"}
    proof, pairs = _proof(runs, values, held, fit)
    changes = [change for metric in _COMPARED if values and (change := runs.compared(metric, pairs))]
    return Tuned(
        found,
        others,
        tuning.objective,
        proof,
        changes,
        [names[k] for k in tuned_on],
        [names[k] for k in held],
        left_out,
        {"runs": runs.count, **counts},
    )


def _used(ranges: Sequence[Range], runs: _Runs, recordings: Sequence[int]) -> list[Range]:
    """The parameters that change a score."""
    probes = [{one.name: one.at(_PROBE if one.at(_PROBE) != one.value else -_PROBE)} for one in ranges]
    (before,), after = runs.scores([{}], recordings), runs.scores(probes, recordings)
    return [one for one, scores in zip(ranges, after, strict=True) if scores != before]


def _found(one: Range, fit: Fit | None) -> TunedParameter:
    """Return the result for a parameter."""
    if fit is None or one.name not in fit.sigmas:
        return TunedParameter(one.name, one.value, one.value, math.inf, math.nan, "unused")
    sigma, value = fit.sigmas[one.name], fit.values().get(one.name)
    if value is None:
        return TunedParameter(one.name, one.value, one.value, sigma, math.nan, "undetermined")
    low, high = interval(value, sigma)
    if low <= one.value <= high:
        return TunedParameter(one.name, one.value, one.value, sigma, value, "same")
    return TunedParameter(one.name, one.value, value, sigma, value, "changed")


def _proof(runs: _Runs, values: Point, held: Sequence[int], fit: Fit | None) -> tuple[str, list[tuple[int, Row]]]:
    """Runs with the values that change: of recordings that were held out, or of each with the values of the others."""
    if held:
        return "held out", list(zip(held, runs.rows([values], held)[0], strict=True))
    if fit is None:
        return "none", []
    if len(fit.recordings) == 1:
        return "none", [(k, runs.rows([values], [k])[0][0]) for k in fit.recordings]
    of_others = {k: {name: fit.values(without=k)[name] for name in values} for k in fit.recordings}
    return "cross validation", [(k, runs.rows([point], [k])[0][0]) for k, point in of_others.items()]
