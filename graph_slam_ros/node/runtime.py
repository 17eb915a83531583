"""The parts of the node from configuration to clean-up, and the services on the run.

The main thread runs the callbacks, ``Ingest`` and map -> odom. The worker's thread runs the pipeline (``Session``) and
publishes its results. A queue leads to the worker; ``Session.estimate`` leads back.
"""

import contextlib
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graph_slam_ros.config.config import with_survey
from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.measurements.types import Event
from graph_slam_ros.node.fact_collector import FactCollector
from graph_slam_ros.node.ingest import Ingest
from graph_slam_ros.node.publishers import Publishers
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.subscriptions import Subscriptions
from graph_slam_ros.node.tf_broadcaster import TfBroadcaster
from graph_slam_ros.node.worker import Worker
from graph_slam_ros.runs.folder import incomplete_runs
from graph_slam_ros.slam import Config, Control, Counters
from graph_slam_ros.slam.frontend.ingest_gate import Passage
from graph_slam_ros.warmup import Compiling, are_compiled, warmup

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode

_HINTS = {"future": ", ahead of the clock: is use_sim_time to be set, or does a clock differ?"}


class Runtime:
    """The parts of the node from configuration to clean-up, and the services on the run.

    Attributes
    ----------
    counters : of what is refused before the pipeline; those of the pipeline belong to the worker's thread
    preparing : how far the kernels are that the worker loads or compiles before anything else; empty when they are
    not_compiled : why they cannot be; empty where they can
    subscriptions, broadcaster : None while the node is not active
    """

    def __init__(self, node: "GraphSlamNode") -> None:
        config = with_survey(node.config)
        self.node, self.counters = node, Counters()
        self.counters.on_first = self._warn
        self.preparing = self.not_compiled = ""
        self._is_ending = False
        self.subscriptions: Subscriptions | None = None
        self.broadcaster: TfBroadcaster | None = None
        with contextlib.ExitStack() as undo:  # what cannot be configured holds neither the run folder nor a topic
            self.publishers = Publishers(self)
            undo.callback(self.publishers.close)
            self.session = Session(config, self.counters, self.publishers.on_update, self._warn)
            undo.callback(self.session.abandon)
            self.worker = Worker(config.inputs.queue, node.report_fault, self._on_exit_of_a_job)
            undo.callback(self.worker.stop, 0.0)
            self.ingest = Ingest(self, config)
            undo.pop_all()
        self.facts = FactCollector(self)
        for run in incomplete_runs(Path(config.output.folder)) if config.output.folder else ():
            node.get_logger().warn(f"{run.name}: stopped while measurements waited: graph_slam recover {run}")

    def prepare(self, is_stop_requested: Callable[[], bool]) -> None:
        """Make the worker load or compile the kernels before anything else. Without them it starts no further job."""
        log, dimensions = self.node.get_logger(), self.node.config.world.dimensions
        self.preparing = "loading kernels"

        def note(progress: Compiling) -> None:
            self.preparing = str(progress)

        def prepare() -> None:
            if not are_compiled(dimensions):
                log.info("compiling kernels, once per installation: about a minute")
            try:
                elapsed_s = warmup(lambda: self._is_ending or is_stop_requested(), note, dimensions)
            except GraphSlamError as error:  # stopped on request; the next start continues from there
                log.info(str(error))
                self.worker.leave()
            except Exception as error:
                self.not_compiled = message_of(error)
                log.error(str(Finding("not_compiled", "error", text=self.not_compiled)))
                self.worker.leave()
            else:
                self.preparing = ""
                log.info(f"kernels ready after {elapsed_s:.1f} s")

        self.worker.call(prepare)

    def activate(self) -> None:
        """Subscribe and broadcast. A second call changes nothing."""
        if self.subscriptions is None:
            self.broadcaster = TfBroadcaster(self)
            self.subscriptions = Subscriptions(self, self.broadcaster)

    def deactivate(self) -> None:
        """Unsubscribe and stop broadcasting."""
        if self.broadcaster is not None:
            self.broadcaster.close()
        if self.subscriptions is not None:
            self.subscriptions.close()
        self.subscriptions = self.broadcaster = None

    def finish(self, patience_s: float | None, is_urgent: Callable[[], bool] = lambda: False) -> None:
        """Save what is not saved yet, and remove everything, with the patience of ``Worker.stop``.

        The next start completes what takes longer, because all accepted measurements are in the journal.
        """
        self.deactivate()
        self._is_ending = True
        self.ingest.finish()
        saved = self.worker.call(self.session.finish)
        try:
            if self.worker.stop(patience_s, is_urgent) and saved.done():
                if folder := saved.result():
                    self.node.get_logger().info(f"saved {Path(folder).name}")
            else:
                self._leave()
        finally:
            self.session.abandon()
            self.publishers.close()

    def _leave(self) -> None:
        waiting, lost = self.session.leave()
        folder, log = self.node.config.output.folder, self.node.get_logger()
        if folder and (waiting or self.session.slam.processed):
            what = f"while {waiting} measurements waited" if waiting else "before the last solve had ended"
            ends = f"graph_slam recover {folder} completes the results"
            log.warn(f"stopped {what}: all are in the journal; {ends}")
        if lost:
            log.error(f"{lost} measurements are lost: they came while another run was to begin, and it had not yet")

    def tick(self) -> None:
        """Do what is due ten times a second, in the main thread."""
        self.session.flush_in_background()
        self.ingest.tick()
        if self.subscriptions is not None:
            self.subscriptions.tick(self.node.now_ns)
        self.publishers.tick()

    def begin_anew(self, passage: Passage, source: str, why: str) -> None:
        """Carry out the gate's decision on a jump of time."""
        self._warn(source, f"{why}: {passage.jump}")
        self.ingest.forget_time()
        self.publishers.forget_time()
        if self.broadcaster is not None:
            self.broadcaster.forget_time()
        if passage.jump == "reset":
            self.node.in_background(self.reset())
        elif passage.events:
            self.node.in_background(self.ingest.in_sequence(passage.events))

    def _on_exit_of_a_job(self) -> None:
        """Continue from the last good estimate after an exception that would have ended the thread."""
        self.counters.count("node", "worker_restarted")
        self.node.get_logger().error("a job has ended the solver's thread; it goes on with the graph that there is")
        self.session.slam.restart()

    def _warn(self, source: str, reason: str) -> None:
        self.node.get_logger().warn(f"{source}: {reason}{_HINTS.get(reason, '')} (logged once, counted from now on)")

    # -- services: begun here, done by the worker --------------------------------------------------------------------

    def save(self, config: Config | None = None) -> "Future[str]":
        """Solve everything, and write the run folder and the map under its configured name."""
        if self.preparing:
            raise GraphSlamError(f"nothing to save yet: {self.preparing}; what has come is in the journal")
        self.ingest.hand_over(self.ingest.converter.finish(is_end=False))
        name = (config or self.node.config).output.save_as
        return self.worker.call(partial(self.session.save, self.session.accept_save(), name))

    def load(self, config: Config | None = None) -> "Future[str]":
        """Continue from an earlier run, with the robot at the configured pose."""
        config = config or self.node.config
        return self._begin_run(partial(self.session.load, config.output.load, config.load_pose))

    def load_at_start(self) -> None:
        """Load the configured map. If it cannot be loaded, that is a state until another is."""
        loaded = self.load()
        loaded.add_done_callback(self.facts.note_load)
        self.node.in_background(loaded)

    def resume(self) -> "Future[str]":
        """Continue from the last run, which never ended."""
        return self._begin_run(self.session.resume)

    def reset(self) -> "Future[str]":
        """Save, and begin a new run."""
        return self._begin_run(self.session.reset)

    def _begin_run(self, job: Callable[[], str]) -> "Future[str]":
        self.ingest.gate.begin_run()
        self.ingest.extrapolator.forget()
        self.session.hold()

        def begin() -> str:
            try:
                done = job()
            finally:
                self.session.release()
            view = self.session.slam.view
            if view.datum:
                self.ingest.converter.begin_at(view.datum)
            self.publishers.begin(has_map=bool(view.keyframes))
            self.publishers.publish_due()
            return done

        return self.worker.call(begin)

    def pause(self, is_paused: bool) -> "Future[str]":
        """Pause or resume the processing of measurements."""
        self.ingest.gate.is_paused = is_paused
        return self.worker.call(lambda: "paused" if is_paused else "takes measurements")

    def control(self, event: Event) -> "Future[str]":
        """Process an event at its place in the ingest sequence."""
        self.session.accept(events := [Control(event)])

        def process() -> str:
            self.session.process(events)
            return f"{len(self.session.slam.view.keyframes)} keyframes"

        return self.worker.call(process)

    def set(self, values: dict[str, Any]) -> None:
        """Change parameters at this place in the ingest sequence."""
        self.node.in_background(self.ingest.in_sequence([Control("set", tuple(values.items()))]))
