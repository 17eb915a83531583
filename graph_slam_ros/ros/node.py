"""The ROS node: hands every message on, and publishes what came of it. Callbacks convert and enqueue, no more.

The main thread has the callbacks, the border and map -> odom; the worker's thread has the pipeline (``Session``) and
publishes its results. Between them stand a queue one way and ``Session.estimate`` the other.
"""

import os
import re
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy comes in: threads would reorder sums

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import UInt64

from graph_slam_ros.errors import ConfigError, GraphSlamError
from graph_slam_ros.ros import results, to_msg
from graph_slam_ros.ros.from_msg import Border, Decoder, twist_of
from graph_slam_ros.ros.inputs import Measured, uses
from graph_slam_ros.ros.interfaces import typestore
from graph_slam_ros.ros.live import events, health
from graph_slam_ros.ros.live.ahead import Ahead
from graph_slam_ros.ros.live.broadcaster import Broadcaster
from graph_slam_ros.ros.live.deferred import serve_later
from graph_slam_ros.ros.live.listeners import Listeners
from graph_slam_ros.ros.live.outputs import LATCHED, Outputs
from graph_slam_ros.ros.live.params import changed, declare_parameters
from graph_slam_ros.ros.live.reckoning import Reckoning
from graph_slam_ros.ros.live.session import Estimate, Session
from graph_slam_ros.ros.live.worker import Worker
from graph_slam_ros.ros.message_class import message_class
from graph_slam_ros.ros.survey import with_survey
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, Odometry, Update
from graph_slam_ros.warmup import warmup

_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
_TICK_S = 0.1
_AGAIN_S = 5.0
_STOP_S = 2.0  # what a solve may still take when the node is told to stop
_SWITCH_S = 5e-4  # a callback waits no longer than this for the worker's Python; the default is ten times that
_ACKNOWLEDGE = 32  # messages


