"""The path of measurements from the callbacks to the worker: checks of future stamps and jumps of time."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message

from graph_slam_ros.errors import GraphSlamError, did_you_mean
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.findings.table import explain
from graph_slam_ros.measurements.types import InitialPose, Measured
from graph_slam_ros.messages import results, to_msg
from graph_slam_ros.messages.from_msg import INITIAL_POSE, MessageConverter, twist_of
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.interfaces import message_class, typestore
from graph_slam_ros.messages.to_msg import OK, WARN, Status
from graph_slam_ros.node import events
from graph_slam_ros.node.input_check import InputCheck
from graph_slam_ros.node.pose_extrapolator import PoseExtrapolator
from graph_slam_ros.slam import Config, Control, Counters, Odometry
from graph_slam_ros.slam.edits import SOURCE as EDITS
from graph_slam_ros.slam.edits import removal
from graph_slam_ros.slam.frontend.ingest_gate import JUMP_BACK_S, IngestGate

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode
    from graph_slam_ros.node.runtime import Runtime

_PATIENCE_S = 1.0  # for the clock to reach a stamp
_SHOWN = 80  # characters of a text that somebody has sent


class Ingest:
    """Passes measurements to the worker in order of arrival, or refuses and counts them, all in the main thread.

    Attributes
    ----------
    check : checks what is measured while the robot drives
    converter : makes measurements of messages
    gate : decides what a jump of time, a pause and a full queue mean
    extrapolator : the pose by the newest odometry
    outcome : what became of the last ~/remove or initialpose; None before the first
    """

    def __init__(self, run: "Runtime", config: Config) -> None:
        self._run, self._node = run, (node := run.node)
        used = [one for one in config.sources if one.name in uses(config)]
        types = {one.type for one in used} - set(typestore().types)  # whose layout only an installed package has
        installed = {name: partial(deserialize_message, message_type=message_class(name)) for name in types}
        self.check = InputCheck(config, {one.name: _full_topic(node, one.topic) for one in used}, run.counters)
        self.converter = MessageConverter(config, run.counters, installed)
        self.converter.on_fault = node.get_logger().error
        self.gate = IngestGate(run.counters, lambda: node.now_ns)
        self.extrapolator = PoseExtrapolator(config)
        self.outcome: Status | None = None
        self._future_stamps = FutureStamps(config.time.future_s, self._stamp_clock_ns, partial(self.refuse, "future"))
        self._publishes_odometry = False
        self._with_twist = {one.name for one in config.sources if one.type == results.ODOMETRY}
        pose, text = message_class(results.POSE), message_class("std_msgs/msg/String")
        self._subscriptions = (
            node.create_subscription(pose, "initialpose", node.guarded(self._on_initial_pose), 10, raw=True),
            node.create_subscription(text, "~/remove", node.guarded(self._on_remove), 10),
        )
        back = Duration(nanoseconds=-round(JUMP_BACK_S * 1e9))
        jump = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=True)
        on_jump = node.guarded(self._on_clock_jump)
        self._clock_jumps = node.get_clock().create_jump_callback(jump, post_callback=on_jump)

    def finish(self) -> None:
        """Pass on or refuse all held messages, and unsubscribe."""
        self._clock_jumps.unregister()
        for measured in self._future_stamps.due(patience_s=0.0):
            self.hand_over(measured)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self.hand_over(self.converter.finish())

    def tick(self) -> None:
        """Pass on the held messages that are due, ten times a second."""
        for measured in self._future_stamps.due():
            self.hand_over(measured)
        self._publishes_odometry = self._run.publishers.has_subscribers("odometry")

    # -- measurements ------------------------------------------------------------------------------------------------

    def receive(self, measured: Sequence[Measured]) -> None:
        """Pass on the measurements of a message, and earlier ones that its transforms complete."""
        if self.gate.is_from_before(measured):
            self.refuse("before_jump", measured)
            return
        newest = [m for m in measured if isinstance(m, Odometry) and self._is_newest(m)]
        if newest and self._publishes_odometry:
            self._publish_odometry(newest[-1])
        for some in self._future_stamps.pass_on(measured):
            self.hand_over(some)

    def hand_over(self, measured: Sequence[Measured]) -> None:
        """Pass a message to the worker unless the gate refuses it. A refused message is not accepted."""
        run = self._run
        passage = self.gate.admit(measured, self._node.config.time.on_jump, has_room=run.worker.has_room)
        if passage.jump:
            run.begin_anew(passage, "stamps", "odometry has gone back in time and stays there")
        if passage.measured:
            run.session.accept(passage.measured)
            run.worker.offer(
                partial(run.session.process, passage.measured),
                partial(run.publishers.after_message, passage.measured),
            )
        else:
            run.publishers.refused += 1

    def refuse(self, reason: str, measured: Sequence[Measured]) -> None:
        """Count a message that is refused."""
        self.gate.refuse(reason, measured)
        self._run.publishers.refused += 1

    def _is_newest(self, m: Odometry) -> bool:
        """Return whether odometry is the newest. A message ahead of the clock would stay the newest for long."""
        return not self._future_stamps.is_ahead([m]) and self.extrapolator.on_odometry(m, self._run.session.estimate)

    def _publish_odometry(self, m: Odometry) -> None:
        estimate, frames, unused = self._run.session.estimate, self._node.config.frames, to_msg.UNUSED
        if estimate is None or not estimate.is_located:
            return
        has_twist = m.source.partition("#")[0] in self._with_twist
        twist = twist_of(self.converter.decoded, frames.base) if has_twist else None
        pose, covariance = self.extrapolator.pose(estimate)
        message = to_msg.odometry(m.stamp_ns, frames.map, frames.base, pose, covariance, unused, twist)
        self._run.publishers.odometry(message)

    # -- what is asked for on a topic --------------------------------------------------------------------------------

    def in_sequence(self, events: Sequence[Control | InitialPose]) -> "Future[None]":
        """Accept and process an event at its place among the measurements."""
        self._run.session.accept(events)
        return self._run.worker.call(partial(self._run.session.process, events))

    def _on_initial_pose(self, cdr: bytes) -> None:
        before = self._run.counters.as_dict()
        poses = self.converter.initial_pose(cdr)
        if not poses:
            self._report(INITIAL_POSE, "initialpose: not used", before, self._run.counters)
        for pose in poses:
            self._publish_outcome("initialpose: used", is_done=True)
            self._node.in_background(self.in_sequence([pose]))

    def _on_remove(self, message: Any) -> None:
        try:
            event = removal(message.data)
        except GraphSlamError as error:
            self._publish_outcome(str(error), is_done=False)
            return
        session = self._run.session
        session.accept([event])

        def remove() -> None:
            slam = session.slam
            before, known = slam.counters.as_dict(), list(slam.view.landmarks)
            session.process([event])
            near = did_you_mean(str(dict(event.values).get("landmark", "")), known)
            self._report(EDITS, f"~/remove: {message.data[:_SHOWN]}", before, slam.counters, near)

        self._node.in_background(self._run.worker.call(remove))

    def _report(
        self, source: str, what: str, before: Mapping[str, Mapping[str, int]], counters: Counters, near: str = ""
    ) -> None:
        """Say what became of what was asked for on a topic, by what has been counted since."""
        known, why = before.get(source, {}), list[str]()
        for reason, times in counters.as_dict().get(source, {}).items():
            if times > known.get(reason, 0) and reason != "removed":
                text = f"{explain(reason).meaning} ({reason})"
                near = near * (reason == "unknown_landmark")
                why.append(f"{Finding(reason, 'warning', text=text, source=source)}{near}")
        self._publish_outcome(f"{what}: {'; '.join(why) or 'done'}", is_done=not why)

    def _publish_outcome(self, text: str, *, is_done: bool) -> None:
        """Log what became of it; say it on ~/events and, as the last, on /diagnostics: a topic has no answer."""
        self.outcome = outcome = events.happened("asked", text, OK if is_done else WARN)  # two threads come here
        if not is_done:
            self._node.get_logger().warn(text)
        self._run.publishers.publish_events(self._node.now_ns, [outcome])

    # -- time --------------------------------------------------------------------------------------------------------

    def forget_time(self) -> None:
        """Forget everything that depends on stamps: the next stamps belong to another time."""
        self.converter.forget_time()
        self.check.forget()
        self.extrapolator.forget()

    def _stamp_clock_ns(self) -> int:
        """The clock for the check of stamps; 0 if a recording is played, whose clock is no better than its stamps."""
        return 0 if self._node.get_parameter("use_sim_time").value else self._node.now_ns

    def _on_clock_jump(self, jump: Any) -> None:
        """Decide what to do after the clock jumped back, or was replaced by another."""
        self._future_stamps.forget_time()
        self.gate.clock_jumped(jump.delta.nanoseconds)
        if self._run.session.estimate is None and not self._run.worker.waiting:
            return
        passage = self.gate.begin_anew(self._node.config.time.on_jump)
        self._run.begin_anew(passage, "clock", f"jumped by {jump.delta.nanoseconds * 1e-9:.3f} s")


class FutureStamps:
    """Holds messages dated ahead of the clock, which may be late itself. Refuses those that stay ahead.

    Parameters
    ----------
    most_s : a stamp may be this far ahead of the clock; 0: any stamp passes
    now_ns : the clock; 0 where there is none, then everything passes
    on_refused : called with each message that has waited too long
    """

    def __init__(
        self, most_s: float, now_ns: Callable[[], int], on_refused: Callable[[Sequence[Measured]], None]
    ) -> None:
        self._most_ns, self._now_ns, self._on_refused = round(most_s * 1e9), now_ns, on_refused
        self._until_ns = 0  # stamps up to here pass without a look at the clock
        self._held: deque[tuple[float, Sequence[Measured]]] = deque()

    def pass_on(self, messages: Sequence[Measured]) -> Iterable[Sequence[Measured]]:
        """The measurements of messages that are due now: this one and held ones."""
        if not self._held and (not self._most_ns or not self.is_ahead(messages)):
            return (messages,)
        self._held.append((time.monotonic(), messages))
        return self.due()

    def due(self, patience_s: float = _PATIENCE_S) -> list[Sequence[Measured]]:
        """The held measurements that are due now. Those held for too long are refused."""
        out = []
        while self._held:
            since_s, messages = self._held[0]
            if not self.is_ahead(messages):
                out.append(messages)
            elif time.monotonic() - since_s < patience_s:
                break
            else:
                self._on_refused(messages)
            self._held.popleft()
        return out

    def is_ahead(self, messages: Sequence[Measured]) -> bool:
        """Return whether one of the messages is too far ahead of the clock."""
        newest_ns = max((m.stamp_ns for m in messages), default=0)
        if newest_ns <= self._until_ns:
            return False
        now_ns = self._now_ns()
        self._until_ns = now_ns + self._most_ns if now_ns else 0
        return bool(now_ns) and newest_ns > self._until_ns

    def forget_time(self) -> None:
        """Begin anew with the clock."""
        self._until_ns = 0


def _full_topic(node: "GraphSlamNode", topic: str) -> str:
    """The full name of a topic; as it is where it is not valid, which the activation refuses."""
    try:
        return node.resolve_topic_name(topic)
    except Exception:  # rclpy raises what differs by version
        return topic
