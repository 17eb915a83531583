"""The node's subscriptions while it is active: raw messages in, measurements out, and counts of each topic."""

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial, wraps
from typing import TYPE_CHECKING, Any

try:
    from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
except ImportError:  # Humble
    from rclpy.qos_event import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.utilities import get_rmw_implementation_identifier

from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, TRANSFORMS, is_correction
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.inputs.landmark_types import LANDMARK_TYPES
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.node.diagnostics import InputFacts, Recent
from graph_slam_ros.node.ingest import Ingest
from graph_slam_ros.node.qos import InputQos, InputTopic, input_topics
from graph_slam_ros.slam import Config, Counters
from graph_slam_ros.slam.frontend.ingest_gate import input_of

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode
    from graph_slam_ros.node.tf_broadcaster import TfBroadcaster

_NUMBER = "publication_sequence_number"
_UNSUPPORTED = 2**63
_ASK_AGAIN_NS = 1_000_000_000


class Losses:
    """Counts lost messages by the numbers that their publisher gives them, where a topic has one publisher.

    Numbers of several publishers cannot be told apart: rclpy names no publisher with a message. So nothing is counted
    while there are several, and nothing at the first gap after the publisher changed.

    Parameters
    ----------
    publishers : returns the identifiers of the topic's publishers; it is asked at the first message and at gaps
    """

    def __init__(self, publishers: Callable[[], frozenset[bytes]]) -> None:
        self._publishers = publishers
        self._known: frozenset[bytes] = frozenset()
        self._expected: int | None = None
        self._ask_at_ns = 0

    def before(self, info: Mapping[str, Any], now_ns: int) -> int:
        """Return how many messages were lost between the last message and this one.

        Parameters
        ----------
        info : what rclpy says of a message beside its content
        now_ns : the time; while a topic has several publishers, they are asked for once a second
        """
        number = info.get(_NUMBER)
        if number is None or number >= _UNSUPPORTED:
            return 0
        expected, self._expected = self._expected, number + 1
        if (expected is not None and number <= expected) or now_ns < self._ask_at_ns:
            return 0
        before, self._known = self._known, self._publishers()
        if len(self._known) != 1:
            self._ask_at_ns = now_ns + _ASK_AGAIN_NS
            return 0
        return 0 if expected is None or self._known != before else number - expected


_MOST = 3  # that are named
_LANDMARKS = frozenset({"vision_msgs/msg/Detection3DArray", *LANDMARK_TYPES})


def alternatives(node: "GraphSlamNode", one: InputConfig, use: str, subscribed: Collection[str]) -> tuple[str, ...]:
    """Return a text for each topic of another node that the input could use, with the parameters that choose it.

    Parameters
    ----------
    use : of the input
    subscribed : the topics of all inputs
    """
    if one.type == TRANSFORMS:
        return ()
    found = [
        (kind != one.type, topic, kind)
        for topic, kinds in node.get_topic_names_and_types()
        for kind in kinds
        if kind == one.type or (use == "landmarks" and {kind, one.type} <= _LANDMARKS)
        if topic not in subscribed and any(_others(node, topic))
    ]
    return tuple(_text(one.name, topic, kind, is_other_type=differs) for differs, topic, kind in sorted(found)[:_MOST])


def _text(name: str, topic: str, kind: str, *, is_other_type: bool) -> str:
    if is_other_type:
        return f"{topic} has landmarks, too: {name}.type:={kind} {name}.topic:={topic}"
    return f"{topic} has this type: {name}.topic:={topic}"


def _others(node: "GraphSlamNode", topic: str) -> Iterator[bool]:
    """Yield for each publisher of a topic whether it belongs to another node."""
    own = node.get_name(), node.get_namespace()
    for publisher in node.get_publishers_info_by_topic(topic):
        yield (publisher.node_name, publisher.node_namespace) != own


_STATIC = InputQos(100, "/tf_static", "/tf_static")


