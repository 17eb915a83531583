"""What the node has from configuration to clean-up: the border and the worker, what listens and what publishes.

The main thread has the callbacks, the border and map -> odom; the worker's thread has the pipeline (``Session``) and
publishes its results. Between them stand a queue one way and ``Session.estimate`` the other.
"""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message

from graph_slam_ros.errors import GraphSlamError, message_of
from graph_slam_ros.measurements.types import Closure, InitialPose, Measured
from graph_slam_ros.messages import results, to_msg
from graph_slam_ros.messages.from_msg import Decoder, MessageConverter, twist_of
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.message_class import message_class
from graph_slam_ros.messages.survey import with_survey
from graph_slam_ros.node import diagnostics, events
from graph_slam_ros.node.completion import Completion
from graph_slam_ros.node.future_stamps import FutureStamps
from graph_slam_ros.node.memory import is_short
from graph_slam_ros.node.pose_extrapolator import PoseExtrapolator
from graph_slam_ros.node.preparation import Preparation
from graph_slam_ros.node.publishers import Publishers
from graph_slam_ros.node.recent import RecentInputs
from graph_slam_ros.node.session import Estimate, Session
from graph_slam_ros.node.subscriptions import Subscriptions
from graph_slam_ros.node.tf_broadcaster import TfBroadcaster
from graph_slam_ros.node.throttle import Throttle
from graph_slam_ros.node.worker import Worker
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Odometry, Update
from graph_slam_ros.slam.edits import removal
from graph_slam_ros.slam.frontend.ingest_gate import IngestGate, Passage, input_of, size_of

_ACKNOWLEDGE = 32  # messages
_MOST_UNPUBLISHED_S, _AGAIN_S = 4.0, 5.0
_HINTS = {"future": ", ahead of the clock: is use_sim_time to be set, or does a clock differ?"}