class GraphSlamNode(LifecycleNode):
    """Online pose-graph SLAM of odometry, landmark sightings, fixes and closures; ``ros/topics.py`` lists the topics.

    Configured, it has read its parameters, compiled its kernels, opened its run folder and has its publishers; active,
    it listens and broadcasts map -> odom.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("graph_slam", **options)
        self.config = declare_parameters(self)
        self.add_on_set_parameters_callback(self._on_set)
        self._run: _Run | None = None
        self._state = "unconfigured"
        self._faults: deque[float] = deque(maxlen=1000)
        self._told: set[str] = set()
        self._verdict = health.Verdict("UNCONFIGURED")
        self._logged_s = 0.0
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # whatever becomes of /clock
        self._acknowledge = self.create_publisher(UInt64, "~/received", LATCHED)
        self._diagnostics = self.create_publisher(
            message_class("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", 10
        )
        self.create_timer(_TICK_S, self.guarded(self._tick), clock=steady)
        self.create_timer(1.0, self.guarded(self._diagnose), clock=steady)
        for name, start in (
            ("save", lambda run: run.save()),
            ("load", lambda run: run.load()),
            ("reset", lambda run: run.reset()),
            ("pause", lambda run: run.pause(True)),
            ("resume", lambda run: run.pause(False)),
            ("optimize", lambda run: run.control("optimize")),
            ("clear_closures", lambda run: run.control("clear_closures")),
        ):
            serve_later(self, f"~/{name}", partial(self._serve, start))

    # -- lifecycle ---------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters and files, compile, make the publishers."""
        return self._transition("inactive", self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen and broadcast."""
        return self._transition("active", lambda: self._configured().activate())

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Listen no more; what was taken stays."""
        return self._transition("inactive", lambda: self._configured().deactivate())

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Save and forget the run."""
        return self._transition("unconfigured", self.finish)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Save and end."""
        return self._transition("finalized", self.finish)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Whatever failed, the node can be configured again."""
        return self._transition("unconfigured", self.finish)

    def _transition(self, state: str, action: Callable[[], object]) -> TransitionCallbackReturn:
        try:
            action()
        except Exception as error:
            text = str(error) if isinstance(error, GraphSlamError) else f"a fault of ours, {_said(error)}"
            self.get_logger().fatal(text)
            return _FAILURE
        self._state = state
        return _SUCCESS

    def _configure(self) -> None:
        if self._run is None:
            run = _Run(self)  # first what may be refused
            self.get_logger().info("compiling kernels (once per installation)")
            self.get_logger().info(f"kernels ready after {warmup():.1f} s")
            self._run = run
            if self.config.output.load_at_start:
                run.in_passing(run.load())

    def _configured(self) -> "_Run":
        if self._run is None:
            raise GraphSlamError("not configured")
        return self._run

    def finish(self, patience_s: float | None = None) -> None:
        """Save what was not saved yet, and take everything away.

        Parameters
        ----------
        patience_s : how long a solve that goes on may still take; None: as long as it takes
        """
        if self._run is not None:
            run, self._run = self._run, None
            run.finish(patience_s)

    # -- parameters --------------------------------------------------------------------------------------------------

    def set_parameters_atomically(self, parameter_list: Any) -> SetParametersResult:
        """As rclpy's; who misspells a name is told the nearest."""
        try:
            return super().set_parameters_atomically(parameter_list)
        except ParameterNotDeclaredException:
            try:
                self.config.changed({one.name: one.value for one in parameter_list})
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
            raise

    def _on_set(self, given: Sequence[Any]) -> SetParametersResult:
        """All of them or none, and what may change at work takes effect at its place among the measurements."""
        try:
            config, values = changed(self.config, given, is_configured=self._run is not None)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.config = config
        if self._run is not None and values:
            self._run.set(values)
        return SetParametersResult(successful=True)

    # -- the run -----------------------------------------------------------------------------------------------------

    def _serve(self, start: "Callable[[_Run], Future[str]]") -> "Future[str]":
        if self._run is None:
            raise GraphSlamError(f"not active: the node is {self._state}")
        return start(self._run)

    def acknowledge(self, count: int) -> None:
        """Tell a player how many messages were taken."""
        self._acknowledge.publish(UInt64(data=count))

    @property
    def has_player(self) -> bool:
        """Whether somebody waits for that."""
        return self._acknowledge.get_subscription_count() > 0

    @property
    def now_ns(self) -> int:
        """ROS time; 0 before the first /clock where that is used."""
        return int(self.get_clock().now().nanoseconds)

    def guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Nothing ends the node: what a callback raises is counted, and told with its origin once."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self._faults.append(time.monotonic())
                if self._run is not None:
                    self._run.counters.count("node", type(error).__name__)
                key = f"{type(error).__name__}: {error}"
                if key not in self._told and len(self._told) < 1000:
                    self._told.add(key)
                    self.get_logger().error("".join(traceback.format_exception(error)))
                self.get_logger().error(key, throttle_duration_sec=5.0)

        return guarded

    def _tick(self) -> None:
        if self._run is not None:
            self._run.tick()

    def _diagnose(self) -> None:
        facts = health.Facts(self._state) if self._run is None else self._run.facts(self._state)
        since = time.monotonic() - 10.0
        facts = replace(facts, faults=sum(at > since for at in self._faults))
        verdict = health.judge(facts, self.config)
        self._tell(verdict)
        statuses = health.statuses(facts, verdict, self.get_name())
        self._diagnostics.publish(to_msg.diagnostics(self.now_ns, statuses))

    def _tell(self, verdict: health.Verdict) -> None:
        """In the log where it changes, numbers apart; what somebody must do something about, every few seconds."""
        before, self._verdict = self._verdict, verdict
        urgent = verdict.state in ("WAITING", "ERROR") and time.monotonic() - self._logged_s > _AGAIN_S
        if _without_numbers(before) == _without_numbers(verdict) and not urgent:
            return
        self._logged_s = time.monotonic()
        said = "; ".join((verdict.state, *verdict.reasons))
        if verdict.level == to_msg.OK:
            self.get_logger().info(said)
        else:
            self.get_logger().warn(said)


class _Run:
    """What there is from configuration to clean-up."""

    def __init__(self, node: GraphSlamNode) -> None:
        config = with_survey(node.config)
        self._node = node
        self.counters = Counters()  # of the border; those of the pipeline belong to the worker's thread
        self.counters.on_first = self._tell
        self._border = Border(config, self.counters, _installed(config))
        self._ahead = Ahead(config.time.future_s, self._clock_ns, partial(self._refuse, "future"))
        self._reckoning = Reckoning(config)
        self._session = Session(config, self.counters, self._on_update, self._tell)
        self._outputs = Outputs(node, config)
        self._worker = Worker(config.inputs.queue)
        self._listeners: Listeners | None = None
        self._broadcaster: Broadcaster | None = None
        self._jumps: Any = None
        self._is_paused = self._is_stopped = False
        self._sends_odometry = False
        self._with_twist = {one.name for one in config.sources if one.type == results.ODOMETRY}
        self._passed = self._done = 0  # messages, by this thread and by the worker's
        self._acknowledged = -1
        self._has_player = False
        self._looked: tuple[int, int] = 0, 0
        self._since_s = time.monotonic()
        self._initial = node.create_subscription(
            message_class(results.POSE),
            "initialpose",
            node.guarded(self._on_initial_pose),
            10,
            raw=True,
        )

    def activate(self) -> None:
        """Listen and broadcast; twice is as good as once."""
        if self._listeners is not None:
            return
        node, config = self._node, self._node.config
        self._broadcaster = Broadcaster(node, config, node.guarded, self._look)
        self._listeners = Listeners(node, config, self._border, self._take, node.guarded, self._broadcaster.heard)
        back = Duration(nanoseconds=-round(config.time.jump_back_s * 1e9))
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=True)
        self._jumps = node.get_clock().create_jump_callback(threshold, post_callback=node.guarded(self._on_jump))
        self._since_s = time.monotonic()

    def deactivate(self) -> None:
        """Neither listen nor broadcast."""
        if self._listeners is None or self._broadcaster is None:
            return
        self._listeners.close()
        self._broadcaster.close()
        self._jumps.unregister()
        self._listeners = self._broadcaster = None

    def finish(self, patience_s: float | None) -> None:
        """Save what was not saved yet, and take everything away."""
        self.deactivate()
        self._node.destroy_subscription(self._initial)
        self._hand_over(self._border.finish())
        if self._worker.stop(patience_s):
            if folder := self._session.finish():
                self._node.get_logger().info(f"saved {folder}")
        else:
            self._session.abandon()
            self._node.get_logger().error("a solve takes too long to wait for: replay the run folder for its results")
        self._outputs.close()

    # -- in the main thread: messages --------------------------------------------------------------------------------

    def _take(self, measured: Sequence[Measured], cdr: bytes) -> None:
        """Pass on what one message has given, or was waiting for it."""
        for m in measured:
            if isinstance(m, Odometry) and self._reckoning.hear(m, self._session.estimate) and self._sends_odometry:
                self._send_odometry(m, cdr)
        for some in self._ahead.pass_on(measured):
            self._hand_over(some)

    def _hand_over(self, measured: Sequence[Measured]) -> None:
        """To the worker; refused before it is accepted where there is no room, or nobody wants it now."""
        reason = "stopped" if self._is_stopped else "paused" if self._is_paused else ""
        if measured and not reason:
            if self._worker.offer(self._node.guarded(partial(self._use, measured))):
                return
            reason = "overflow"
        self._refuse(reason, measured)

    def _refuse(self, reason: str, measured: Sequence[Measured]) -> None:
        """A message that goes no further: the reason counts for each thing it said."""
        for m in measured:
            self.counters.count(m.source if isinstance(m, Odometry) else m.topic, reason)
        self._passed += 1

    def _clock_ns(self) -> int:
        """The clock that stamps are judged by: of a recording that is played it is no better than they are."""
        return 0 if self._node.get_parameter("use_sim_time").value else self._node.now_ns

    def _send_odometry(self, m: Odometry, cdr: bytes) -> None:
        estimate, config = self._session.estimate, self._node.config
        if estimate is None or not estimate.is_confirmed:
            return
        frames, unused = config.frames, config.output.pose_covariance_max
        twist = twist_of(cdr, frames.base) if m.source in self._with_twist else None
        pose, covariance = self._reckoning.pose(estimate)
        self._outputs.odometry(to_msg.odometry(m.stamp_ns, frames.map, frames.base, pose, covariance, unused, twist))

    def _on_initial_pose(self, cdr: bytes) -> None:
        for pose in self._border.initial_pose(cdr):
            self.in_passing(self._worker.call(partial(self._session.take, [pose])))

    def _on_jump(self, jump: Any) -> None:
        """The clock jumped back, or another one is used."""
        estimate = self._session.estimate
        self._ahead.forget_time()
        if estimate is None and not self._worker.waiting:
            return
        what = self._node.config.time.on_jump
        self._tell("clock", f"jumped by {jump.delta.nanoseconds * 1e-9:.3f} s: {what}")
        self._border.forget_time()
        self._reckoning.forget()
        self._outputs.forget_time()
        if self._broadcaster is not None:
            self._broadcaster.forget_time()
        if what == "stop":
            self._is_stopped = True
        elif what == "reset":
            self.in_passing(self.reset())
        else:
            self.in_passing(self.control("time_jump"))

    def _look(self) -> tuple[Config, Estimate | None, Odometry | None]:
        return self._node.config, self._session.estimate, self._reckoning.newest

    def tick(self) -> None:
        """Ten times a second: what has waited long enough, and what somebody may have begun to listen to."""
        for some in self._ahead.waited():
            self._hand_over(some)
        if self._listeners is not None:
            self._listeners.tick(self._node.now_ns)
        self._sends_odometry = self._outputs.has_listeners("odometry")
        self._has_player = self._node.has_player
        self._publish_received()
        if self._worker.waiting < _ACKNOWLEDGE and self._outputs.are_due(self._node.config):
            self._worker.offer(self._node.guarded(self._publish_due))

    def _publish_received(self) -> None:
        count = self._passed + self._done
        if count != self._acknowledged:
            self._acknowledged = count
            self._node.acknowledge(count)

    def _tell(self, source: str, reason: str) -> None:
        self._node.get_logger().warn(f"{source}: {reason} (told once, counted from now on)")

    # -- services: begun here, done by the worker --------------------------------------------------------------------

    def save(self) -> "Future[str]":
        """Solve everything and write the run folder."""
        self._hand_over(self._border.finish())
        return self._worker.call(self._session.save)

    def load(self) -> "Future[str]":
        """Go on from an earlier run."""
        return self._anew(partial(self._session.load, self._node.config.output.load))

    def reset(self) -> "Future[str]":
        """Save, and begin anew."""
        return self._anew(self._session.reset)

    def _anew(self, job: Callable[[], str]) -> "Future[str]":
        self._is_stopped = False
        self._reckoning.forget()

        def begin() -> str:
            said = job()
            self._outputs.begin(self._node.config)
            self._outputs.publish_due(self._session.slam)
            return said

        return self._worker.call(begin)

    def pause(self, is_paused: bool) -> "Future[str]":
        """Take nothing more, or again."""
        self._is_paused = is_paused
        return self._worker.call(lambda: "paused" if is_paused else "takes measurements")

    def control(self, event: str) -> "Future[str]":
        """An event of the ingest sequence."""
        return self._worker.call(partial(self._session.control, event))

    def set(self, values: dict[str, Any]) -> None:
        """Change parameters at this place of the ingest sequence."""
        self.in_passing(self._worker.call(partial(self._session.take, [Control("set", tuple(values.items()))])))

    def in_passing(self, future: "Future[Any]") -> None:
        """Where nobody waits for what was begun, the log says that it failed."""

        def note(done: "Future[Any]") -> None:
            if (error := done.exception()) is not None:
                self._node.get_logger().error(str(error) if isinstance(error, GraphSlamError) else _said(error))

        future.add_done_callback(note)

    # -- in the worker's thread --------------------------------------------------------------------------------------

    def _use(self, measured: Sequence[Measured]) -> None:
        try:
            self._session.take(measured)
        finally:
            self._done += 1
            if self._has_player and (not self._worker.waiting or self._done % _ACKNOWLEDGE == 0):
                self._publish_received()

    def _on_update(self, slam: GraphSlam, update: Update) -> None:
        estimate, tf = self._session.estimate, slam.config.tf
        self._outputs.update(slam, update, is_confirmed=estimate is not None and estimate.is_confirmed)
        moved = update.correction
        if update.solved and (moved.distance_m > tf.report_jump_m or moved.angle_rad > tf.report_jump_rad):
            slam.counters.count("tf", "jump")
            self._node.get_logger().warn(events.correction(slam, update).message)

    def _publish_due(self) -> None:
        self._outputs.publish_due(self._session.slam)

    # -- facts -------------------------------------------------------------------------------------------------------

    def facts(self, lifecycle: str) -> health.Facts:
        """For the verdict."""
        session, node, broadcaster = self._session, self._node, self._broadcaster
        if not self._worker.waiting and node.now_ns:
            self._worker.offer(node.guarded(session.evaluate))
        counters = Counters()
        for some in (self.counters, session.slam.counters):
            counters.update(some)
        counted = counters.as_dict()
        overflows = sum(of.get("overflow", 0) for of in counted.values())
        failures = session.failures
        before, self._looked = self._looked, (overflows, failures)
        rivals = broadcaster.candidates() if broadcaster is not None and broadcaster.has_rival else None
        inputs = self._listeners.facts(node.now_ns, counted) if self._listeners is not None else ()
        twins = node.get_node_names_and_namespaces().count((node.get_name(), node.get_namespace())) - 1
        return health.Facts(
            lifecycle,
            inputs,
            session.estimate,
            waits_for_clock=node.get_parameter("use_sim_time").value and not node.now_ns,
            is_paused=self._is_paused,
            is_stopped=self._is_stopped,
            lag_s=self._worker.lag_s,
            waiting=self._worker.waiting,
            worker_is_alive=self._worker.is_alive,
            overflows=overflows - before[0],
            failures=failures - before[1],
            recording_fails=session.recording_fails,
            path_version=self._outputs.path_version,
            has_other_authority=rivals is not None,
            authorities=rivals or (),
            twins=twins,
        )