def event_is_safe() -> bool:
    """Return whether the middleware's event of lost messages can be used.

    Fast DDS can lock up when it is asked for this event while a message is lost (rmw_fastrtps, pull request 890): its
    two threads wait for each other, and the node never hears or says anything again. It also reports a fragment of an
    older message as two thousand million lost ones.
    """
    return not get_rmw_implementation_identifier().startswith("rmw_fastrtps")


def full_name(endpoint: Any) -> str:
    """The full name of the node of a publisher or subscription. One that is just being discovered has none yet."""
    if endpoint.node_name.startswith("_NODE_NAME"):
        return "a node"
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


@dataclass(slots=True)
class _Received:
    """The messages that came on one topic."""

    received: int = 0
    seen: int = 0  # of these, at the last tick
    at_ns: int | None = None  # the tick at which there was something new


class Subscriptions:
    """Subscriptions of the inputs and of /tf.

    Parameters
    ----------
    ingest : converts each message, and gets its measurements, which may be none
    broadcaster : gets each transform from map
    counters : count the messages that the middleware has lost
    """

    def __init__(
        self,
        node: "GraphSlamNode",
        config: Config,
        ingest: Ingest,
        broadcaster: "TfBroadcaster",
        counters: Counters,
    ) -> None:
        self._node, self._config, self._ingest = node, config, ingest
        self._broadcaster, self._counters = broadcaster, counters
        self._subscriptions: list[Any] = []
        self._topics: dict[str, _Received] = {}
        self._of_input: dict[str, InputTopic] = {}
        self._late_ns: dict[str, int] = {}  # the least since the last facts
        self._on_tf: dict[str, _Received] = {}  # odometry there
        self._converted: Counter[str] = Counter()
        used = uses(config)
        for topic in (InputTopic(TRANSFORMS, "/tf_static", [TF_STATIC], _STATIC), *input_topics(node, config)):
            self._subscribe(topic)
            for name in topic.inputs:
                if name in used:
                    self._of_input[name] = topic
                    if topic.type_name == TRANSFORMS and used[name] == "odometry":
                        self._on_tf[name] = _Received()

    def close(self) -> None:
        """Unsubscribe from all topics."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._topics.clear()

    def _subscribe(self, topic: InputTopic) -> None:
        """Convert every message of a topic for each of its inputs, one input after another."""
        ingest, map_frame, names, is_tf = self._ingest, self._config.frames.map, topic.inputs, TF in topic.inputs
        counted = self._topics[topic.name] = _Received()
        losses = None if event_is_safe() else Losses(lambda: self._publisher_ids(topic.name))

        def count_lost(times: int) -> None:
            if times:
                for name in names:
                    self._counters.count(name, "lost_in_transport", times)

        def on_lost(event: Any) -> None:
            count_lost(event.total_count_change)  # 0 at some: rclpy reports them twice

        def on_message(cdr: bytes, info: Mapping[str, Any]) -> None:
            if losses is not None:
                count_lost(losses.before(info, time.monotonic_ns()))
            if is_tf and is_correction(cdr, map_frame):
                self._broadcaster.on_correction(cdr)
                return
            counted.received += 1
            measured: list[Measured] = []
            for name in names:
                given = ingest.converter.convert(name, cdr)
                self._converted[name] += len(given)
                self._note_late(name, given)
                measured += given
            ingest.receive(measured, cdr)
            ingest.check.add(topic.name, names, self._node.now_ns, measured, ingest.converter.decoded)

        guarded = self._node.guarded
        self._subscriptions.append(self._created(topic, _with_info(guarded(on_message), on_message), guarded(on_lost)))

    def _note_late(self, name: str, given: Sequence[Measured]) -> None:
        """Note how late the newest measurement of a message is, by the node's clock."""
        stamps_ns = [m.stamp_ns for m in given if input_of(m) == name]
        if stamps_ns and (now_ns := self._node.now_ns):
            late_ns = now_ns - max(stamps_ns)
            self._late_ns[name] = min(late_ns, self._late_ns.get(name, late_ns))

    def _created(self, topic: InputTopic, on_message: Callable[..., None], on_lost: Callable[..., None]) -> Any:
        """A subscription, with the event of lost messages if the middleware has one that can be used."""
        create = partial(self._node.create_subscription, message_class(topic.type_name), topic.name, on_message)
        if event_is_safe():
            with suppress(UnsupportedEventTypeError):
                events = SubscriptionEventCallbacks(message_lost=on_lost)
                return create(topic.qos.profile, raw=True, event_callbacks=events)
        return create(topic.qos.profile, raw=True)

    def _publisher_ids(self, topic: str) -> frozenset[bytes]:
        return frozenset(bytes(one.endpoint_gid) for one in self._node.get_publishers_info_by_topic(topic))

    # -- facts -------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Note which topics have new data. It uses the node's clock, so that a pause makes no input silent.

        Odometry on /tf has new data when a message contained odometry, because /tf carries all transforms.
        """
        for name, found in self._on_tf.items():
            topic = self._topics[self._of_input[name].name]
            if (topic.received and found.at_ns is None) or self._converted[name] != found.seen:
                found.seen, found.at_ns = self._converted[name], now_ns
        for counted in self._topics.values():
            if counted.received != counted.seen:
                counted.seen, counted.at_ns = counted.received, now_ns

    def facts(
        self,
        now_ns: int,
        counted: Mapping[str, Mapping[str, int]],
        recent: Mapping[str, Recent],
        used: Mapping[str, int],
    ) -> tuple[InputFacts, ...]:
        """The facts of each input, with its counters since the start and in the last seconds.

        Parameters
        ----------
        used : by source, the measurements that the pipeline has used
        """
        use_of = uses(self._config)
        out = []
        for one in self._config.sources:
            if one.name not in self._of_input:
                continue
            topic = self._of_input[one.name]
            on_topic = self._topics[topic.name]
            self.tick(now_ns)
            at_ns = self._on_tf.get(one.name, on_topic).at_ns
            silent_s = math.inf if at_ns is None else max(0.0, (now_ns - at_ns) * 1e-9)
            publishers = self._node.get_publishers_info_by_topic(topic.name)
            names = tuple(sorted(set(map(full_name, publishers))))
            out.append(
                InputFacts(
                    one.name,
                    topic.name,
                    use_of[one.name],
                    on_topic.received,
                    sum(times for source, times in used.items() if source.partition("#")[0] == one.name),
                    counted.get(one.name, {}),
                    silent_s,
                    names,
                    use_of[one.name] == "odometry" and one.type != TRANSFORMS and len(names) > 1,
                    self._mismatches(topic),
                    self._ingest.converter.unlinked(one.name),
                    recent.get(one.name, Recent()),
                    self._ingest.converter.not_found(one.name),
                    () if names else alternatives(self._node, one, use_of[one.name], self._topics),
                    self._late_ns.pop(one.name, math.nan) * 1e-9,
                )
            )
        return tuple(out)

    def _mismatches(self, topic: InputTopic) -> str:
        """The reasons why publishers of a topic do not connect to its subscription; empty if all connect."""
        publishers = self._node.get_publishers_info_by_topic(topic.name)
        return "; ".join(filter(None, (_mismatch(publisher, topic) for publisher in publishers)))


def _with_info(call: Callable[..., None], on_message: Callable[..., None]) -> Callable[..., None]:
    """Return a callback that receives what rclpy says of a message, too.

    rclpy reads from the signature of ``on_message`` that it wants both, and its events executor (7.1) gives them as one
    tuple.
    """

    @wraps(on_message)
    def received(*given: Any) -> None:
        call(*(given if len(given) == 2 else given[0]))

    return received


def _mismatch(publisher: Any, topic: InputTopic) -> str:
    if publisher.topic_type != topic.type_name:
        return f"{publisher.node_name} publishes {publisher.topic_type}, not {topic.type_name}"
    return topic.qos.mismatch(publisher)
