"""Plays a recording into a live ROS graph: the recorded bytes, with /clock, as fast as the node keeps up.

The node tells how many messages it has received; the player never runs further ahead than its queues hold, and never
lets a message of one topic overtake those of another by more than the node's window of stamps. So nothing is lost, and
what would be is counted.
"""

import importlib
import os
import random
import signal
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
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.replay import Inputs
from graph_slam_ros.ros import to_msg
from graph_slam_ros.ros.bag import Bag, BagMessage
from graph_slam_ros.slam import Config
from graph_slam_ros.slam.config import OrderingConfig

_AHEAD = 256  # messages on their way
_OVERTAKE_NS = 20_000_000  # at most, and well inside the node's ordering window
_CLOCK_NS = 5_000_000
_PATIENCE_S = 10.0
_START_S = 300.0  # the first start of an installation compiles
_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class PlayError(GraphSlamError):
    """The live graph does not do its part."""


@dataclass(frozen=True, slots=True)
class Played:
    """What was sent and what did not arrive, and the folder the node saved."""

    sent: int
    lost: int
    saved: str


class Player:
    """A publisher of recorded messages that waits for a graph_slam node."""

    def __init__(
        self, bag: Bag, inputs: Inputs, node_name: str, window_s: float, own: subprocess.Popen[bytes] | None
    ) -> None:
        self._bag, self._inputs, self._name, self._own = bag, inputs, node_name, own
        self._overtake_ns = min(_OVERTAKE_NS, round(0.5e9 * window_s))
        self._node = Node("graph_slam_player")
        self._sent = self._received = self._lost = 0
        self._before: int | None = None
        self._on_the_way: dict[str, tuple[int, int]] = {}  # oldest and newest stamp by topic
        self._clock_ns = 0
        self._clock = self._node.create_publisher(Clock, "/clock", 10)
        self._publishers = {topic: self._publisher(topic) for topic in inputs.names()}
        self._node.create_subscription(UInt64, f"{node_name}/received", self._on_received, _LATCHED)

    def play(self, rate: float | None, progress: Callable[[Iterable[Any], int], Iterable[Any]]) -> Played:
        """Send everything, wait until it has arrived, have it saved.

        Parameters
        ----------
        rate : times real time, or None for as fast as the node keeps up
        """
        patience_s = _START_S if self._own else _PATIENCE_S
        self._wait(lambda: self._before is not None, f"no {self._name}/received: is the node running?", patience_s)
        for topic, publisher in self._publishers.items():
            self._wait(partial(_has_subscriber, publisher), f"nobody subscribes to {topic}")
        for message in self._bag.messages({self._inputs.tf_static} - {""}):
            self._send(message)
        self._settle()
        inputs = {self._inputs.odometry, self._inputs.landmarks} - {""}
        total = sum(self._bag.topics[name].count for name in inputs)
        start_wall, start_log = time.monotonic(), None
        for message in progress(self._bag.messages(inputs), total):
            start_log = message.log_ns if start_log is None else start_log
            if rate:
                self._pause(start_wall + (message.log_ns - start_log) * 1e-9 / rate)
            self._keep_order(message)
            self._send(message)
        self._settle()
        return Played(self._sent, self._lost, self._save())

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()

    def _publisher(self, topic: str) -> Any:
        package, _, name = self._bag.topics[topic].type.split("/")
        kind = getattr(importlib.import_module(f"{package}.msg"), name)
        latched = topic == self._inputs.tf_static
        return self._node.create_publisher(
            kind, topic, QoSProfile(depth=100, durability=_LATCHED.durability) if latched else 4 * _AHEAD
        )

    def _on_received(self, message: UInt64) -> None:
        if self._before is None:
            self._before = message.data
        self._received = message.data - self._before
        if self._received + self._lost >= self._sent:
            self._on_the_way.clear()

    def _send(self, message: BagMessage) -> None:
        if message.log_ns - self._clock_ns >= _CLOCK_NS:
            self._clock_ns = message.log_ns
            self._clock.publish(to_msg.clock(message.log_ns))
        self._publishers[message.topic].publish(message.cdr)
        self._sent += 1
        stamp_ns = _stamp_ns(message.cdr)
        oldest, newest = self._on_the_way.get(message.topic, (stamp_ns, stamp_ns))
        self._on_the_way[message.topic] = min(oldest, stamp_ns), max(newest, stamp_ns)

    def _keep_order(self, message: BagMessage) -> None:
        """Wait where the queues are full, or where it would matter which of two topics' messages arrives first."""
        stamp_ns = _stamp_ns(message.cdr)
        others = [stamps for topic, stamps in self._on_the_way.items() if topic != message.topic]
        apart = self._overtake_ns
        if any(stamp_ns - oldest >= apart or newest - stamp_ns >= apart for oldest, newest in others):
            self._settle()
        elif self._sent - self._received - self._lost >= _AHEAD:
            self._until_received(self._sent - self._lost - _AHEAD // 2)

    def _settle(self) -> None:
        self._until_received(self._sent - self._lost)

    def _until_received(self, count: int) -> None:
        """Wait for that many; what does not arrive while nothing moves is counted as lost."""
        last, deadline = self._received, time.monotonic() + _PATIENCE_S
        while self._received < count:
            rclpy.spin_once(self._node, timeout_sec=0.1)
            self._check_node()
            if self._received != last:
                last, deadline = self._received, time.monotonic() + _PATIENCE_S
            elif time.monotonic() > deadline:
                self._lost += count - self._received
                self._on_the_way.clear()
                return

    def _pause(self, until: float) -> None:
        while (left := until - time.monotonic()) > 0.0:
            rclpy.spin_once(self._node, timeout_sec=left)

    def _wait(self, condition: Callable[[], bool], complaint: str, patience_s: float = _PATIENCE_S) -> None:
        deadline = time.monotonic() + patience_s
        while not condition():
            self._check_node()
            if time.monotonic() > deadline:
                raise PlayError(complaint)
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def _check_node(self) -> None:
        code = self._own.poll() if self._own else None
        if code is not None:
            raise PlayError(f"the node ended with exit code {code}")

    def _save(self) -> str:
        client = self._node.create_client(Trigger, f"{self._name}/save")
        if not client.wait_for_service(timeout_sec=_PATIENCE_S):
            raise PlayError(f"no service {self._name}/save")
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=300.0)
        answer = future.result()
        if answer is None or not answer.success:
            raise PlayError(f"{self._name}/save: {answer.message if answer else 'no answer'}")
        return str(answer.message)


