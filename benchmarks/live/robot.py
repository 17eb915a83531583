"""Helpers around a node, each a process of its own: who sends, listens, manages, and a bare node to compare with.

Each is told what to do, and answers, in lines of JSON (``benchmarks.live.processes``).
"""

import contextlib
import itertools
import json
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

from benchmarks.live.processes import PATIENCE_S, asked, reply, ros, until
from benchmarks.live.streams import STREAMS, TYPES, later, stamp_ns
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.recordings.bag import BagMessage

NODE = "/graph_slam"
_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_DEEP = QoSProfile(depth=1000)
_OUTPUTS = {  # topic, type, how to subscribe, and where in the bytes the stamp is
    "path": (f"{NODE}/path", "nav_msgs/msg/Path", _LATCHED, 4),
    "pose": (f"{NODE}/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", _LATCHED, 4),
    "odometry": (f"{NODE}/odometry", "nav_msgs/msg/Odometry", _DEEP, 4),
    "tf": ("/tf", "tf2_msgs/msg/TFMessage", _DEEP, 8),
}
_AHEAD = 256  # messages on their way, where the node sets the pace
_APART_NS = 20_000_000  # of stamps, before a message of another topic waits for those before it
_START_S = 120.0  # the first start of an installation compiles
_SLOW_S = 60.0  # nothing that a node does takes longer


