"""The node's subscriptions while it is active: raw bytes in, measurements of the border out, and who has been heard."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

try:
    from rclpy.event_handler import SubscriptionEventCallbacks, UnsupportedEventTypeError
except ImportError:  # Humble
    from rclpy.qos_event import SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, TRANSFORMS, MessageConverter, is_correction
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.message_class import message_class
from graph_slam_ros.node.diagnostics import InputFacts
from graph_slam_ros.node.handle import NodeHandle
from graph_slam_ros.node.recent import Recent
from graph_slam_ros.slam import Config, Counters

Heard = Callable[..., None]
Guard = Callable[[Heard], Heard]
Take = Callable[[Sequence[Measured], bytes], None]


def full_name(endpoint: Any) -> str:
    """The full name of the node of a publisher or subscription; one that is just being discovered has none yet."""
    if endpoint.node_name.startswith("_NODE_NAME"):
        return "a node"
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


@dataclass(slots=True)
class _Heard:
    """What one topic has received."""

    subscription: Any
    received: int = 0
    seen: int = 0  # of these, at the last tick
    at_ns: int | None = None  # the tick at which there was something new


class Subscriptions:
    """Subscriptions of the inputs and of /tf.

    Parameters
    ----------
    take : is handed what the border makes of each message, and the message; also where that is nothing
    guarded : makes a callback that raises nothing
    on_correction : is handed each transform from map
    counters : where messages are counted that the middleware has lost
    """

    def __init__(
        self,
        node: NodeHandle,
        config: Config,
        border: MessageConverter,
        take: Take,
        guarded: Guard,
        on_correction: Callable[[bytes], None],
        counters: Counters,
    ) -> None:
        self._node, self._config, self._border = node, config, border
        self._take, self._guarded, self._on_correction = take, guarded, on_correction
        self._counters = counters
        self._topics: dict[str, _Heard] = {}
        self._of_input: dict[str, str] = {}
        self._on_tf: dict[str, _Heard] = {}  # odometry there
        self._used: Counter[str] = Counter()
        kind = ReliabilityPolicy.RELIABLE if config.inputs.reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=config.inputs.depth, reliability=kind)
        static = QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._subscribe(TRANSFORMS, "/tf_static", [TF_STATIC], static)
        topics: dict[tuple[str, str], list[str]] = {(TRANSFORMS, "/tf"): [TF]} if config.inputs.tf else {}
        used = uses(config)
        for one in config.sources:
            if one.name in used:
                topic = node.resolve_topic_name(one.topic)
                topics.setdefault((one.type, topic), []).append(one.name)
                self._of_input[one.name] = topic
                if one.type == TRANSFORMS and used[one.name] == "odometry":
                    self._on_tf[one.name] = _Heard(None)
        for (type_name, topic), names in topics.items():
            self._subscribe(type_name, topic, names, qos)

    def close(self) -> None:
        """Hear no more."""
        for heard in self._topics.values():
            self._node.destroy_subscription(heard.subscription)
        self._topics.clear()

    def _subscribe(self, type_name: str, topic: str, names: list[str], qos: QoSProfile) -> None:
        """Hand every message of a topic to the inputs of these names, one after the other."""
        border, map_frame, hears_tf = self._border, self._config.frames.map, TF in names

        def on_message(cdr: bytes) -> None:
            if hears_tf and is_correction(cdr, map_frame):
                self._on_correction(cdr)
                return
            heard.received += 1
            measured: list[Measured] = []
            for name in names:
                given = border.convert(name, cdr)
                self._used[name] += len(given)
                measured += given
            self._take(measured, cdr)

        def on_lost(event: Any) -> None:
            if event.total_count_change:  # rclpy tells some events twice
                for name in names:
                    self._counters.count(name, "lost_in_transport", event.total_count_change)

        subscription = self._subscription(type_name, topic, self._guarded(on_message), qos, self._guarded(on_lost))
        heard = self._topics[topic] = _Heard(subscription)

    def _subscription(self, type_name: str, topic: str, on_message: Heard, qos: QoSProfile, on_lost: Heard) -> Any:
        """With the event of messages that are lost before they come, where the middleware has it."""
        create = partial(self._node.create_subscription, message_class(type_name), topic, on_message, qos, raw=True)
        try:
            return create(event_callbacks=SubscriptionEventCallbacks(message_lost=on_lost))
        except UnsupportedEventTypeError:
            return create()

    # -- facts -------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Note which topics have something new; by the clock of the node, so that a pause of it silences nobody.

        Of odometry on /tf, whether that has: /tf tells of everything.
        """
        for name, found in self._on_tf.items():
            topic = self._topics[self._of_input[name]]
            if (topic.received and found.at_ns is None) or self._used[name] != found.seen:
                found.seen, found.at_ns = self._used[name], now_ns
        for heard in self._topics.values():
            if heard.received != heard.seen:
                heard.seen, heard.at_ns = heard.received, now_ns

    def facts(
        self, now_ns: int, counted: Mapping[str, Mapping[str, int]], recent: Mapping[str, Recent]
    ) -> tuple[InputFacts, ...]:
        """The facts of each input, with its counters since the start and what became of it lately."""
        used = uses(self._config)
        out = []
        for one in self._config.sources:
            if one.name not in self._of_input:
                continue
            topic = self._of_input[one.name]
            heard = self._topics[topic]
            self.tick(now_ns)
            at_ns = self._on_tf.get(one.name, heard).at_ns
            silent_s = math.inf if at_ns is None else max(0.0, (now_ns - at_ns) * 1e-9)
            told = self._node.get_publishers_info_by_topic(topic)
            names = tuple(sorted(set(map(full_name, told))))
            out.append(
                InputFacts(
                    one.name,
                    topic,
                    used[one.name],
                    heard.received,
                    self._used[one.name],
                    counted.get(one.name, {}),
                    silent_s,
                    names,
                    used[one.name] == "odometry" and one.type != TRANSFORMS and len(names) > 1,
                    "; ".join(filter(None, (self._mismatch(p, one.type) for p in told))),
                    self._border.unlinked(one.name),
                    recent.get(one.name, Recent()),
                    self._border.not_found(one.name),
                )
            )
        return tuple(out)

    def _mismatch(self, publisher: Any, type_name: str) -> str:
        """Why a publisher and our subscription do not connect."""
        if publisher.topic_type != type_name:
            return f"{publisher.node_name} publishes {publisher.topic_type}, not {type_name}"
        offers = publisher.qos_profile.reliability
        if self._config.inputs.reliable and offers == ReliabilityPolicy.BEST_EFFORT:
            return f"{publisher.node_name} offers best effort, inputs.reliable asks for reliable delivery (QoS)"
        return ""