def _installed(config: Config) -> dict[str, Decoder]:
    """Decoders of the types whose layout is known to the packages that are installed, and not to us."""
    names = {one.type for one in config.sources if one.name in uses(config)} - set(typestore().types)
    return {name: partial(deserialize_message, message_type=message_class(name)) for name in names}


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _without_numbers(verdict: health.Verdict) -> tuple[str, ...]:
    return (verdict.state, *(re.sub(r"\d+(\.\d+)?", "#", reason) for reason in verdict.reasons))


class _Told:
    """Whether Ctrl-C or SIGTERM came: noted, never raised, so that no message is left half-way.

    A launch file sends Ctrl-C on to a node that the terminal has told already: what comes twice at once is once.
    """

    def __init__(self) -> None:
        self.at_s = 0.0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    @property
    def to_stop(self) -> bool:
        """Whether it did."""
        return self.at_s > 0.0

    def _note(self, number: int, frame: Any) -> None:
        if self.to_stop and number == signal.SIGINT and time.monotonic() - self.at_s > 1.0:
            os._exit(128 + number)  # asked for again: at once
        self.at_s = self.at_s or time.monotonic()


def main() -> int:
    """Run the node until it is told to stop; returns the exit code: 0, 1 our fault, 2 refused to start or save."""
    told = _Told()
    sys.setswitchinterval(_SWITCH_S)
    try:
        _init()
        node = GraphSlamNode()
        executor = _executor()
        executor.add_node(node)
        if node.config.node.autostart and not _started(node, told):
            return 2
        while not told.to_stop and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
        node.finish(_STOP_S)
        executor.shutdown()
        node.destroy_node()
    except GraphSlamError as error:
        rclpy.logging.get_logger("graph_slam").fatal(str(error))
        return 2
    except Exception as error:
        rclpy.logging.get_logger("graph_slam").fatal(f"a fault of ours, {_said(error)}")
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _started(node: GraphSlamNode, told: _Told) -> bool:
    """Configure and activate."""
    for trigger in (node.trigger_configure, node.trigger_activate):
        if told.to_stop:
            return True
        if trigger() != _SUCCESS:
            return False
    return True


def _executor() -> Any:
    """The quickest there is: rclpy's events executor takes a fifth of the time per message (docs/benchmarks.md)."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # Humble
        from rclpy.executors import SingleThreadedExecutor as EventsExecutor
    return EventsExecutor()


def _init() -> None:
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy has several for arguments and files it cannot read
        raise GraphSlamError(" ".join(str(error).split())) from None


if __name__ == "__main__":
    sys.exit(main())
