"""The node's subscriptions while it is active: raw messages in, measurements out, and counts of each topic."""

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial, wraps
from typing import TYPE_CHECKING, Any

try:
    from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
except ImportError:  # Humble
    from rclpy.qos_event import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import get_rmw_implementation_identifier

from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, TRANSFORMS, is_correction
from graph_slam_ros.messages.inputs import LANDMARK_TYPES, uses
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.node.diagnostics import InputFacts, Recent
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.frontend.ingest_gate import input_of

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode
    from graph_slam_ros.node.runtime import Runtime
    from graph_slam_ros.node.tf_broadcaster import TfBroadcaster

_NUMBER = "publication_sequence_number"
_UNSUPPORTED = 2**63
_ASK_AGAIN_NS = 1_000_000_000
_MOST = 3  # topics that are named
_LANDMARKS = frozenset({"vision_msgs/msg/Detection3DArray", *LANDMARK_TYPES})


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
        """Return how many messages were lost between the last message and this one, of which rclpy says ``info``."""
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


def alternatives(node: "GraphSlamNode", one: InputConfig, use: str, subscribed: Collection[str]) -> tuple[str, ...]:
    """Return a text for each topic of another node that the input could use, with the parameters that choose it."""
    own = node.get_name(), node.get_namespace()
    found = [
        (kind != one.type, topic, kind)
        for topic, kinds in (node.get_topic_names_and_types() if one.type != TRANSFORMS else ())
        for kind in kinds
        if kind == one.type or (use == "landmarks" and {kind, one.type} <= _LANDMARKS)
        if topic not in subscribed
        if any((of.node_name, of.node_namespace) != own for of in node.get_publishers_info_by_topic(topic))
    ]
    return tuple(
        f"{topic} has landmarks, too: {one.name}.type:={kind} {one.name}.topic:={topic}"
        if is_other_type
        else f"{topic} has this type: {one.name}.topic:={topic}"
        for is_other_type, topic, kind in sorted(found)[:_MOST]
    )


@dataclass(frozen=True, slots=True)
class InputTopic:
    """A topic to subscribe to, with its inputs. Of its QoS it has the parameter that asks for more than the least."""

    type: str
    name: str
    inputs: Sequence[str]
    depth: int
    reliability: str = ""
    durability: str = ""

    @property
    def qos(self) -> QoSProfile:
        """The profile for rclpy."""
        return QoSProfile(
            depth=self.depth,
            reliability=ReliabilityPolicy.RELIABLE if self.reliability else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.durability else DurabilityPolicy.VOLATILE,
        )

    def mismatch(self, publisher: Any) -> str:
        """Return why a publisher does not connect, by its endpoint info; empty if it does."""
        offers, name = publisher.qos_profile, publisher.node_name
        if publisher.topic_type != self.type:
            return f"{name} publishes {publisher.topic_type}, not {self.type}"
        if self.reliability and offers.reliability == ReliabilityPolicy.BEST_EFFORT:
            return f"{name} offers best effort, {self.reliability} asks for reliable delivery (QoS)"
        if self.durability and offers.durability == DurabilityPolicy.VOLATILE:
            return f"{name} offers volatile, {self.durability} asks for transient_local (QoS)"
        return ""


def input_topics(node: "GraphSlamNode", config: Config) -> list[InputTopic]:
    """The topics of the inputs, /tf and /tf_static. Raises ConfigError as ``input_topic`` does."""
    topics: dict[tuple[str, str], list[str]] = {(TRANSFORMS, "/tf"): [TF]} if config.inputs.tf else {}
    used = uses(config)
    for one in config.sources:
        if one.name in used:
            topics.setdefault((one.type, node.resolve_topic_name(one.topic)), []).append(one.name)
    static = InputTopic(TRANSFORMS, "/tf_static", [TF_STATIC], 100, "/tf_static", "/tf_static")
    return [static, *(input_topic(config, *of, names) for of, names in topics.items())]


def input_topic(config: Config, kind: str, topic: str, names: Sequence[str]) -> InputTopic:
    """The topic that these inputs share.

    Raises
    ------
    ConfigError
        Two of them ask for different reliability or durability: there is one subscription.
    """
    inputs = [one for one in config.sources if one.name in names]
    asked: dict[str, str] = {}  # by what is asked for, the parameter that does so
    for key, default in (("reliability", "auto"), ("durability", "")):
        given = {getattr(one, key): f"{one.name}.{key}" for one in inputs if getattr(one, key) != default}
        if len(given) > 1:
            pairs = " and ".join(f"{parameter} ({value})" for value, parameter in given.items())
            raise ConfigError(f"{pairs} are of one subscription, to {topic}: they must be the same")
        asked |= given
    if config.inputs.reliable and "best_effort" not in asked:
        asked.setdefault("reliable", "inputs.reliable")
    asks = asked.get("reliable", ""), asked.get("transient_local", "")
    return InputTopic(kind, topic, names, config.inputs.depth, *asks)


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
class _Input:
    """What came for an input."""

    config: InputConfig
    use: str
    topic: InputTopic
    received: int = 0  # messages of its topic
    measured: int = 0
    seen: int = 0  # of these, at the last tick
    at_ns: int | None = None  # the tick at which there was something new
    late_ns: float = math.inf  # the least since the last facts

    def note(self, given: Sequence[Measured], now_ns: int) -> None:
        """Note what a message has measured, and how late the newest of it is."""
        self.measured += len(given)
        newest_ns = max((m.stamp_ns for m in given if input_of(m) == self.config.name), default=0)
        if newest_ns and now_ns:
            self.late_ns = min(self.late_ns, now_ns - newest_ns)

    def tick(self, now_ns: int) -> None:
        """Note whether there is something new. On /tf, which has all transforms, that is odometry itself."""
        is_on_tf = self.use == "odometry" and self.config.type == TRANSFORMS
        count = self.measured if is_on_tf else self.received
        if count != self.seen or (self.received and self.at_ns is None):
            self.seen, self.at_ns = count, now_ns