class _Sender:
    """Plays a stream: in parts, each at a pace of its own."""

    def __init__(self, stream: Iterator[BagMessage], topics: list[str]) -> None:
        self._node = Node("robot")
        self._stream = stream
        self._publishers = {
            topic: self._node.create_publisher(message_class(TYPES[topic]), topic, _DEEP) for topic in topics
        }
        self._sent = self._received = 0
        self._behind_ns: int | None = None  # the stream, where it is played at the present

    def wait_for_node(self) -> None:
        """Until somebody subscribes to everything."""
        for topic, publisher in self._publishers.items():
            until(lambda p=publisher: p.get_subscription_count() > 0, self._rest, f"subscriber of {topic}", _START_S)

    def play(self, seconds: float | None = None, pace: float = 1.0, tell: bool = False) -> Any:
        """Send a part of the stream.

        Parameters
        ----------
        seconds : of stamps, how long a part; None: all that is left
        pace : times real time, at 1 stamped with the present; 0: as fast as the node takes it
        tell : whether to answer when each was sent
        """
        begin, before, when = time.monotonic(), self._sent, []
        part = self._part(seconds)
        if pace == 1.0:
            part = self._at_present(part)
        for m in _paced(part, pace) if pace else self._awaited(part):
            if tell:
                when.append((m.topic, m.log_ns, time.monotonic_ns()))
            self._publishers[m.topic].publish(m.cdr)
            self._sent += 1
        return {"sent": self._sent - before, "took_s": time.monotonic() - begin, "when": when}

    def received(self) -> int:
        """What the node says it has received in all, when that changes no more."""
        with self._acknowledged():
            last = -1
            while last != self._received:
                last = self._received
                self._rest(0.5)
            return last

    def _part(self, seconds: float | None) -> Iterator[BagMessage]:
        first_ns: int | None = None
        for m in self._stream:
            first_ns = m.log_ns if first_ns is None else first_ns
            if seconds is not None and m.log_ns - first_ns >= seconds * 1e9:
                self._stream = itertools.chain([m], self._stream)
                return
            yield m

    def _at_present(self, part: Iterator[BagMessage]) -> Iterator[BagMessage]:
        for m in part:
            if self._behind_ns is None:
                self._behind_ns = time.time_ns() - m.log_ns
            yield later(m, self._behind_ns)

    def _awaited(self, part: Iterator[BagMessage]) -> Iterator[BagMessage]:
        """Never further ahead than the node's queues hold, nor so that one topic could overtake another by much."""
        with self._acknowledged() as until_received:
            until_received(self._sent)
            last: BagMessage | None = None
            for m in part:
                if last and m.topic != last.topic and m.log_ns - last.log_ns >= _APART_NS:
                    until_received(self._sent)
                elif self._sent - self._received >= _AHEAD:
                    until_received(self._sent - _AHEAD // 2)
                yield m
                last = m
            until_received(self._sent)

    @contextlib.contextmanager
    def _acknowledged(self) -> Iterator[Callable[[int], None]]:
        """While somebody listens, the node acknowledges each message."""
        subscription = self._node.create_subscription(UInt64, f"{NODE}/received", self._take, _LATCHED)

        def until_received(count: int) -> None:
            until(lambda: self._received >= count, self._rest, f"{count} received, but {self._received}", _SLOW_S)

        try:
            yield until_received
        finally:
            self._node.destroy_subscription(subscription)

    def _take(self, message: UInt64) -> None:
        self._received = message.data

    def _rest(self, seconds: float = 0.05) -> None:
        rclpy.spin_once(self._node, timeout_sec=seconds)


def _paced(part: Iterator[BagMessage], pace: float) -> Iterator[BagMessage]:
    """At its stamps where these are of the present, else from now on."""
    begin, first_ns = None, 0
    for m in part:
        if begin is None:
            wait_s, first_ns = 1e-9 * (m.log_ns - time.time_ns()), m.log_ns
            begin = time.monotonic() + (wait_s if abs(wait_s) < _SLOW_S else 0.0)
        if (left := begin + 1e-9 * (m.log_ns - first_ns) / pace - time.monotonic()) > 0.0:
            time.sleep(left)
        yield m


def send(name: str, values: str, topics: str) -> None:
    """Play a stream in parts, as told: the keywords of ``_Sender.play``, or nothing to be told what has arrived."""
    with ros():
        stream = STREAMS[name](**json.loads(values))
        first = next(stream)
        sender = _Sender(itertools.chain([first], stream), topics.split(","))
        sender.wait_for_node()
        reply("ready")
        while True:
            order = asked()
            reply(sender.play(**order) if order else sender.received())


def listen(*names: str) -> None:
    """Subscribe to outputs of the node; tells, when asked, when what stamps came since it was last asked."""
    with ros():
        node, orders = Node("listener"), _orders()
        heard: dict[str, list[Any]] = {name: [] for name in names}

        def keep(name: str, at: int) -> Callable[[bytes], None]:
            return lambda cdr: heard[name].append((time.monotonic_ns(), stamp_ns(cdr, at)))

        for name in names:
            topic, type_name, qos, at = _OUTPUTS[name]
            node.create_subscription(message_class(type_name), topic, keep(name, at), qos, raw=True)
        executor = EventsExecutor()
        executor.add_node(node)
        while True:
            executor.spin_once(timeout_sec=0.02)
            if not orders.empty():
                if orders.get() is None:
                    return
                reply(heard)
                for some in heard.values():
                    some.clear()


def bare(*topics: str) -> None:
    """A node that does nothing with what it subscribes to."""
    with ros():
        node = Node("bare")
        for topic in topics:
            node.create_subscription(message_class(TYPES[topic]), topic, lambda message: None, _DEEP)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while True:
            executor.spin_once(timeout_sec=1.0)  # so that it can be told to end


def manage() -> None:
    """Ask the node for the transitions that are told; answers the seconds that each took."""
    with ros():
        manager = Node("manager")
        client = manager.create_client(ChangeState, f"{NODE}/change_state")

        def rest() -> None:
            rclpy.spin_once(manager, timeout_sec=0.02)

        until(client.service_is_ready, rest, "service of the node", 6 * PATIENCE_S)
        reply("ready")
        while True:
            request: Any = ChangeState.Request()
            request.transition.label = asked()["transition"]
            start = time.monotonic()
            future = client.call_async(request)
            until(future.done, rest, "answer", 6 * PATIENCE_S)
            if not future.result().success:
                raise SystemExit(f"{request.transition.label} failed")
            reply(time.monotonic() - start)


def _orders() -> "queue.Queue[Any]":
    """What this process is told, read by a thread; None when nobody is there any more."""
    orders: queue.Queue[Any] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            orders.put(json.loads(line))
        orders.put(None)

    threading.Thread(target=read, daemon=True).start()
    return orders


if __name__ == "__main__":
    {"send": send, "listen": listen, "manage": manage, "bare": bare}[sys.argv[1]](*sys.argv[2:])
