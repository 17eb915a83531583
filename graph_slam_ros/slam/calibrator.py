"""Calibration while driving: trial fits at fixed keyframes, whose findings correct the measurements.

A trial starts at keyframes 50, 100, 200 and so on of this drive, and when everything is solved. It works on a copy, in
the background if possible. Its outcome is used a fixed number of keyframes later, so that a replay decides as the live
run did. Where nobody asked for calibration, a trial corrects nothing: it tells what is wrong.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, TypeVar

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.calibration.choice import parameters_of
from graph_slam_ros.slam.calibration.decision import Finding, decide, of_association
from graph_slam_ros.slam.calibration.drift import DriftWindows
from graph_slam_ros.slam.calibration.fit import TrialFit, likelier_fit
from graph_slam_ros.slam.calibration.model import Values
from graph_slam_ros.slam.calibration.parameters import DEFAULT_GROUPS, Parameter
from graph_slam_ros.slam.calibration.places import fit_with_places
from graph_slam_ros.slam.calibration.recalibration import Recalibration
from graph_slam_ros.slam.calibration.rows import TrialProblem
from graph_slam_ros.slam.calibration.uncorrected import Uncorrected
from graph_slam_ros.slam.calibration.watch import CalibrationWatch, Fits, Watching
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.kidnap_detector import KidnapDetector
from graph_slam_ros.slam.landmarks.explanation import SCALES
from graph_slam_ros.slam.landmarks.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver import Report, Settings
from graph_slam_ros.typing import Array, Executor, Index

FIRST_DUE = 50  # keyframes
_ROUNDS = 3  # when everything is solved
_STEADY = 3  # trials in a row that move nothing by a sigma end it
_DIGITS = 12  # of a corrected measurement, and of an added variance: the last ones of a sine depend on the machine

Trial = Callable[[], "TrialFit | None"]
Outcome = TypeVar("Outcome")


class Calibrator:
    """Decides when parameters are fitted, and applies the findings.

    Attributes
    ----------
    findings : of the last trial, by parameter, with the whole correction so far
    corrected : findings that were used, in order
    history : all corrections of measurements that were there, in order
    trials : how many there were
    corrected_at : the keyframe at which a parameter was last corrected by more than its sigma
    watch : of trials that correct nothing
    """

    def __init__(
        self,
        config: Config,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        kidnaps: KidnapDetector,
        counters: Counters,
        executor: Executor,
        start: MapSnapshot | None = None,
    ) -> None:
        self._config, self._backend, self._frontend = config, backend, frontend
        self._landmarks, self._anonymous = landmarks.map, landmarks.anonymous
        self._kidnaps, self._counters, self._executor = kidnaps, counters, executor
        self.findings: dict[Parameter, Finding] = {}
        self.history: list[Recalibration] = []
        self.corrected: list[Finding] = []
        self.trials = self.corrected_at = 0
        self._admitted: set[Parameter] = set()
        self._last: TrialFit | None = None
        self.watch = CalibrationWatch(
            backend.graph,
            backend.solver,
            lambda: frontend.path.keyframes,
            lambda found: (self._decided(found, (), stated := self._stated()), stated),
            self._with_corrected,
            lambda *key: frontend.corrections.total(key),
        )
        self._used: Mapping[str, tuple[float, float]] = landmarks.anonymous.hindsight.found_scales
        self._due, self._steady = FIRST_DUE, 0
        self._job: Trial | None = None
        self._apply_at = 0  # the keyframe
        self._first_keyframe = 0 if start is None else start.keyframe_count  # of what is driven now
        self._windows = DriftWindows(config.calibrate.drift, backend.graph.edge_count, self._first_keyframe)
        if start is not None:
            frontend.corrections.restore(start.calibration)
            self._admitted = {Parameter(*key) for key in start.calibration}

    def after_solve(self, keyframe: int, everything: Settings | None) -> Report | None:
        """Start a trial if it is due, and apply the outcome of an earlier one. Returns the report of a solve."""
        if self._backend.holds_back:
            return None
        if not self._config.calibrate.is_on:
            if everything is None:
                self._start_if_due(keyframe)
            elif not self._backend.spares_memory:
                self._guarded(lambda: self._watch_from(keyframe, is_of_everything=True))
            return self._adopt_association(keyframe, everything) if self._config.uses_found_factors else None
        if everything is not None:
            return self._at_the_end(keyframe, everything)
        if self._job is not None and keyframe >= self._apply_at:
            job, self._job = self._job, None
            self._adopt(self._guarded(job), keyframe, None)
        if self._job is None:
            self._start_if_due(keyframe)
        return None

    def _start_if_due(self, keyframe: int) -> None:
        driven = keyframe + 1 - self._first_keyframe
        if driven < self._due:
            return
        while driven >= self._due:
            self._due = self._windows.next_trial(self._due)
        if (self._steady < _STEADY or self._windows.drifts) and not self._backend.spares_memory:
            apply_at = keyframe + self._config.robust.apply_after_keyframes
            if self._config.calibrate.is_on:
                settings = self._backend.solver.settings
                self._job, self._apply_at = self._guarded(lambda: self._executor(self._trial(settings))), apply_at
            else:
                self._guarded(lambda: self._watch_from(apply_at, is_of_everything=False))

    def _watch_from(self, keyframe: int, *, is_of_everything: bool) -> None:
        trial = self._executor(self._watching(is_thorough=is_of_everything))
        self.watch.start(trial, keyframe, is_of_everything=is_of_everything)

    def _at_the_end(self, keyframe: int, everything: Settings) -> Report | None:
        self._job, report = None, None
        for _ in range(_ROUNDS):
            found = self._adopt(self._guarded(self._trial(everything)), keyframe, everything)
            if found is None:
                break
            report = found
        return report

    def _trial(self, settings: Settings) -> Trial:
        problem, calibrate = self._problem_with_slips(settings), self._config.calibrate
        log_odds, priors_of = self._config.odometry.log_odds, self._priors_of(problem)

        def run() -> TrialFit | None:
            priors = priors_of(calibrate.asked, calibrate.chooses)
            return likelier_fit(problem, priors, log_odds) if priors else None

        return run

    def _watching(self, *, is_thorough: bool = True) -> Watching:
        """A trial that corrects nothing: what is said is not hidden by a prior that contradicts."""
        problem, asked = self._problem_with_slips(self._backend.solver.settings), self._config.calibrate.asked
        log_odds, priors_of = self._config.odometry.log_odds, self._priors_of(problem)

        def run() -> Fits | None:
            priors = priors_of((*asked, *DEFAULT_GROUPS), True)
            priors = {one: max(prior, one.quantity.prior) for one, prior in priors.items()}
            return fit_with_places(problem, priors, log_odds, is_thorough=is_thorough) if priors else None

        return lambda: self._guarded(run)

    def _priors_of(self, problem: TrialProblem) -> "Callable[[Sequence[str], bool], dict[Parameter, float]]":
        """The parameters of groups, with their priors."""
        calibrate, has_gyro = self._config.calibrate, bool(self._config.gyro_input)
        windows, now_ns = self._windows, int(problem.stamps_ns[-1])

        def priors(groups: Sequence[str], chooses: bool) -> dict[Parameter, float]:
            wanted = parameters_of(problem, groups, chooses=chooses)
            if has_gyro:  # odometry's turn is mostly that of the gyro
                wanted = [one for one in wanted if one.name != "turn"]
            return {one: windows.prior(one, calibrate.prior(one.name), now_ns) for one in wanted}

        return priors

    def _guarded(self, job: Callable[[], Outcome | None]) -> Outcome | None:
        try:
            return job()
        except Exception as error:
            self._counters.count("calibration", type(error).__name__)
            return None

    # -- taking over -------------------------------------------------------------------------------------------------

    def _adopt(self, found: TrialFit | None, keyframe: int, everything: Settings | None) -> Report | None:
        """Apply the findings of a trial; None if there are none."""
        if found is None:
            return None
        self.trials, self._last = self.trials + 1, found
        findings = self._decided(found, self._admitted, self._stated())
        values = {one.parameter: _rounded(one.value) for one in findings if one.verdict == "admitted"}
        moved = any(one.parameter in values and abs(one.value) > one.sigma for one in findings)
        self._steady = 0 if moved else self._steady + bool(self._admitted)
        x = found.path if everything is not None else None
        report = self._correct(values, keyframe, everything, x) if values else None
        if report is not None:
            self._admitted |= values.keys()
            self.corrected += [one for one in findings if one.parameter in values]
            self.corrected_at = keyframe if moved else self.corrected_at
            if not found.slips:
                report = self._without_slips(everything) or report
        for one in findings:
            self.findings[one.parameter] = one
        edges, keyframes = self._backend.graph.edge_count, self._frontend.path.keyframes
        settings = self._frontend.corrections.lines()
        self._windows.close_if_full(keyframe, keyframes.stamps_ns, edges, findings, settings, keyframes.first)
        return report

    def _decided(self, found: TrialFit, corrected: Collection[Parameter], sigma_per_m: float) -> list[Finding]:
        return decide(
            found,
            self._count_landmarks(),
            corrected,
            slides=self._config.odometry.slides,
            drifts=self._windows.drifts,
            sigma_per_m=sigma_per_m,
            by_association=self._by_association(),
        )

    def _without_slips(self, everything: Settings | None) -> Report | None:
        """Take back all slips, if all measurements as they are corrected now are likelier so. Returns a solve's report.

        A parameter that was fitted but not used still passes for them.
        """
        problem = self._problem_with_slips(everything or self._backend.solver.settings)
        found = self._guarded(lambda: likelier_fit(problem, {}, self._config.odometry.log_odds))
        if found is None or found.slips:
            return None
        return self._kidnaps.revoke_slips(self._frontend.path.keyframes, everything)

    def _adopt_association(self, keyframe: int, everything: Settings | None) -> Report | None:
        """Apply the factors of odometry that the last explanation of all scans has found. Returns a solve's report."""
        scales = self._anonymous.hindsight.found_scales
        if scales is self._used or self._first_keyframe:
            return None
        self._used, report = scales, None
        sources = {edges.source for edges in self._problem().model().odometry}
        if len(sources) == 1:
            (source,) = sources
            found = {Parameter(source, name): one for name, one in scales.items()}
            if self._config.gyro_input:  # odometry's turn is mostly that of the gyro
                found.pop(Parameter(source, "turn"), None)
            findings = [of_association(one, *estimate, one in self._admitted) for one, estimate in found.items()]
            values = {one.parameter: _rounded(one.value) for one in findings if one.verdict == "admitted"}
            report = self._correct(values, keyframe, everything, None) if values else None
            if report is not None:
                self._admitted |= values.keys()
                self.corrected += [one for one in findings if one.parameter in values]
            self.findings |= {one.parameter: one for one in findings}
        return report

    def _count_landmarks(self) -> int:
        return sum(not mark.is_tentative for mark in self._landmarks.known.values())

    def _by_association(self) -> dict[str, tuple[float, float]] | None:
        """Odometry's factors less 1 as the association has them, with sigmas.

        None where its word is not needed: most landmarks have identities, or somebody asked for the factors by name.
        """
        known = [mark.is_unnamed for mark in self._landmarks.known.values() if not mark.is_tentative]
        is_asked = "factors" in self._config.calibrate.groups.split()
        is_needed = not is_asked and not self._first_keyframe and 2 * sum(known) > len(known)
        return self._anonymous.hindsight.found_scales if is_needed else None

    def _correct(self, values: Values, keyframe: int, everything: Settings | None, x: Array | None) -> Report | None:
        """Correct all measurements, present and future, and solve. A failure is undone.

        Parameters
        ----------
        x : stored numbers of the fit, where they are of all vertices
        """
        backend, corrections = self._backend, self._frontend.corrections
        before, start = dict(corrections.found), backend.solver.values
        changes, origins = self._changes(values, x)
        undo = [change.apply(backend.graph) for change in changes]
        try:
            for parameter, value in values.items():
                _add(corrections.found, (parameter.source, parameter.name), value)
            backend.solver.rebuild()
            report = backend.solver.optimize(everything)
            if backend.decisions.reclassify(keyframe):
                report = backend.solver.optimize(everything)
        except Exception as error:
            self._counters.count("calibration", type(error).__name__)
            corrections.found = before
            for change in undo:
                change.apply(backend.graph)
            backend.solver.start_at(start)
            backend.solver.rebuild()
            return None
        for row, stamp_ns, pose in origins:
            self._landmarks.origins.move(row, stamp_ns, pose)
        self.history += changes
        factors = [1.0 + next((v for p, v in values.items() if p.name == name), 0.0) for name in SCALES]
        clocks = {one.source: value for one, value in values.items() if one.name == "clock"}
        if factors != [1.0, 1.0] or clocks:
            self._anonymous.recalibrate((factors[0], factors[1]), clocks)
        backend.cancel_search()
        return report

    def _changes(
        self, values: Values, x: Array | None
    ) -> "tuple[list[Recalibration], list[tuple[Index, Index, Array]]]":
        """Return the corrected measurements of all edges, and the corrected origins of sightings."""
        problem = self._problem()
        x = problem.values if x is None else x
        model, path = problem.model(), problem.path(x, values)
        changes, origins = [], []
        for odometry in model.odometry:
            roots = odometry.table.sqrt_information.values[odometry.rows]
            z = model.corrected_odometry(odometry, values)
            changes.append(Recalibration(odometry.table.type.name, odometry.rows, _exact(z), roots.copy()))
        for seen in model.sightings:
            own = problem.poses(x, seen.table.vertices.values[seen.rows, 0])
            base = model.base(seen, values, path, own)
            T_keyframe_base = tuple(base.T)
            z = model.from_pose(seen, model.seen(seen, values), T_keyframe_base)
            roots = model.roots(seen, values, T_keyframe_base)
            changes.append(Recalibration(seen.table.type.name, seen.rows, _exact(z), _exact(roots)))
            stamps = model.stamps(seen, values, path)
            places = self._landmarks.origins.places(seen.table.id.values[seen.rows])
            known = places >= 0
            origins.append((places[known], stamps[known], _exact(base[known])))
        return [one for change in changes if (one := change.only_changed(self._backend.graph)) is not None], origins

    def _problem(self, settings: Settings | None = None) -> TrialProblem:
        path, origins = self._frontend.path, self._landmarks.origins
        factors = self._frontend.corrections.factors
        problem = self._backend.trial_problem(self._config.space, path, origins, settings, factors)
        return replace(problem, first_edge=max(problem.first_edge, self._windows.first_edge))

    def _problem_with_slips(self, settings: Settings) -> TrialProblem:
        return replace(self._problem(settings), slips=self._kidnaps.slipped(self._frontend.path.keyframes))

    def widened(self, marginal: Array, vertex: int) -> Array:
        """The marginal of a vertex with the uncertainty of the parameters, where one was corrected or is off.

        A pose after the last trial is as uncertain by them as the last one before.
        """
        if self._admitted and self._last is not None:
            return self._with_corrected(marginal, vertex)
        added = self.watch.adds(vertex, len(marginal))
        return marginal if added is None else marginal + _exact(added)

    def _with_corrected(self, marginal: Array, vertex: int) -> Array:
        """The same of parameters that were corrected. What is found but not used, because it is small, is an error."""
        found = self._last
        if found is None or not self._admitted:
            return marginal
        known = {one: self.findings[one].is_determined for one in found.parameters}
        left = {one: 0.0 if one in self._admitted else found.value(one) for one in known if known[one]}
        vertex, dof = self.watch.known(vertex, len(marginal), found.column), len(marginal)
        return marginal + _exact(found.adds(vertex, dof, left))

    # -- what nothing corrects ---------------------------------------------------------------------------------------

    def uncorrected(self) -> list[Uncorrected]:
        """Return what a trial fit finds wrong now, on a copy."""
        return self.watch.uncorrected(self._watching)

    def _stated(self) -> float:
        return self._problem().model().sigma_per_m()

    # -- what it says ------------------------------------------------------------------------------------------------

    def summary(self) -> dict[str, Any]:
        """Return the findings, for a person and for programs; empty if nothing is calibrated."""
        if not self._config.calibrate.is_on and not self._frontend.corrections.found:
            return {}
        corrections = self._frontend.corrections
        parameters = []
        for one in self.findings.values():
            key = one.parameter.source, one.parameter.name
            of_one = asdict(one) | {"source": key[0], "name": key[1], "correction": corrections.found.get(key, 0.0)}
            of_one["total"] = corrections.total(key)
            del of_one["parameter"]
            parameters.append({name: value for name, value in of_one.items() if value != float("inf")})
        report: dict[str, Any] = {"trials": self.trials, "parameters": parameters, "settings": corrections.lines()}
        if self._windows.drifts:
            report["windows"] = [{"first_keyframe": k, "settings": lines} for k, lines in self._windows.closed]
        return report


def _add(found: dict[tuple[str, str], float], key: tuple[str, str], value: float) -> None:
    """Add a correction to those before: factors multiply."""
    before = found.get(key, 0.0)
    is_factor = key[1] in ("distance", "turn", "range_factor")
    if key[1] == "range_factor" and (key[0], "range_offset") in found:
        found[key[0], "range_offset"] *= 1.0 + value
    found[key] = (1.0 + before) * (1.0 + value) - 1.0 if is_factor else before + value


def _rounded(value: float) -> float:
    """A value with six digits, because the last ones of a sine depend on the memory alignment of an array."""
    return float(f"{value:.6g}")


def _exact(numbers: Array) -> Array:
    return np.round(numbers, _DIGITS)