def play(
    bag: Bag,
    inputs: Inputs,
    *,
    node_name: str = "/graph_slam",
    window_s: float = OrderingConfig().window_s,
    own: subprocess.Popen[bytes] | None = None,
    rate: float | None = None,
    progress: Callable[[Iterable[Any], int], Iterable[Any]] = lambda items, total: items,
) -> Played:
    """Play a recording into the running node of that name, or into one of our own (``own_node``)."""
    rclpy.init(args=[])
    try:
        player = Player(bag, inputs, node_name, window_s, own)
        try:
            return player.play(rate, progress)
        finally:
            player.close()
    finally:
        rclpy.try_shutdown()


@contextmanager
def own_node(folder: Path, inputs: Inputs, config: Config) -> Iterator[subprocess.Popen[bytes]]:
    """A node of our own, on this machine and a ROS domain of its own, for as long as the context lasts."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(random.randint(1, 100))
    config = replace(
        config,
        inputs=replace(config.inputs, reliable=True),
        output=replace(config.output, folder=str(folder), keep_earlier=False),
    )
    with tempfile.TemporaryDirectory() as scratch:
        parameters = Path(scratch) / "parameters.yaml"
        parameters.write_text(parameters_text(config.as_mapping()), encoding="utf-8")
        command = [sys.executable, "-m", "graph_slam_ros.ros.node", "--ros-args", "--params-file", str(parameters)]
        command += ["-p", "use_sim_time:=true"]
        command += ["-r", f"odom:={inputs.odometry}", "-r", f"landmarks:={inputs.landmarks or 'landmarks'}"]
        command += ["--log-level", "warn"]
        process = subprocess.Popen(command)
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(timeout=60.0)
            except subprocess.TimeoutExpired:
                process.kill()


def _has_subscriber(publisher: Any) -> bool:
    return bool(publisher.get_subscription_count())


def _stamp_ns(cdr: bytes) -> int:
    """Stamp of a message that begins with a header, without decoding the rest; 0 where it is too short for one."""
    if len(cdr) < 12:
        return 0
    sec, nanosec = struct.unpack_from("<iI" if cdr[1] & 1 else ">iI", cdr, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)