class Runtime:
    """What there is from configuration to clean-up.

    Parameters
    ----------
    node : the ``GraphSlamNode``
    """

    def __init__(self, node: Any) -> None:
        config = with_survey(node.config)
        self._node = node
        self.counters = Counters()  # of the border; those of the pipeline belong to the worker's thread
        self.counters.on_first = self._tell
        self._border = MessageConverter(config, self.counters, _installed(config))
        self._ahead = FutureStamps(config.time.future_s, self._clock_ns, partial(self._refuse, "future"))
        self._gate = IngestGate(config.time.jump_back_s, self.counters, lambda: int(node.now_ns))
        self._reckoning = PoseExtrapolator(config)
        self._session = Session(config, self.counters, self._on_update, self._tell)
        self._outputs = Publishers(node, config)
        self._worker = Worker(config.inputs.queue)
        self._preparation = Preparation(node.get_logger())
        self._completion = Completion(self._session.incomplete, node.get_logger())
        self._listeners: Subscriptions | None = None
        self._broadcaster: TfBroadcaster | None = None
        self._jumps: Any = None
        self._sends_odometry = False
        self._with_twist = {one.name for one in config.sources if one.type == results.ODOMETRY}
        self._passed = self._done = 0  # messages, by this thread and by the worker's
        self._acknowledged = -1
        self._is_overdue, self._published_s = False, time.monotonic()  # results, where the worker always has messages
        self._jumps_told = Throttle(_AGAIN_S)
        self._taken: Counter[str] = Counter()  # things that were handed to the pipeline, by input
        self._recent = RecentInputs()
        self._has_player = False
        self._looked: tuple[int, int, int] = 0, 0, 0
        self._memory_is_short = False
        self._initial = node.create_subscription(
            message_class(results.POSE),
            "initialpose",
            node.guarded(self._on_initial_pose),
            10,
            raw=True,
        )
        self._removals = node.create_subscription(
            message_class("std_msgs/msg/String"), "~/remove", node.guarded(self._on_remove), 10
        )

    def prepare(self, is_told_to_stop: Callable[[], bool]) -> None:
        """Have the worker load the kernels, compiled where they are not yet, before it does anything else."""

        def prepare() -> None:
            if not self._preparation.run(is_told_to_stop):
                self._worker.leave()

        self._worker.call(prepare)

    def activate(self) -> None:
        """Listen and broadcast; twice is as good as once."""
        if self._listeners is not None:
            return
        node, config = self._node, self._node.config
        self._broadcaster = TfBroadcaster(node, config, node.guarded, self._look)
        heard = self._broadcaster.heard
        self._listeners = Subscriptions(node, config, self._border, self._take, node.guarded, heard, self.counters)
        back = Duration(nanoseconds=-round(config.time.jump_back_s * 1e9))
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=True)
        self._jumps = node.get_clock().create_jump_callback(threshold, post_callback=node.guarded(self._on_jump))

    def deactivate(self) -> None:
        """Neither listen nor broadcast."""
        if self._listeners is None or self._broadcaster is None:
            return
        self._listeners.close()
        self._broadcaster.close()
        self._jumps.unregister()
        self._listeners = self._broadcaster = None

    def finish(self, patience_s: float | None, is_urgent: Callable[[], bool] = lambda: False) -> None:
        """Save what was not saved yet, and take everything away.

        What takes longer is left to the next start: all that was accepted is in the journal.

        Parameters
        ----------
        patience_s, is_urgent : as of ``Worker.stop``
        """
        self.deactivate()
        self._preparation.stop()
        self._watch()
        for some in self._ahead.give_up():
            self._hand_over(some)
        self._node.destroy_subscription(self._initial)
        self._node.destroy_subscription(self._removals)
        self._hand_over(self._border.finish())
        saved = self._worker.call(self._session.finish)
        try:
            if self._worker.stop(patience_s, is_urgent) and saved.done():
                if folder := saved.result():
                    self._node.get_logger().info(f"saved {Path(folder).name}")
            else:
                self._leave()
        finally:
            self._session.abandon()
            self._outputs.close()
            self._completion.stop()

    def _leave(self) -> None:
        waiting, lost = self._session.leave()
        folder, log = self._node.config.output.folder, self._node.get_logger()
        if folder:
            log.warn(
                f"stopped while {waiting} measurements waited: all are in the journal; the next start completes the"
                f" results, or graph_slam recover {folder}"
            )
        if lost:
            log.error(f"{lost} measurements are lost: they came while another run was to begin, and it had not yet")

    # -- in the main thread: messages --------------------------------------------------------------------------------

    def _take(self, measured: Sequence[Measured], cdr: bytes) -> None:
        """Pass on what one message has given, or was waiting for it."""
        if self._gate.is_from_before(measured):
            self._refuse("before_jump", measured)
            return
        newest = [m for m in measured if isinstance(m, Odometry) and self._is_newest(m)]
        if newest and self._sends_odometry:
            self._send_odometry(newest[-1], cdr)
        if self._memory_is_short:
            measured = self._without_closures(measured)
        for some in self._ahead.pass_on(measured):
            self._hand_over(some)

    def _without_closures(self, measured: Sequence[Measured]) -> list[Measured]:
        for m in measured:
            if isinstance(m, Closure):
                self.counters.count(m.topic, "memory")
        return [m for m in measured if not isinstance(m, Closure)]

    def _hand_over(self, measured: Sequence[Measured]) -> None:
        """Hand a message to the worker, unless the gate refuses it; then it was not accepted."""
        has_room = self._worker.has_room
        passage = self._gate.admit(measured, self._node.config.time.on_jump, has_room=has_room)
        if passage.jump:
            self._begin_anew(passage, "stamps", "odometry has gone back in time and stays there")
        if passage.measured:
            self._session.accept(passage.measured)
            self._worker.offer(self._node.guarded(partial(self._use, passage.measured)))
        else:
            self._passed += 1

    def _refuse(self, reason: str, measured: Sequence[Measured]) -> None:
        """A message that goes no further: the reason counts for each thing it said."""
        self._gate.refuse(reason, measured)
        self._passed += 1

    def _is_newest(self, m: Odometry) -> bool:
        """Whether odometry tells where the robot is now; what is ahead of the clock would be the newest for long."""
        return not self._ahead.is_ahead([m]) and self._reckoning.hear(m, self._session.estimate)

    def _clock_ns(self) -> int:
        """The clock that stamps are judged by: of a recording that is played it is no better than they are."""
        return 0 if self._node.get_parameter("use_sim_time").value else self._node.now_ns

    def _send_odometry(self, m: Odometry, cdr: bytes) -> None:
        estimate, config = self._session.estimate, self._node.config
        if estimate is None or not estimate.is_located:
            return
        frames, unused = config.frames, config.output.pose_covariance_max
        twist = twist_of(cdr, frames.base) if m.source.partition("#")[0] in self._with_twist else None
        pose, covariance = self._reckoning.pose(estimate)
        self._outputs.odometry(to_msg.odometry(m.stamp_ns, frames.map, frames.base, pose, covariance, unused, twist))

    def _on_initial_pose(self, cdr: bytes) -> None:
        for pose in self._border.initial_pose(cdr):
            self.in_passing(self._in_sequence([pose]))

    def _on_remove(self, message: Any) -> None:
        try:
            event = removal(message.data)
        except GraphSlamError as error:
            self._node.get_logger().warn(str(error))
            return
        self.in_passing(self._in_sequence([event]))

    def _in_sequence(self, events: Sequence[Control | InitialPose]) -> "Future[None]":
        """Accept and process what is no measurement, at its place among those."""
        self._session.accept(events)
        return self._worker.call(partial(self._session.process, events))

    def _on_jump(self, jump: Any) -> None:
        """The clock jumped back, or another one is used."""
        estimate = self._session.estimate
        self._ahead.forget_time()
        self._gate.clock_jumped(jump.delta.nanoseconds)
        if estimate is None and not self._worker.waiting:
            return
        passage = self._gate.begin_anew(self._node.config.time.on_jump)
        self._begin_anew(passage, "clock", f"jumped by {jump.delta.nanoseconds * 1e-9:.3f} s")

    def _begin_anew(self, passage: Passage, who: str, why: str) -> None:
        """What comes now is of another time."""
        self._tell(who, f"{why}: {passage.jump}")
        self._border.forget_time()
        self._reckoning.forget()
        self._outputs.forget_time()
        if self._broadcaster is not None:
            self._broadcaster.forget_time()
        if passage.jump == "reset":
            self.in_passing(self.reset())
        elif passage.events:
            self.in_passing(self._in_sequence(passage.events))

    def _look(self) -> tuple[Config, Estimate | None, Odometry | None]:
        return self._node.config, self._session.estimate, self._reckoning.newest

    def tick(self) -> None:
        """Ten times a second: what has waited long enough, and what somebody may have begun to listen to."""
        self._watch()
        self._session.flush_in_background()
        self._completion.tick()
        for some in self._ahead.waited():
            self._hand_over(some)
        if self._listeners is not None:
            self._listeners.tick(self._node.now_ns)
        self._sends_odometry = self._outputs.has_listeners("odometry")
        self._has_player = self._node.has_player
        self._publish_received()
        is_due = self._outputs.are_due(self._node.config)
        if is_due and self._worker.waiting < _ACKNOWLEDGE:
            self._worker.offer(self._node.guarded(self._publish_due))
        elif is_due and time.monotonic() - self._published_s > _MOST_UNPUBLISHED_S:
            self._is_overdue = True

    def _watch(self) -> None:
        """Over the worker's thread and the memory of the process."""
        if self._worker.revive(self._session.restart):
            self.counters.count("node", "worker_restarted")
            self._node.get_logger().error("the solver's thread has died; another goes on with the graph that there is")
        limit, before = self._node.config.health.memory_mib, self._memory_is_short
        self._memory_is_short = is_short(limit, was_short=before)
        if self._memory_is_short != before:
            self.in_passing(self._in_sequence([Control("memory", (("is_short", not before),))]))

    def _publish_received(self) -> None:
        count = self._passed + self._done
        if count != self._acknowledged:
            self._acknowledged = count
            self._node.acknowledge(count)

    def _tell(self, source: str, reason: str) -> None:
        self._node.get_logger().warn(f"{source}: {reason}{_HINTS.get(reason, '')} (told once, counted from now on)")

    # -- services: begun here, done by the worker --------------------------------------------------------------------

    def save(self, config: Config | None = None) -> "Future[str]":
        """Solve everything and write the run folder, and the map under the name that the parameters say."""
        self._hand_over(self._border.finish(is_end=False))
        name = (config or self._node.config).output.save_as
        return self._worker.call(partial(self._session.save, self._session.accept_save(), name))

    @property
    def was_cut_off(self) -> bool:
        """Whether the last run was never ended: its map can be loaded."""
        return self._session.was_cut_off

    def check_map(self, name: str) -> None:
        """Raise RunError where no run of that name can be loaded."""
        self._session.earlier(name)

    def load(self, config: Config | None = None) -> "Future[str]":
        """Go on from an earlier run, with the robot where the parameters say."""
        config = config or self._node.config
        return self._anew(partial(self._session.load, config.output.load, config.load_pose))

    def resume(self) -> "Future[str]":
        """Go on from the last run, which was never ended."""
        return self._anew(self._session.resume)

    def reset(self) -> "Future[str]":
        """Save, and begin anew."""
        return self._anew(self._session.reset)

    def _anew(self, job: Callable[[], str]) -> "Future[str]":
        self._gate.begin_run()
        self._reckoning.forget()
        self._session.hold()

        def begin() -> str:
            try:
                said = job()
            finally:
                self._session.release()
            slam = self._session.slam
            if slam.datum:
                self._border.begin_at(slam.datum)
            self._outputs.begin(self._node.config, has_map=bool(slam.keyframes))
            self._outputs.publish_due(slam)
            return said

        return self._worker.call(begin)

    def pause(self, is_paused: bool) -> "Future[str]":
        """Take nothing more, or again."""
        self._gate.is_paused = is_paused
        return self._worker.call(lambda: "paused" if is_paused else "takes measurements")

    def control(self, event: str) -> "Future[str]":
        """An event of the ingest sequence."""
        asked = Control(event)
        self._session.accept([asked])
        return self._worker.call(partial(self._session.control, asked))

    def set(self, values: dict[str, Any]) -> None:
        """Change parameters at this place of the ingest sequence."""
        self.in_passing(self._in_sequence([Control("set", tuple(values.items()))]))

    def in_passing(self, future: "Future[Any]") -> None:
        """Where nobody waits for what was begun, the log says that it failed."""

        def note(done: "Future[Any]") -> None:
            if (error := done.exception()) is not None:
                self._node.get_logger().error(message_of(error))

        future.add_done_callback(note)

    # -- in the worker's thread --------------------------------------------------------------------------------------

    def _use(self, measured: Sequence[Measured]) -> None:
        try:
            self._session.process(measured)
        finally:
            self._done += 1
            for m in measured:
                self._taken[input_of(m)] += size_of(m)
            if self._is_overdue:
                self._publish_due()
            if self._has_player and (not self._worker.waiting or self._done % _ACKNOWLEDGE == 0):
                self._publish_received()

    def _on_update(self, slam: GraphSlam, update: Update) -> None:
        estimate, tf = self._session.estimate, slam.config.tf
        self._outputs.update(slam, update, is_located=estimate is not None and estimate.is_located)
        moved = update.correction
        if update.solved and (moved.distance_m > tf.report_jump_m or moved.angle_rad > tf.report_jump_rad):
            slam.counters.count("tf", "jump")
            if (left_out := self._jumps_told.next()) is not None:
                more = f" ({left_out} more since the last was told)" if left_out else ""
                self._node.get_logger().warn(events.correction(slam, update).message + more)

    def _publish_due(self) -> None:
        self._is_overdue, self._published_s = False, time.monotonic()
        self._outputs.publish_due(self._session.slam)

    # -- facts -------------------------------------------------------------------------------------------------------

    def facts(self, lifecycle: str) -> diagnostics.Facts:
        """For the verdict."""
        session, node, broadcaster = self._session, self._node, self._broadcaster
        if not self._worker.waiting and node.now_ns:
            self._worker.offer(node.guarded(session.evaluate))
        counters, pipeline = Counters(), Counters()
        pipeline.update(session.slam.counters)
        for some in (self.counters, pipeline):
            counters.update(some)
        counted = counters.as_dict()
        recent = self._recent.look(time.monotonic(), self._taken, self.counters.as_dict(), pipeline.as_dict())
        overflows = sum(of.get("overflow", 0) for of in counted.values())
        failures, restarts = session.failures, self.counters["node", "worker_restarted"]
        before, self._looked = self._looked, (overflows, failures, restarts)
        rivals = broadcaster.candidates() if broadcaster is not None and broadcaster.has_rival else None
        inputs = self._listeners.facts(node.now_ns, counted, recent) if self._listeners is not None else ()
        twins = node.get_node_names_and_namespaces().count((node.get_name(), node.get_namespace())) - 1
        return diagnostics.Facts(
            lifecycle,
            inputs,
            session.estimate,
            waits_for_clock=node.get_parameter("use_sim_time").value and not node.now_ns,
            is_paused=self._gate.is_paused,
            loads=session.loads,
            is_stopped=self._gate.is_stopped,
            lag_s=self._worker.lag_s,
            waiting=self._worker.waiting,
            busy_s=self._worker.busy_s,
            worker_is_alive=self._worker.is_alive,
            restarts=restarts - before[2],
            failing=session.slam.failing,
            memory_is_short=self._memory_is_short,
            overflows=overflows - before[0],
            failures=failures - before[1],
            recording_fails=session.recording_fails,
            path_version=self._outputs.path_version,
            has_other_authority=rivals is not None,
            authorities=rivals or (),
            twins=twins,
            tf_behind_s=broadcaster.behind_s if broadcaster is not None else 0.0,
            preparing=self._preparation.said,
            cannot_prepare=self._preparation.fault,
        )


def _installed(config: Config) -> dict[str, Decoder]:
    """Decoders of the types whose layout is known to the packages that are installed, and not to us."""
    names = {one.type for one in config.sources if one.name in uses(config)} - set(typestore().types)
    return {name: partial(deserialize_message, message_type=message_class(name)) for name in names}
