"""The ROS node: its lifecycle, parameters, services and state. ``runtime`` handles the messages."""

import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy comes in: threads would reorder sums

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from graph_slam_ros.errors import ConfigError, GraphSlamError, message_of
from graph_slam_ros.messages import to_msg
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.node import bond, diagnostics
from graph_slam_ros.node.parameters import changed, declare_parameters, files_for_others
from graph_slam_ros.node.runtime import Runtime
from graph_slam_ros.node.services import SERVICES, serve_later, serve_maps
from graph_slam_ros.node.worker import URGENT_S

_SUCCESS, _FAILURE, _ERROR = (getattr(TransitionCallbackReturn, name) for name in ("SUCCESS", "FAILURE", "ERROR"))
_TICK_S = 0.1
_AGAIN_S = 5.0
_SWITCH_S = 5e-4  # a callback waits no longer than this for the worker's Python; the default is ten times that


class GraphSlamNode(LifecycleNode):
    """Online pose-graph SLAM with odometry, landmark sightings, fixes and closures.

    Its topics are in ``messages/topics.py``. When configured, it has read its parameters, opened its run folder and
    made its publishers. Its kernels are loaded or compiled meanwhile. When active, it subscribes and broadcasts
    map -> odom. During long work, ``is_stop_requested`` is asked.
    """

    def __init__(self, is_stop_requested: Callable[[], bool] = lambda: False, **options: Any) -> None:
        super().__init__("graph_slam", **options)
        self._is_stop_requested = is_stop_requested
        for sentence in files_for_others(sys.argv, self.get_fully_qualified_name()):
            self.get_logger().warn(sentence)
        self.config = declare_parameters(self)
        self._run: Runtime | None = None
        self._bond: bond.Bond | None = None
        self._faults: deque[float] = deque(maxlen=1000)
        self._logged: set[str] = set()
        self._verdict = diagnostics.Health("")
        self._logged_s = 0.0
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # whatever becomes of /clock
        self._diagnostics = self.create_publisher(
            message_class("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", 10
        )
        self.create_timer(_TICK_S, self.guarded(self._tick), clock=steady)
        self.create_timer(1.0, self.guarded(self._diagnose), clock=steady)
        for name, start in SERVICES.items():
            serve_later(self, f"~/{name}", partial(self._serve, start))
        serve_maps(self)
        if not self.config.node.autostart and not bond.is_installed():
            self.get_logger().warn(bond.MISSING)
        for service in self.services:
            service.callback = self._answered(service)

    # -- lifecycle ---------------------------------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check parameters and files, start to load or compile the kernels, create the publishers."""
        return self._transition(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and broadcast."""
        return self._transition(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe. Accepted measurements stay."""
        return self._transition(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Save and forget the run."""
        return self._transition(self.finish)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Save and end, even if saving fails."""
        return self._transition(self.finish, _FAILURE)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove the run after any fault, so that the node can be configured again."""
        return self._transition(self.finish)

    @property
    def _state(self) -> str:
        """The state of the lifecycle, by rclpy."""
        return str(self._state_machine.current_state[1])

    def _transition(
        self, action: Callable[[], object], failed: TransitionCallbackReturn = _ERROR
    ) -> TransitionCallbackReturn:
        try:
            action()
        except Exception as error:
            self.get_logger().fatal(_cause(error))
            return failed
        return _SUCCESS

    def _configure(self) -> None:
        if self._run is None:
            self._run = run = Runtime(self)
            run.prepare(self._is_stop_requested)
            if self.config.journal.resume and run.session.was_cut_off:
                unused = "" if self.config.load_pose is None else "; output.load_pose is not used: it has driven since"
                self.get_logger().warn(f"the last run was never ended: going on in its map{unused}")
                self.in_background(run.resume())
            elif self.config.output.load_at_start:
                run.load_at_start()

    def _activate(self) -> None:
        self.configured().activate()
        if self._bond is None and not self.config.node.autostart and bond.is_installed():
            self._bond = bond.Bond(self)

    def _deactivate(self) -> None:
        self._end_bond()
        self.configured().deactivate()

    def _end_bond(self) -> None:
        if self._bond is not None:
            self._bond.end()
            self._bond = None

    def finish(self, patience_s: float | None = None) -> None:
        """Save what was not saved yet, and remove everything. Without a patience it takes its time until a stop."""
        self._end_bond()
        if self._run is not None:
            run, self._run = self._run, None
            run.finish(patience_s, self._is_stop_requested)

    def destroy_node(self) -> None:
        """Destroy the node at once; rclpy's state machine would keep it in the graph until garbage collection."""
        super().destroy_node()
        self._state_machine = None

    # -- parameters --------------------------------------------------------------------------------------------------

    def set_parameters_atomically(self, parameter_list: Any) -> SetParametersResult:
        """Set all or none by rclpy after our own checks, whose refusals name the parameter.

        An integer is accepted for a float, as it is at the start. While the node is configured, parameters take effect
        at their place among the measurements.
        """
        try:
            config, values = changed(self.config, parameter_list, is_configured=self._run is not None)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(
            [Parameter(one.name, value=values[one.name]) if one.name in values else one for one in parameter_list]
        )
        if result.successful:
            self.config = config
            if self._run is not None and values:
                self._run.set(values)
        return result

    # -- the run -----------------------------------------------------------------------------------------------------

    def _answered(self, service: Any) -> Callable[[Any, Any], Any]:
        """Wrap the callback of a service: it answers that nothing was done instead of raising.

        rclpy's own callbacks raise for a transition that the present state does not have, and for a parameter of an
        unknown type. The executor would raise that again, and the node would end.
        """
        answer = service.callback

        def answered(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except Exception as error:
                self.get_logger().warn(f"{service.srv_name}: {message_of(error)}")
                return service.srv_type.Response()

        return answered

    def _serve(self, start: "Callable[[Runtime], Future[str]]", _: Any) -> "Future[str]":
        return start(self.configured())

    def configured(self) -> Runtime:
        """The runtime, from configuration on. Raises GraphSlamError before."""
        if self._run is None:
            raise GraphSlamError(f"not configured: the node is {self._state}")
        return self._run

    @property
    def now_ns(self) -> int:
        """ROS time; 0 before the first /clock if simulated time is used."""
        return int(self.get_clock().now().nanoseconds)

    def guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback that never raises: an exception is counted, and logged with its traceback once."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self.report_fault(error)

        return guarded

    def in_background(self, future: "Future[Any]") -> None:
        """Log the exception of a job whose result is not used."""

        def report(done: "Future[Any]") -> None:
            if (error := done.exception()) is not None:
                self.get_logger().error(message_of(error))

        future.add_done_callback(report)

    @property
    def faults(self) -> int:
        """The number of exceptions of callbacks and jobs in the last ten seconds."""
        since = time.monotonic() - 10.0
        return sum(at > since for at in self._faults)

    def report_fault(self, error: Exception) -> None:
        """Count an exception of a callback or a job, and log its traceback once."""
        self._faults.append(time.monotonic())
        if self._run is not None:
            self._run.counters.count("node", type(error).__name__)
        key = f"{type(error).__name__}: {error}"
        if key not in self._logged and len(self._logged) < 1000:
            self._logged.add(key)
            self.get_logger().error("".join(traceback.format_exception(error)))
        self.get_logger().error(key, throttle_duration_sec=5.0)

    def _tick(self) -> None:
        if self._run is not None:
            self._run.tick()

    def _diagnose(self) -> None:
        facts = (
            diagnostics.Facts(self._state, faults=self.faults)
            if self._run is None
            else self._run.facts.collect(self._state)
        )
        verdict = diagnostics.judge(facts, self.config)
        self._log(verdict)
        statuses = diagnostics.statuses(facts, verdict, self.get_fully_qualified_name().lstrip("/"))
        self._diagnostics.publish(to_msg.diagnostics(self.now_ns, statuses))

    def _log(self, verdict: diagnostics.Health) -> None:
        """Log a new verdict; changed numbers alone are no new one. Repeat every few seconds one that needs action.

        A node that has just started to wait is no reason to warn: publishers need a moment to be discovered.
        """
        before, self._verdict = self._verdict, verdict
        has_lasted = before.state == verdict.state and time.monotonic() - self._logged_s > _AGAIN_S
        urgent = verdict.state in ("WAITING", "ERROR") and has_lasted
        if _kinds(before) == _kinds(verdict) and not urgent:
            return
        self._logged_s = time.monotonic()
        if verdict.level == to_msg.OK or (verdict.state == "WAITING" and not urgent):
            self.get_logger().info(verdict.text)
        else:
            self.get_logger().warn(verdict.text)


def _kinds(verdict: diagnostics.Health) -> list[str]:
    return [verdict.state, *(f"{one.code} {one.topic} {one.source}" for one in verdict.found)]


def _cause(error: Exception) -> str:
    return message_of(error) if isinstance(error, GraphSlamError) else f"internal error, {message_of(error)}"


class _StopRequest:
    """Notes Ctrl-C and SIGTERM instead of raising, so that each message is processed completely.

    A launch file forwards Ctrl-C to a node that already has it from the terminal: two at once count as one.
    """

    def __init__(self) -> None:
        self.at_s = 0.0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    @property
    def is_set(self) -> bool:
        """Return whether a stop was requested."""
        return self.at_s > 0.0

    def _note(self, number: int, frame: Any) -> None:
        if self.is_set and number == signal.SIGINT and time.monotonic() - self.at_s > 1.0:
            os._exit(128 + number)  # asked for again: at once
        self.at_s = self.at_s or time.monotonic()


def main() -> int:
    """Run the node until a stop is requested; returns 0, 1 (internal error) or 2 (refused to start or save)."""
    code = _run()
    if any(thread.daemon and thread is not threading.current_thread() for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)  # one that still solves would be ended inside compiled code, and abort the process
    return code


def _run() -> int:
    stop = _StopRequest()
    sys.setswitchinterval(_SWITCH_S)
    try:
        _init()
        node = GraphSlamNode(lambda: stop.is_set)
        executor = _executor()
        executor.add_node(node)
        if node.config.node.autostart and not _started(node, stop):
            return 2
        while not stop.is_set and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
        node.finish(URGENT_S)
        executor.shutdown()
        node.destroy_node()
    except Exception as error:
        rclpy.logging.get_logger("graph_slam").fatal(_cause(error))
        return 2 if isinstance(error, GraphSlamError) else 1
    finally:
        rclpy.try_shutdown()
    return 0


def _started(node: GraphSlamNode, stop: _StopRequest) -> bool:
    for trigger in (node.trigger_configure, node.trigger_activate):
        if stop.is_set:
            return True
        if trigger() != _SUCCESS:
            return stop.is_set
    return True


def _executor() -> Any:
    """The fastest executor: rclpy's events executor takes a fifth of the time per message."""
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