class Subscriptions:
    """Subscriptions of the inputs and of /tf: each message is converted, and its measurements go to ``Ingest``."""

    def __init__(self, run: "Runtime", broadcaster: "TfBroadcaster") -> None:
        self._run, self._node, self._broadcaster = run, run.node, broadcaster
        self._subscriptions: list[Any] = []
        config = self._node.config
        topics, used = input_topics(self._node, config), uses(config)
        of = {name: topic for topic in topics for name in topic.inputs}
        self._inputs = {
            one.name: _Input(one, used[one.name], of[one.name]) for one in config.sources if one.name in used
        }
        for topic in topics:
            self._subscribe(topic)

    def close(self) -> None:
        """Unsubscribe from all topics."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _subscribe(self, topic: InputTopic) -> None:
        """Convert every message of a topic for each of its inputs, one input after another."""
        node, ingest, map_frame = self._node, self._run.ingest, self._node.config.frames.map
        losses = None if event_is_safe() else Losses(lambda: self._publisher_ids(topic.name))

        def count_lost(times: int) -> None:
            for name in topic.inputs if times else ():
                self._run.counters.count(name, "lost_in_transport", times)

        def on_lost(event: Any) -> None:
            count_lost(event.total_count_change)  # 0 at some: rclpy reports them twice

        def on_message(cdr: bytes, info: Mapping[str, Any]) -> None:
            if losses is not None:
                count_lost(losses.before(info, time.monotonic_ns()))
            if TF in topic.inputs and is_correction(cdr, map_frame):
                self._broadcaster.on_correction(cdr)
                return
            now_ns, measured = node.now_ns, list[Measured]()
            for name in topic.inputs:
                if name in self._inputs:
                    self._inputs[name].received += 1
                given = ingest.converter.convert(name, cdr)
                if name in self._inputs:
                    self._inputs[name].note(given, now_ns)
                measured += given
            ingest.receive(measured)
            ingest.check.add(topic.name, topic.inputs, now_ns, measured, ingest.converter.decoded)

        callback = _with_info(node.guarded(on_message), on_message)
        of = message_class(topic.type), topic.name, callback, topic.qos
        create = partial(node.create_subscription, *of, raw=True)
        events = SubscriptionEventCallbacks(message_lost=node.guarded(on_lost)) if event_is_safe() else None
        with suppress(UnsupportedEventTypeError):
            self._subscriptions.append(create(event_callbacks=events))
            return
        self._subscriptions.append(create())

    def _publisher_ids(self, topic: str) -> frozenset[bytes]:
        return frozenset(bytes(one.endpoint_gid) for one in self._node.get_publishers_info_by_topic(topic))

    def tick(self, now_ns: int) -> None:
        """Note which inputs have new data. It uses the node's clock, so that a pause makes no input silent."""
        for one in self._inputs.values():
            one.tick(now_ns)

    def facts(
        self,
        now_ns: int,
        counted: Mapping[str, Mapping[str, int]],
        recent: Mapping[str, Recent],
        used: Mapping[str, int],
    ) -> Iterator[InputFacts]:
        """Yield the facts of each input.

        Parameters
        ----------
        counted, recent : what was counted since the start by input and reason, and in the last seconds
        used : by source, the measurements that the pipeline has used
        """
        self.tick(now_ns)
        converter, subscribed = self._run.ingest.converter, {one.topic.name for one in self._inputs.values()}
        for name, one in self._inputs.items():
            publishers = self._node.get_publishers_info_by_topic(one.topic.name)
            names = tuple(sorted(set(map(full_name, publishers))))
            yield InputFacts(
                name,
                one.topic.name,
                one.use,
                one.received,
                sum(times for source, times in used.items() if source.partition("#")[0] == name),
                counted.get(name, {}),
                math.inf if one.at_ns is None else max(0.0, (now_ns - one.at_ns) * 1e-9),
                names,
                one.use == "odometry" and one.config.type != TRANSFORMS and len(names) > 1,
                "; ".join(filter(None, map(one.topic.mismatch, publishers))),
                converter.unlinked(name),
                recent.get(name, Recent()),
                converter.not_found(name),
                () if names else alternatives(self._node, one.config, one.use, subscribed),
                one.late_ns * 1e-9,
            )
            one.late_ns = math.inf


def _with_info(call: Callable[..., None], on_message: Callable[..., None]) -> Callable[..., None]:
    """Return a callback that receives what rclpy says of a message, too.

    rclpy reads from the signature of ``on_message`` that it wants both, and its events executor (7.1) gives them as one
    tuple.
    """

    @wraps(on_message)
    def received(*given: Any) -> None:
        call(*(given if len(given) == 2 else given[0]))

    return received
