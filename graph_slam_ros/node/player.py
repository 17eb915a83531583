"""Plays a recording into a live ROS graph: the recorded bytes and /clock, as fast as the node can follow.

The node publishes how many messages it has received. The player stays within the depth of the node's queues. It keeps
the order of the topics within the node's window of stamps. So no message is lost; a lost one would be counted.
"""

import os
import random
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from graph_slam_ros.config.config import parameters
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import CdrReader
from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.messages import to_msg
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, is_correction
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.overview.chosen_inputs import Inputs
from graph_slam_ros.recordings.bag import Bag, BagMessage
from graph_slam_ros.slam import Config

_LISTS = {"tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray"}  # a header stands in each item
_FIRST_PORT = 23_000
_AHEAD = 256  # messages on their way
_OVERTAKE_NS = 20_000_000  # at most, and well inside the node's ordering window
_CLOCK_NS = 5_000_000
_PATIENCE_S, _SAVE_S = 10.0, 300.0
_SPIN_S = 0.05
_START_S = 300.0  # the first start of an installation compiles
_OWN_LAG_S = 60.0  # the player waits for its own node: that it is behind is no fault


class PlayError(GraphSlamError):
    """The live graph does not respond as it should."""


@dataclass(frozen=True, slots=True)
class Played:
    """The numbers of messages sent and lost, and the folder that the node saved."""

    sent: int
    lost: int
    saved: str


