"""One run of the pipeline in a node, from configuration or reset to the next: its estimate, its recording, its files.

All of it happens in the worker's thread; others see ``estimate``, which is replaced whole.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.ros.live.beside import in_a_thread
from graph_slam_ros.run import (
    RunError,
    RunRecorder,
    earlier_runs,
    is_cut_off,
    is_run,
    keep_earlier,
    map_of,
    run_config,
    summarize,
)
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Measurement, Update
from graph_slam_ros.slam.graph_slam import Correction
from graph_slam_ros.slam.map_state import MapState
from graph_slam_ros.slam.space import Numbers

OnUpdate = Callable[[GraphSlam, Update], None]


@dataclass(frozen=True, slots=True)
class Estimate:
    """What is known after an update, for whoever must not wait for the next.

    Attributes
    ----------
    T_map_odom : the correction; of identity before the first keyframe
    T_odom_keyframe, covariance, stamp_ns : odometry's pose, tangent covariance and stamp of the newest keyframe
    source : the odometry in use
    is_confirmed : whether the robot knows where it is in a map that was loaded
    fit : chi2 per degree of freedom; NaN before it was looked at
    rivals : loop closures of other explanations that could not be ruled out
    """

    T_map_odom: Numbers
    T_odom_keyframe: Numbers
    covariance: Any
    stamp_ns: int
    source: str
    is_confirmed: bool
    keyframes: int
    landmarks: int
    edges: int
    segments: int
    solves: int
    correction: Correction
    solve_s: float
    slowest_solve_s: float
    fit: float
    rivals: int


class Session:
    """The pipeline with its recording.

    Parameters
    ----------
    border : counters of what was refused before it came here: they are saved with the run
    on_update : called with what an update changed
    """

    def __init__(self, config: Config, border: Counters, on_update: OnUpdate, tell: Callable[[str, str], None]) -> None:
        self.config = config
        self._border, self._on_update, self._tell = border, on_update, tell
        self._folder = Path(config.output.folder) if config.output.folder else None
        self.estimate: Estimate | None = None
        self._recorder: RunRecorder | None = None
        self.was_cut_off = self._folder is not None and is_cut_off(self._folder)
        self._begin()

    def _begin(self, start: MapState | None = None, loaded: Path | None = None) -> None:
        slam = GraphSlam(self.config, self._sink, in_a_thread, start)
        recorder: RunRecorder | None = None
        if self._folder is not None:
            named = self._folder.with_name(load) if (load := self.config.output.load) else None
            keep_earlier(self._folder, self.config.output.keep_earlier, loaded or named)
            self._recorder, self.recording_fails = None, True  # until there is another
            recorder = RunRecorder(self._folder, self.config, self.config.journal.sync_s, start)
        self.slam, self._recorder, self.recording_fails = slam, recorder, False
        self.slam.counters.on_first = self._tell
        self._refused_before = Counters()
        self._refused_before.update(self._border)
        self.estimate = None
        self._is_saved, self._is_ended = True, False
        self._loaded = len(self.slam.keyframes)
        self._is_confirmed = not self._loaded
        self._slowest_s = 0.0
        self._fit, self._fitted_at, self._fit_due_s = float("nan"), 0, 0.0

    @property
    def failures(self) -> int:
        """Solves that failed."""
        return sum(self.slam.counters.as_dict().get("solver", {}).values())

    # -- measurements ------------------------------------------------------------------------------------------------

    def take(self, measurements: Sequence[Measurement]) -> None:
        """Hand measurements to the pipeline, in order."""
        for measurement in measurements:
            self._is_saved = False
            self._process(measurement)

    def _process(self, measurement: Measurement) -> None:
        start = time.perf_counter()
        update = self.slam.process(measurement)
        took_s = time.perf_counter() - start
        if not update:
            return
        self._slowest_s = max(self._slowest_s, took_s) if update.solved else self._slowest_s
        recorded = self._recorded(lambda recorder: recorder.record(self.slam, update))
        if self._recorded(RunRecorder.flush) and recorded:  # nobody is told of anything that a restart would not know
            self.recording_fails = False
        self._look(update, took_s)
        self._on_update(self.slam, update)

    def _sink(self, measurement: Measurement) -> None:
        self._recorded(lambda recorder: recorder.sink(measurement))

    def _recorded(self, write: Callable[[RunRecorder], None]) -> bool:
        """Where the disk fails, the robot goes on; that nothing is recorded is told, and tried again and again."""
        if self._recorder is None:
            return False
        try:
            write(self._recorder)
        except OSError as error:
            if not self.recording_fails:
                self._tell("output.folder", error.strerror or type(error).__name__)
            self.recording_fails = True
            if self._recorder.unwritten > _MOST_UNWRITTEN:
                self._recorder.abandon()
                self._recorder = None
                self._tell("output.folder", "recording was given up: too much waits for room")
            return False
        return True

    def _look(self, update: Update, took_s: float) -> None:
        slam, newest = self.slam, self.slam.keyframes[-1]
        covariance = slam.pose_covariance
        if update.solved and not self._is_confirmed and len(slam.keyframes) > self._loaded:
            unsure = float(covariance[0, 0] + covariance[1, 1]) ** 0.5
            self._is_confirmed = unsure < _CONFIRMED * slam.config.odometry.jump_sigma_m
        self.estimate = Estimate(
            slam.T_map_odom,
            newest.T_odom_base,
            covariance,
            newest.stamp_ns,
            slam.odometry_source,
            self._is_confirmed,
            len(slam.keyframes),
            len(slam.landmarks),
            slam.graph.edge_count,
            len(slam.segments),
            slam.solves,
            update.correction,
            took_s,
            self._slowest_s,
            self._fit,
            sum(len(rival.only_here) for rival in slam.backend.rivals),
        )

    def evaluate(self) -> None:
        """Look at how well everything fits, when there is nothing else to do, for a fiftieth of the time at most."""
        if self.estimate is None or self._fitted_at == self.slam.solves or time.perf_counter() < self._fit_due_s:
            return
        start = time.perf_counter()
        now, dof = self.slam.solver.evaluate(), self.slam.solver.degrees_of_freedom
        self._fit = now.chi2_final / dof if dof > 0 else float("nan")
        self._fitted_at = self.slam.solves
        self._fit_due_s = start + 50.0 * (time.perf_counter() - start)
        self.estimate = replace(self.estimate, fit=self._fit)

    # -- services ----------------------------------------------------------------------------------------------------

    def control(self, event: str, **values: Any) -> str:
        """An event of the ingest sequence."""
        self.take([Control(event, tuple(values.items()))])
        return f"{len(self.slam.keyframes)} keyframes"

    def save(self, release: str = "flush") -> str:
        """Release what waits, solve, and write the run folder; returns its name."""
        self._recorded(RunRecorder.wait_synced)  # what the disk refused before is told, and is no reason not to save
        for event in (release, "optimize") if self._recorder is not None and not self._is_saved else ():
            self._process(Control(event))
        if self._recorder is None:
            why = "recording was given up" if self._folder else "output.folder is empty"
            raise GraphSlamError(f"{why}: nowhere to save")
        counters = self._border.since(self._refused_before)
        counters.update(self.slam.counters)
        ended = release == "end"
        summary = summarize(self.slam) | {"counters": counters.as_dict(), "ended": ended}
        folder = str(self._recorder.save(self.slam, summary))
        self._is_saved, self._is_ended, self.recording_fails = True, ended, False
        return folder

    def reset(self) -> str:
        """Save, keep that, and begin anew."""
        said = self.finish() or ("recording was given up" if self.recording_fails else "nothing to save")
        self.config = self.slam.config
        self._begin()
        return said

    def load(self, name: str) -> str:
        """Save, keep that, and go on from an earlier run: in its map, where the robot is now is to be found out."""
        run = self._earlier(name)
        loaded = run_config(run)
        if loaded.world != self.config.world:
            raise RunError(f"{run.name}: world.dimensions is {loaded.world.dimensions} there")
        if run == self._folder:
            self.finish()
        losses: list[str] = []
        start = map_of(run, losses)
        self.finish()
        self.config = self.slam.config
        try:
            self._begin(start, run)
        except Exception:
            self._begin(loaded=run)
            raise
        self._recorded(RunRecorder.flush)
        self._look(Update(), 0.0)
        return ": ".join([run.name, f"{len(self.slam.keyframes)} keyframes", *losses[:1]])

    def _earlier(self, name: str) -> Path:
        if self._folder is None:
            raise GraphSlamError("output.folder is empty: nothing to load")
        if not name:
            earlier = earlier_runs(self._folder)
            if not earlier:
                raise RunError(f"no earlier run of {self._folder.name}")
            return earlier[max(earlier)]
        run = self._folder.parent / name
        if run.is_symlink() or not is_run(run):  # a link may lead anywhere
            raise RunError(f"{name}: not a run")
        return run

    def finish(self) -> str:
        """Save what was not saved yet, and end the recording; returns the folder, or nothing."""
        if self._recorder is None:
            return ""
        folder = ""
        if not self._is_saved or (self.slam.keyframes and not self._is_ended):
            folder = self.save("end")
        self._recorder.close()
        return folder

    def abandon(self) -> None:
        """End the recording as it is, where it was not finished."""
        if self._recorder is None:
            return
        try:
            self._recorder.close()
        except OSError:  # told when it was to be saved
            self._recorder.abandon()


_MOST_UNWRITTEN = 256 * 2**20  # bytes of the journal: hours of a robot's measurements
_CONFIRMED = 0.2  # of the noise of the motion over a jump: less, and something was recognised
