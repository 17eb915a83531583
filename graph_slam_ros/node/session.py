"""One run of the pipeline in a node, from configuration or reset to the next: its estimate, its recording, its files.

The main thread accepts measurements (``accept``) in the order in which it passes them to the worker's thread. The
worker does everything else. It replaces ``estimate`` as a whole, which other threads read.
"""

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from graph_slam_ros.errors import GraphSlamError, similar_file
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.measurements.types import END, InitialPose
from graph_slam_ros.node.estimate import Estimate, Resumption, UnseenWay, WeakestLandmark, doubted_lately, estimate_of
from graph_slam_ros.node.worker import run_in_thread
from graph_slam_ros.runs.folder import (
    CONFIG,
    RunError,
    earlier_runs,
    is_cut_off,
    is_name_of_earlier,
    is_run,
    keep_earlier,
    run_config,
)
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.restore import map_of, save_copy
from graph_slam_ros.runs.tables import account, summarize
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Measurement, Update
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, Step
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.typing import Numbers

OnUpdate = Callable[[GraphSlam, Update], None]


class Session:
    """The pipeline with its recording, and the counters of what was refused at the border, which are saved with it."""

    def __init__(self, config: Config, border: Counters, on_update: OnUpdate, warn: Callable[[str, str], None]) -> None:
        self.config = config
        self._border, self._on_update, self._warn = border, on_update, warn
        self._folder = Path(config.output.folder) if config.output.folder else None
        self.estimate: Estimate | None = None
        self._recorder: RunRecorder | None = None
        self._accepting = threading.Lock()
        self._held: deque[list[Measurement]] = deque()  # for each run that is still to begin, what was accepted for it
        self._is_left = False
        self._has_news = False  # since the last save was asked for
        self.recording_fails = False
        self._resumption: Resumption | None = None
        self.loads = ""  # the run whose map is being loaded
        self.was_cut_off = self._folder is not None and is_cut_off(self._folder)
        self._begin()
        if self.was_cut_off and config.journal.resume:
            with suppress(GraphSlamError, OSError, LookupError, TypeError, ValueError):  # said when its map is loaded
                self._resumption = Resumption.of(self.earlier(""), config)

    def _begin(self, start: MapSnapshot | None = None, loaded: Path | None = None) -> None:
        slam = GraphSlam(self.config, None, run_in_thread, start and start.copy())
        recorder: RunRecorder | None = None
        if self._folder is not None:
            named = self._folder.with_name(load) if (load := self.config.output.load) else None
            moved = keep_earlier(self._folder, self.config.output.keep_earlier, loaded or named)
            if start is not None and start.folder == self._folder:
                start.folder = moved
            self._recorder = None
            try:
                recorder = RunRecorder(self._folder, self.config, _SYNC_S, start, force=True)
            except Exception:
                self.recording_fails = True
                raise
        self.slam, self._recorder, self.recording_fails = slam, recorder, False
        self.slam.counters.on_first = self._warn
        self._refused_before = Counters()
        self._refused_before.update(self._border)
        self.estimate = None
        self._is_saved, self._is_ended = True, False
        self.loaded_keyframes = len(self.slam.view.keyframes)
        self._is_confirmed, self._sure_segments = not self.loaded_keyframes, 0  # when it was last known where it is
        self._resumption = None
        self._unseen, self._weakest = UnseenWay(self.loaded_keyframes, slam.view.landmark_changes), WeakestLandmark()
        self._slowest_s = 0.0
        self._fit, self._fitted_at, self._fit_due_s, self._doubted = float("nan"), 0, 0.0, tuple[Finding, ...]()

    @property
    def failures(self) -> int:
        """The number of failed solves."""
        return sum(self.slam.counters.as_dict().get("solver", {}).values())

    # -- measurements ------------------------------------------------------------------------------------------------

    def accept(self, measurements: Sequence[Measurement]) -> None:
        """Write measurements to the journal, before they are queued for ``process``."""
        self._has_news = True
        with self._accepting:
            if self._held:
                self._held[-1] += measurements
            else:
                self._write_accepted(measurements)

    def hold(self) -> None:
        """Hold accepted measurements until ``release``: they belong to the next run."""
        self._has_news = False
        with self._accepting:
            self._held.append([])

    def release(self) -> None:
        """Write the held measurements, now that the run has begun or the previous one goes on."""
        with self._accepting:
            self._write_accepted(self._held.popleft())

    def _write_accepted(self, measurements: Sequence[Measurement]) -> None:
        if (recorder := self._recorder) is not None:
            for measurement in measurements:
                recorder.accept(measurement)

    def flush_in_background(self) -> None:
        """Write accepted measurements to disk even while the worker is busy."""
        if (recorder := self._recorder) is not None:
            recorder.flush_in_background()

    def process(self, measurements: Sequence[Measurement]) -> None:
        """Process accepted measurements, in order."""
        for measurement in measurements:
            if self._is_left:
                return
            self._is_saved = False
            self._process(measurement)

    def ingest(self, measurements: Sequence[Measurement]) -> None:
        """Accept and process measurements."""
        self.accept(measurements)
        self.process(measurements)

    def _process(self, measurement: Measurement) -> None:
        start = time.perf_counter()
        update = self.slam.process(measurement)
        solve_s = time.perf_counter() - start
        if not update or self._is_left:
            return
        self._slowest_s = max(self._slowest_s, solve_s) if update.solved else self._slowest_s
        estimate = self._estimated(update, solve_s)
        recorded = self._recorded(lambda recorder: recorder.record(self.slam, update))
        if self._recorded(RunRecorder.flush) and recorded:  # nothing is published that a restart would not know
            is_refused = self._folder is None or not os.access(self._folder, os.W_OK)  # as a save would see
            if is_refused and not self.recording_fails:
                self._warn("output.folder", "it cannot be written any more")
            self.recording_fails = is_refused
        self.estimate = estimate
        self._on_update(self.slam, update)

    def _recorded(self, write: Callable[[RunRecorder], None]) -> bool:
        """Write to the recording. A failing disk is reported and tried again, while the robot drives on."""
        if self._recorder is None:
            return False
        try:
            write(self._recorder)
        except OSError as error:
            if not self.recording_fails:
                self._warn("output.folder", error.strerror or type(error).__name__)
            self.recording_fails = True
            if self._recorder.unwritten > _MOST_UNWRITTEN:
                self._recorder.abandon()
                self._recorder = None
                self._warn("output.folder", "recording was stopped: too much is waiting for room on the disk")
            return False
        return True

    def _estimated(self, update: Update, solve_s: float) -> Estimate:
        """Return the estimate after an update, and note its correction for the next start."""
        view = self.slam.view
        if update.solved and not self._is_confirmed and len(view.keyframes) > self.loaded_keyframes:
            self._is_confirmed = self._is_sure
        if self._is_sure:
            self._sure_segments = len(view.segments)
        self._unseen = self._unseen.goes_on(view)
        estimate = estimate_of(
            self.slam,
            correction=update.correction,
            is_confirmed=self._is_confirmed,
            is_resumed=not self._is_confirmed and self._is_resumed,
            is_lost=self._is_confirmed and not view.displaced and len(view.segments) > self._sure_segments,
            solve_s=solve_s,
            slowest_solve_s=self._slowest_s,
            fit=self._fit,
            doubted=self._doubted,
            unseen=self._unseen,
            weakest_landmark=self._weakest.goes_on(view),
        )
        if self._recorder is not None and estimate.is_located:
            self._recorder.note_correction(estimate.T_map_odom, estimate.source)
        return estimate

    @property
    def _is_sure(self) -> bool:
        """Return whether the newest keyframe is better known in the map than across a jump of odometry."""
        covariance = self.slam.view.pose_covariance
        return float(covariance[0, 0] + covariance[1, 1]) ** 0.5 < _CONFIRMED * JUMP_SIGMA_M

    @property
    def _is_resumed(self) -> bool:
        """Return whether the drive that was cut off goes on, and odometry has not jumped since."""
        view, first, resumption = self.slam.view, self.loaded_keyframes, self._resumption
        if resumption is None or len(view.keyframes) <= first or view.segments[-1] != first:
            return False
        return resumption.goes_on(
            view.keyframes[first].stamp_ns, view.keyframes[first].T_odom_base, view.odometry_source
        )

    def T_map_odom(self, newest: Step, source: str) -> Numbers | None:
        """The correction to broadcast with the newest odometry; None while it is not known where the robot is.

        While the map of a drive that was cut off is being loaded, it is the last one before, if odometry goes on.
        """
        estimate, resumption = self.estimate, self._resumption
        if estimate is not None and (estimate.is_located or estimate.keyframes > self.loaded_keyframes):
            return estimate.T_map_odom if estimate.is_located else None
        goes_on = resumption is not None and resumption.goes_on(newest.stamp_ns, newest.T_odom_base, source)
        return resumption.T_map_odom if resumption is not None and goes_on else None

    def evaluate(self) -> None:
        """Compute how well all measurements fit, and which are not believed, when idle, in a fiftieth of the time."""
        was_said = self._recorder is None
        try:
            self._keep_folder()
        except GraphSlamError as error:  # it is tried again
            if not was_said:
                self._warn("output.folder", str(error))
        if self.estimate is None or self._fitted_at == self.slam.view.solves or time.perf_counter() < self._fit_due_s:
            return
        start = time.thread_time()
        now, dof = self.slam.view.solver.evaluate(), self.slam.view.solver.degrees_of_freedom
        self._fit = now.chi2_final / dof if dof > 0 else float("nan")
        self._doubted, self._fitted_at = doubted_lately(self.slam.view), self.slam.view.solves
        self._fit_due_s = time.perf_counter() + 50.0 * (time.thread_time() - start)
        self.estimate = replace(self.estimate, fit=self._fit, doubted=self._doubted)

    def _keep_folder(self) -> None:
        """Begin the run folder anew with the whole map, where somebody has removed it. Raises RunError."""
        if self._folder is None or (self._folder / CONFIG).exists() or not self.slam.view.keyframes:
            return
        with self._accepting:
            gone, self._recorder, self._is_saved, self.recording_fails = self._recorder, None, False, True
            if gone is not None:
                self._warn("output.folder", "the run folder was removed: it is made again, with the map as it is")
                gone.abandon()
            given = self._folder, self.slam.view.config, _SYNC_S, self.slam.view.snapshot()
            accepted = self.slam.processed if gone is None else gone.accepted
            self._recorder = RunRecorder(*given, force=True, accepted=accepted)
            self.recording_fails = False

    # -- services ----------------------------------------------------------------------------------------------------

    def accept_save(self) -> list[Control]:
        """The events that come before a save in the journal; none if nothing is new."""
        events = [Control("flush"), Control("optimize")] if self._has_news else []
        self.accept(events)
        self._has_news = False
        return events

    def save(self, events: Sequence[Control] | None = None, name: str = "") -> str:
        """Process the events accepted for it, or accept them now, and write the run folder; returns its name.

        A second run folder with the given name in the same directory gets the map, too.
        """
        self._recorded(RunRecorder.join_sync)  # what the disk refused before is reported, and is no reason not to save
        self.process(self.accept_save() if events is None else events)
        folder = self._write(ended=False)
        if not name:
            return str(folder)
        out = folder.with_name(name)
        try:
            if is_name_of_earlier(folder, name):
                raise RunError(f"{name}: earlier runs are called so, and are removed: choose another name")
            save_copy(self.slam.view, out, folder)
        except GraphSlamError as error:
            raise RunError(f"{folder.name} is saved; {error}") from None
        return f"{folder}, {out}"

    def _write(self, *, ended: bool) -> Path:
        if self._recorder is None:
            why = "recording was stopped" if self._folder else "output.folder is empty"
            raise GraphSlamError(f"{why}: nowhere to save")
        summary = summarize(self.slam) | account(self.slam, self._counters()) | {"ended": ended}
        folder = self._recorder.save(self.slam, summary)
        self._is_saved, self._is_ended, self.recording_fails = True, ended, False
        return folder

    def reset(self) -> str:
        """Save, keep that run, and begin a new one."""
        saved = self.finish() or ("recording was stopped" if self.recording_fails else "nothing to save")
        self.config = self.slam.view.config
        self._begin()
        return saved

    def load(self, name: str, T_map_base: Numbers | None = None) -> str:
        """Save, keep that run, and continue from an earlier one, where the robot is at a pose or at an unknown one."""
        return self._load(self.earlier(name), T_map_base)

    def resume(self) -> str:
        """Continue from the run that was cut off: in its map, and at the robot's pose if odometry continues."""
        try:
            return self._load(self.earlier(""), resumption=self._resumption)
        except GraphSlamError:
            self._resumption = None
            if not self.config.output.load_at_start:
                raise
            return self.load(self.config.output.load)

    def _load(self, run: Path, T_map_base: Numbers | None = None, resumption: Resumption | None = None) -> str:
        loaded, losses = run_config(run), list[str]()
        if loaded.world != self.config.world:
            raise RunError(f"{run.name}: world.dimensions is {loaded.world.dimensions} there")
        self.loads = run.name
        try:
            if run == self._folder:
                self.finish()
            start = map_of(run, losses)
            self.finish()
            self.config = self.slam.view.config
            try:
                self._begin(start, run)
            except Exception:
                self._begin(loaded=run)
                raise
            self._resumption = resumption
            where = [] if T_map_base is None else [self._place(T_map_base)]
            self._recorded(RunRecorder.flush)
            self.estimate = self._estimated(Update(), 0.0)
        finally:
            self.loads = ""
        return ": ".join([run.name, f"{len(self.slam.view.keyframes)} keyframes", *where, *losses[:1]])

    def _place(self, T_map_base: Numbers) -> str:
        """Begin the sequence with the robot's pose, as uncertain as on ``initialpose`` without covariance; says so."""
        prior, space = self.config.initialpose, self.config.space
        sigmas = np.array(space.sigmas(prior.sigma_m, prior.sigma_rad))
        pose = InitialPose(T_map_base, tuple(np.diag(sigmas**2).ravel().tolist()))
        if (recorder := self._recorder) is not None:
            recorder.accept(pose)  # before what waits for ``release``
        self._process(pose)
        return f"the robot is taken to be at {' '.join(f'{x:.6g}' for x in T_map_base[: space.dimensions])}"

    def earlier(self, name: str) -> Path:
        """The run of that name in the same directory; the newest earlier one for an empty name. Raises RunError."""
        if self._folder is None:
            raise GraphSlamError("output.folder is empty: nothing to load")
        if not name:
            earlier = earlier_runs(self._folder)
            if not earlier:
                raise RunError(f"no earlier run of {self._folder.name}")
            return earlier[max(earlier)]
        run = self._folder.parent / name
        if run.is_symlink() or not is_run(run):  # a link may lead anywhere
            raise RunError(f"{name}: not a run{similar_file(run)}")
        return run

    def finish(self) -> str:
        """Save what is not saved yet, and end the recording. Returns the folder, or nothing."""
        self._keep_folder()
        if self._recorder is None:
            return ""
        folder, recorder = "", self._recorder
        if not self._is_saved or (self.slam.view.keyframes and not self._is_ended):
            self._recorded(RunRecorder.join_sync)
            for event in END if not self._is_saved else ():
                recorder.accept(event)
                self._process(event)
            folder = str(self._write(ended=True))
        recorder.close()
        return folder

    def leave(self) -> tuple[int, int]:
        """End the recording while measurements are in the queue, and perhaps the worker at one, whose results are lost.

        Returns their number: those in the journal, whose results the next start or ``graph_slam recover`` makes, and
        those of a run that has not begun, which are lost.
        """
        self._is_left = True
        recorder = self._recorder
        lost = sum(map(len, self._held))
        if recorder is None:
            return 0, lost
        try:
            return recorder.leave(self.slam.processed, len(self.slam.view.keyframes), self._counters()), lost
        except OSError as error:
            recorder.abandon()
            raise RunError(f"{recorder.folder}: {error.strerror}") from None

    def _counters(self) -> Counters:
        """The counters of the run: of the converters since it began, and of the pipeline."""
        counters = self._border.since(self._refused_before)
        counters.update(self.slam.counters)
        return counters

    def abandon(self) -> None:
        """End the recording as it is, if it was not finished."""
        self._is_left = True
        if self._recorder is not None:
            try:
                self._recorder.close()
            except OSError:  # reported when it was to be saved
                self._recorder.abandon()


_MOST_UNWRITTEN = 256 * 2**20  # bytes of the journal: hours of a robot's measurements
_SYNC_S = 1.0  # until the journal is on the disk: what a power cut may lose
_CONFIRMED = 0.2  # of the noise of the motion over a jump: less, and something was recognised