class Player:
    """A publisher of recorded messages that waits for a graph_slam node."""

    def __init__(
        self, bag: Bag, inputs: Inputs, node_name: str, config: Config, own: subprocess.Popen[bytes] | None
    ) -> None:
        self._bag, self._name, self._own = bag, node_name, own
        self._static = inputs.topics.get(TF_STATIC)
        self._moving = inputs.topics.get(TF)
        self._topics = set(inputs.by_topic())
        self._map_frame = config.frames.map
        self._overtake_ns = min(_OVERTAKE_NS, round(0.5e9 * config.ordering.window_s))
        self._node = Node("graph_slam_player")
        self._sent = self._received = self._lost = 0
        self._before: int | None = None
        self._on_the_way: dict[str, tuple[int, int]] = {}  # oldest and newest stamp by topic
        self._clock_ns = 0
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers = {
            topic: self._node.create_publisher(
                message_class(bag.topics[topic].type), topic, latched if topic == self._static else 4 * _AHEAD
            )
            for topic in set(inputs.topics.values())
        }
        self._node.create_subscription(UInt64, f"{node_name}/received", self._on_received, latched)

    def play(self, rate: float | None, progress: Callable[[Iterable[Any], int], Iterable[Any]]) -> Played:
        """Send everything, wait until it has arrived, and make the node save it.

        Parameters
        ----------
        rate : times real time, or None for as fast as the node keeps up
        """
        patience_s = _START_S if self._own else _PATIENCE_S
        self._wait(lambda: self._before is not None, f"no {self._name}/received: is the node running?", patience_s)
        for topic, publisher in self._publishers.items():
            self._wait(publisher.get_subscription_count, f"nobody subscribes to {topic}", _PATIENCE_S)
        for message in self._bag.messages({self._static} if self._static else ()):
            self._send(message, self._stamp_ns(message))
        self._until_received(self._sent)
        total = sum(self._bag.topics[topic].count for topic in self._topics)
        start_wall, start_log = time.monotonic(), None
        for message in progress(self._bag.messages(self._topics), total):
            if message.topic == self._moving and is_correction(message.cdr, self._map_frame):
                continue  # one node alone broadcasts map -> odom: now it is ours
            start_log = message.log_ns if start_log is None else start_log
            if rate:
                until = start_wall + (message.log_ns - start_log) * 1e-9 / rate
                _spin_until(self._node, lambda: False, until - time.monotonic())
            stamp_ns = self._stamp_ns(message)
            self._keep_order(message.topic, stamp_ns)
            self._send(message, stamp_ns)
        self._until_received(self._sent)
        return Played(self._sent, self._lost, self._save())

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()

    def _on_received(self, message: UInt64) -> None:
        if self._before is None:
            self._before = message.data
        self._received = message.data - self._before
        if self._received + self._lost >= self._sent:
            self._on_the_way.clear()

    def _send(self, message: BagMessage, stamp_ns: int) -> None:
        if message.log_ns - self._clock_ns >= _CLOCK_NS:
            self._clock_ns = message.log_ns
            self._clock.publish(to_msg.clock(message.log_ns))
        self._publishers[message.topic].publish(message.cdr)
        self._sent += 1
        oldest, newest = self._on_the_way.get(message.topic, (stamp_ns, stamp_ns))
        self._on_the_way[message.topic] = min(oldest, stamp_ns), max(newest, stamp_ns)

    def _keep_order(self, topic: str, stamp_ns: int) -> None:
        """Wait while the queues are full, or while the order of arrival of two topics would matter."""
        others = [stamps for other, stamps in self._on_the_way.items() if other != topic]
        apart = self._overtake_ns
        if any(stamp_ns - oldest >= apart or newest - stamp_ns >= apart for oldest, newest in others):
            self._until_received(self._sent)
        elif self._sent - self._received - self._lost >= _AHEAD:
            self._until_received(self._sent - _AHEAD // 2)

    def _stamp_ns(self, message: BagMessage) -> int:
        """The stamp of the header, or of the first in a list; 0 if the message is too short for one."""
        reader = CdrReader(message.cdr)
        try:
            if self._bag.topics[message.topic].type in _LISTS:
                reader.numbers("I")
            return reader.stamp_ns()
        except struct.error:
            return 0

    def _until_received(self, count: int) -> None:
        """Wait for this number of messages. What does not arrive while nothing changes is counted as lost."""
        while (missing := count - self._lost - self._received) > 0:
            has_come = partial(self._has_received_since, self._received)
            if not _spin_until(self._node, has_come, _PATIENCE_S, self._check_node):
                self._lost += missing
                self._on_the_way.clear()

    def _has_received_since(self, count: int) -> bool:
        return self._received != count

    def _wait(self, condition: Callable[[], object], complaint: str, patience_s: float) -> None:
        if not _spin_until(self._node, condition, patience_s, self._check_node):
            raise PlayError(complaint)

    def _check_node(self) -> None:
        code = self._own.poll() if self._own else None
        if code is not None:
            raise PlayError(f"the node ended with exit code {code}")

    def _save(self) -> str:
        of, patience = (Trigger, f"{self._name}/save", Trigger.Request()), (_SAVE_S, _PATIENCE_S)
        answer = _answer(self._node, *of, *patience, self._check_node)
        if not answer.success:
            raise PlayError(f"{self._name}/save: {answer.message}")
        return str(answer.message)


def _spin_until(
    node: Node, condition: Callable[[], object], patience_s: float, check: Callable[[], None] = lambda: None
) -> bool:
    """Spin until a condition holds; False if it does not in that time. What ``check`` raises meanwhile ends it."""
    deadline = time.monotonic() + patience_s
    while not condition():
        check()
        if (left_s := deadline - time.monotonic()) <= 0.0:
            return False
        rclpy.spin_once(node, timeout_sec=min(left_s, _SPIN_S))
    return True


def _answer(
    node: Node,
    kind: Any,
    service: str,
    request: Any,
    patience_s: float = _PATIENCE_S,
    again_s: float = 1.0,
    check: Callable[[], None] = lambda: None,
) -> Any:
    """Ask, and ask again after a while and after twice as long, until there is an answer.

    DDS drops an answer while the node does not know who asked, which may be so on a busy machine.

    Raises
    ------
    PlayError
        There is no such service, or no answer.
    """
    client = node.create_client(kind, service)
    if not client.wait_for_service(timeout_sec=_PATIENCE_S):
        raise PlayError(f"no {service}: is the node running?")
    asked, deadline = list[Any](), time.monotonic() + patience_s
    while (left_s := deadline - time.monotonic()) > 0.0:
        asked.append(client.call_async(request))
        if _spin_until(node, lambda: any(one.done() for one in asked), min(again_s, left_s), check):
            return next(one.result() for one in asked if one.done())
        again_s *= 2.0
    raise PlayError(f"{service}: no answer")


@contextmanager
def _ros() -> Iterator[None]:
    rclpy.init(args=[])
    try:
        yield
    finally:
        rclpy.try_shutdown()


def config_of(node_name: str) -> Config:
    """The configuration of a running node, read from its parameters. Raises PlayError if there is no such node."""
    with _ros():
        node = Node("graph_slam_player")

        def get(names: list[str]) -> list[Any]:
            request = GetParameters.Request(names=names)
            values = _answer(node, GetParameters, f"{node_name}/get_parameters", request).values
            return list(map(parameter_value_to_python, values))

        listed = _answer(node, ListParameters, f"{node_name}/list_parameters", ListParameters.Request())
        there, (inputs,) = set(listed.result.names), get(["inputs.names"])
        names = [p.name for p in parameters(inputs.split()) if p.name in there]
        return Config.from_mapping(dict(zip(names, get(names), strict=True)))


def play(
    bag: Bag,
    inputs: Inputs,
    *,
    node_name: str = "/graph_slam",
    config: Config | None = None,
    own: subprocess.Popen[bytes] | None = None,
    rate: float | None = None,
    progress: Callable[[Iterable[Any], int], Iterable[Any]] = lambda items, total: items,
) -> Played:
    """Play a recording into the running node of that name, or into one of our own (``own_node``)."""
    with _ros():
        player = Player(bag, inputs, node_name, config or Config(), own)
        try:
            return player.play(rate, progress)
        finally:
            player.close()


@contextmanager
def own_domain() -> Iterator[str]:
    """A ROS domain that no other user of this function on this machine has: a port of its number is held."""
    for domain in random.sample(range(1, 101), 100):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
            try:
                held.bind(("127.0.0.1", _FIRST_PORT + domain))
            except OSError:
                continue
            yield str(domain)
            return
    raise PlayError("no ROS domain is free on this machine")


@contextmanager
def own_node(folder: Path, inputs: Inputs, config: Config) -> Iterator[subprocess.Popen[bytes]]:
    """A node of our own, on this machine and a ROS domain of its own, for as long as the context lasts."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    kept = config.output.keep_earlier if config.time.on_jump == "reset" else 0  # runs of this recording, too
    config = replace(
        config,
        inputs=replace(config.inputs, reliable=True),
        sources=tuple(
            replace(one, topic=inputs.topics.get(one.name, one.topic), reliability="auto", durability="volatile")
            for one in config.sources
        ),
        output=replace(config.output, folder=str(folder), keep_earlier=kept),
        health=replace(config.health, lag_s=max(config.health.lag_s, _OWN_LAG_S)),
    )
    with own_domain() as domain, tempfile.TemporaryDirectory() as scratch:
        os.environ["ROS_DOMAIN_ID"] = domain
        parameters = Path(scratch) / "parameters.yaml"
        parameters.write_text(parameters_text(config.as_mapping()), encoding="utf-8")
        command = [sys.executable, "-m", "graph_slam_ros.node.node", "--ros-args", "--params-file", str(parameters)]
        command += ["-p", "use_sim_time:=true", "--log-level", "warn"]
        process = subprocess.Popen(command)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=60.0)
            except subprocess.TimeoutExpired:
                process.kill()
