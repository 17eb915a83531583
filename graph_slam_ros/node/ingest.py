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
from graph_slam_ros.findings.table import explain, remedy
from graph_slam_ros.measurements.types import InitialPose, Measured
from graph_slam_ros.messages import results, to_msg
from graph_slam_ros.messages.from_msg import INITIAL_POSE, Decoder, MessageConverter, twist_of
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.interfaces import message_class, typestore
from graph_slam_ros.messages.to_msg import OK, WARN
from graph_slam_ros.node import events
from graph_slam_ros.node.events import Outcome
from graph_slam_ros.node.input_check import InputCheck
from graph_slam_ros.node.pose_extrapolator import PoseExtrapolator
from graph_slam_ros.node.publishers import Publishers, PublishingClock
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.worker import Worker
from graph_slam_ros.slam import Config, Control, Counters, Odometry
from graph_slam_ros.slam.edits import SOURCE as EDITS
from graph_slam_ros.slam.edits import removal
from graph_slam_ros.slam.frontend.ingest_gate import JUMP_BACK_S, IngestGate, Passage

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode

OnJump = Callable[[Passage, str, str], None]

_PATIENCE_S = 1.0  # for the clock to reach a stamp
_SHOWN = 80  # characters of a text that somebody has sent


class Ingest:
    """Passes measurements to the worker in order of arrival, or refuses and counts them.

    All of it runs in the main thread.

    Parameters
    ----------
    counters : of what is refused before the pipeline
    on_jump : called where time jumped back, before anything of the new time goes on: with the decision of the gate,
        what tells of the jump, and how

    Attributes
    ----------
    check : checks what is measured while the robot drives
    converter : makes measurements of messages
    gate : decides what a jump of time, a pause and a full queue mean
    extrapolator : the pose by the newest odometry
    outcome : what became of the last ~/remove or initialpose that was not used; None before the first
    """

    def __init__(
        self,
        node: "GraphSlamNode",
        config: Config,
        counters: Counters,
        session: Session,
        worker: Worker,
        publishers: Publishers,
        clock: PublishingClock,
        on_jump: OnJump,
    ) -> None:
        self._node, self._session, self._worker = node, session, worker
        self._publishers, self._clock, self._on_jump = publishers, clock, on_jump
        self._counters = counters
        topics = {one.name: _full_topic(node, one.topic) for one in config.sources if one.name in uses(config)}
        self.check = InputCheck(config, topics, counters)
        self.converter = MessageConverter(config, counters, _installed(config))
        self.converter.on_fault = node.get_logger().error
        self.gate = IngestGate(counters, lambda: node.now_ns)
        self.extrapolator = PoseExtrapolator(config)
        self.outcome: Outcome | None = None
        self._future_stamps = FutureStamps(config.time.future_s, self._stamp_clock_ns, partial(self.refuse, "future"))
        self._publishes_odometry = False
        self._with_twist = {one.name for one in config.sources if one.type == results.ODOMETRY}
        self._clock_jumps: Any = None
        create, guarded = node.create_subscription, node.guarded
        pose, text = message_class(results.POSE), message_class("std_msgs/msg/String")
        self._subscriptions = (
            create(pose, "initialpose", guarded(self._on_initial_pose), 10, raw=True),
            create(text, "~/remove", guarded(self._on_remove), 10),
        )

    def activate(self) -> None:
        """Watch the clock for jumps."""
        back = Duration(nanoseconds=-round(JUMP_BACK_S * 1e9))
        threshold = JumpThreshold(min_forward=None, min_backward=back, on_clock_change=True)
        clock, callback = self._node.get_clock(), self._node.guarded(self._on_clock_jump)
        self._clock_jumps = clock.create_jump_callback(threshold, post_callback=callback)

    def deactivate(self) -> None:
        """Stop watching the clock for jumps."""
        self._clock_jumps.unregister()

    def finish(self) -> None:
        """Pass on or refuse all held messages, and unsubscribe."""
        for measured in self._future_stamps.due(patience_s=0.0):
            self.hand_over(measured)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self.hand_over(self.converter.finish())

    def tick(self) -> None:
        """Pass on the held messages that are due, ten times a second."""
        for measured in self._future_stamps.due():
            self.hand_over(measured)
        self._publishes_odometry = self._publishers.has_subscribers("odometry")

    # -- measurements ------------------------------------------------------------------------------------------------

    def receive(self, measured: Sequence[Measured], cdr: bytes) -> None:
        """Pass on the measurements of a message, and earlier ones that its transforms complete."""
        if self.gate.is_from_before(measured):
            self.refuse("before_jump", measured)
            return
        newest = [m for m in measured if isinstance(m, Odometry) and self._is_newest(m)]
        if newest and self._publishes_odometry:
            self._publish_odometry(newest[-1], cdr)
        for some in self._future_stamps.pass_on(measured):
            self.hand_over(some)

    def hand_over(self, measured: Sequence[Measured]) -> None:
        """Pass a message to the worker unless the gate refuses it. A refused message is not accepted."""
        passage = self.gate.admit(measured, self._node.config.time.on_jump, has_room=self._worker.has_room)
        if passage.jump:
            self._on_jump(passage, "stamps", "odometry has gone back in time and stays there")
        if passage.measured:
            self._session.accept(passage.measured)
            self._worker.offer(
                partial(self._session.process, passage.measured),
                partial(self._clock.after_message, passage.measured),
            )
        else:
            self._clock.refused += 1

    def refuse(self, reason: str, measured: Sequence[Measured]) -> None:
        """Count a message that is refused."""
        self.gate.refuse(reason, measured)
        self._clock.refused += 1

    # -- odometry in the map -----------------------------------------------------------------------------------------

    def _is_newest(self, m: Odometry) -> bool:
        """Return whether odometry is the newest. A message ahead of the clock would stay the newest for long."""
        return not self._future_stamps.is_ahead([m]) and self.extrapolator.on_odometry(m, self._session.estimate)

    def _publish_odometry(self, m: Odometry, cdr: bytes) -> None:
        estimate, frames, unused = self._session.estimate, self._node.config.frames, to_msg.UNUSED
        if estimate is None or not estimate.is_located:
            return
        twist = twist_of(cdr, frames.base) if m.source.partition("#")[0] in self._with_twist else None
        pose, covariance = self.extrapolator.pose(estimate)
        self._publishers.odometry(to_msg.odometry(m.stamp_ns, frames.map, frames.base, pose, covariance, unused, twist))

    # -- events ------------------------------------------------------------------------------------------------------

    def in_sequence(self, events: Sequence[Control | InitialPose]) -> "Future[None]":
        """Accept and process an event at its place among the measurements."""
        self._session.accept(events)
        return self._worker.call(partial(self._session.process, events))

    def _on_initial_pose(self, cdr: bytes) -> None:
        before = self._counters.as_dict()
        poses = self.converter.initial_pose(cdr)
        if not poses:
            self._report(INITIAL_POSE, "initialpose: not used", before, self._counters)
        for pose in poses:
            self._publish_outcome("initialpose: used", is_done=True)
            self._node.in_background(self.in_sequence([pose]))

    def _on_remove(self, message: Any) -> None:
        try:
            event = removal(message.data)
        except GraphSlamError as error:
            self._publish_outcome(str(error), is_done=False)
            return
        self._session.accept([event])

        def remove() -> None:
            slam = self._session.slam
            before, known = slam.counters.as_dict(), list(slam.view.landmarks)
            self._session.process([event])
            near = did_you_mean(str(dict(event.values).get("landmark", "")), known)
            self._report(EDITS, f"~/remove: {message.data[:_SHOWN]}", before, slam.counters, near)

        self._node.in_background(self._worker.call(remove))

    def _report(
        self, source: str, what: str, before: Mapping[str, Mapping[str, int]], counters: Counters, near: str = ""
    ) -> None:
        """Say what became of what was asked for on a topic, by what has been counted since."""
        known, why = before.get(source, {}), list[str]()
        for reason, times in counters.as_dict().get(source, {}).items():
            if times > known.get(reason, 0) and reason != "removed":
                mend = remedy(source, reason)
                near = near * (reason == "unknown_landmark")
                why.append(f"{explain(reason).meaning} ({reason}){mend and ': '}{mend}{near}")
        self._publish_outcome(f"{what}: {'; '.join(why) or 'done'}", is_done=not why)

    def _publish_outcome(self, text: str, *, is_done: bool) -> None:
        """Log what became of it; say it on ~/events and, as the last, on /diagnostics: a topic has no answer."""
        self.outcome = Outcome(text, is_done=is_done)
        if not is_done:
            self._node.get_logger().warn(text)
        self._publishers.publish_events(self._node.now_ns, [events.happened("asked", text, OK if is_done else WARN)])

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
        if self._session.estimate is None and not self._worker.waiting:
            return
        passage = self.gate.begin_anew(self._node.config.time.on_jump)
        self._on_jump(passage, "clock", f"jumped by {jump.delta.nanoseconds * 1e-9:.3f} s")


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


def _installed(config: Config) -> dict[str, Decoder]:
    """Decoders of types whose layout only an installed package has."""
    names = {one.type for one in config.sources if one.name in uses(config)} - set(typestore().types)
    return {name: partial(deserialize_message, message_type=message_class(name)) for name in names}
