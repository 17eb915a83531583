"""The node under test, a process of its own; and the robot around it: it sends a stream, and hears what the node says.

Run as a programme, this is a bare node to compare with: it does nothing with the topics that it subscribes to.
"""

import contextlib
import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

from benchmarks.fresh import ROOT
from benchmarks.live.streams import STREAMS, TYPES, later, stamp_ns
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.recordings.bag import BagMessage

NODE, BARE = "graph_slam_ros.node.node", "benchmarks.live.robot"
_NAME = "/graph_slam"
_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_DEEP = QoSProfile(depth=1000)
_OUTPUTS = {  # topic, type, how to subscribe, and where in the bytes the stamp is
    "path": (f"{_NAME}/path", "nav_msgs/msg/Path", _LATCHED, 4),
    "pose": (f"{_NAME}/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", _LATCHED, 4),
    "odometry": (f"{_NAME}/odometry", "nav_msgs/msg/Odometry", _DEEP, 4),
    "tf": ("/tf", "tf2_msgs/msg/TFMessage", _DEEP, 8),
}
_AHEAD = 256  # messages on their way, where the node sets the pace
_APART_NS = 20_000_000  # of stamps, before a message of another topic waits for those before it
_PATIENCE_S = 120.0  # nothing takes longer; the first start of an installation compiles
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Process:
    """A module in a process of its own, measured from outside."""

    def __init__(self, module: str, *words: str) -> None:
        self._popen = subprocess.Popen([sys.executable, "-m", module, *words], cwd=ROOT)

    @property
    def cpu_s(self) -> float:
        """CPU seconds so far, of all threads, as the kernel counts them: in hundredths."""
        fields = Path(f"/proc/{self._popen.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) * _TICK_S

    @property
    def memory_mib(self) -> float:
        """Resident memory."""
        status = Path(f"/proc/{self._popen.pid}/status").read_text()
        return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024.0

    def __enter__(self) -> "Process":
        """Return it."""
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.stop()

    def stop(self) -> None:
        """Ask it to end; after a while, end it."""
        if self._popen.poll() is None:
            self._popen.send_signal(signal.SIGINT)
        try:
            self._popen.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()


@contextlib.contextmanager
def node(parameters: dict[str, Any]) -> Iterator[tuple[Process, Path]]:
    """Our node, and the folder that it records into."""
    with tempfile.TemporaryDirectory() as folder:
        given = {"output.folder": f"{folder}/run"} | parameters
        texts = {key: str(value).lower() if isinstance(value, bool) else value for key, value in given.items()}
        words = [word for key, text in texts.items() for word in ("-p", f"{key}:={text}")]
        with Process(NODE, "--ros-args", "--log-level", "error", *words) as ours:
            yield ours, Path(folder) / "run"


@contextlib.contextmanager
def ros() -> Iterator[None]:
    """ROS in this process, among us alone on this machine."""
    os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(random.randint(1, 100))}
    rclpy.init(args=[])
    try:
        yield
    finally:
        rclpy.try_shutdown()


class Robot:
    """Sends a stream of ``streams.STREAMS`` in parts, each at a pace of its own.

    Attributes
    ----------
    heard : of each output, when messages came, and their stamps [ns]
    sent : how many messages so far
    """

    def __init__(self, stream: str, *outputs: str, **values: Any) -> None:
        make, topics = STREAMS[stream]
        messages = make(**values)
        self._stream = itertools.chain([next(messages)], messages)  # it is simulated before the node is there
        self._node = Node("robot", enable_rosout=False)
        self._publishers = {t: self._node.create_publisher(message_class(TYPES[t]), t, _DEEP) for t in topics}
        self.heard: dict[str, list[tuple[int, int]]] = {name: [] for name in outputs}
        for name in outputs:
            topic, type_name, qos, at = _OUTPUTS[name]
            self._node.create_subscription(message_class(type_name), topic, self._keep(name, at), qos, raw=True)
        self.sent = self._received = 0
        self._behind_ns: int | None = None  # the stream, where it is played at the present
        self._executor = EventsExecutor()
        self._executor.add_node(self._node)
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def __enter__(self) -> "Robot":
        """Wait until somebody subscribes to everything."""
        for topic, publisher in self._publishers.items():
            _until(lambda p=publisher: p.get_subscription_count() > 0, f"subscriber of {topic}")
        return self

    def __exit__(self, *_: object) -> None:
        """Be no more."""
        self._is_over.set()
        self._thread.join()
        self._node.destroy_node()

    def play(self, seconds: float | None = None, pace: float = 1.0) -> list[tuple[str, int, int]]:
        """Send a part of the stream; returns topic, stamp and when it was sent of each message [ns].

        Parameters
        ----------
        seconds : of stamps, how long a part; None: all that is left
        pace : times real time, at 1 stamped with the present; 0: as fast as the node takes it
        """
        part, when = self._part(seconds), []
        if pace == 1.0:
            part = self._at_present(part)
        for m in _paced(part, pace) if pace else self._awaited(part):
            when.append((m.topic, m.log_ns, time.monotonic_ns()))
            self._publishers[m.topic].publish(m.cdr)
            self.sent += 1
        return when

    def received(self) -> int:
        """What the node says it has received in all, when that changes no more."""
        with self._acknowledged():
            last = -1
            while last != self._received:
                last = self._received
                time.sleep(0.5)
            return last

    def _spin(self) -> None:
        while not self._is_over.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def _keep(self, name: str, at: int) -> Callable[[bytes], None]:
        return lambda cdr: self.heard[name].append((time.monotonic_ns(), stamp_ns(cdr, at)))

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
            until_received(self.sent)
            last: BagMessage | None = None
            for m in part:
                if last and m.topic != last.topic and m.log_ns - last.log_ns >= _APART_NS:
                    until_received(self.sent)
                elif self.sent - self._received >= _AHEAD:
                    until_received(self.sent - _AHEAD // 2)
                yield m
                last = m
            until_received(self.sent)

    @contextlib.contextmanager
    def _acknowledged(self) -> Iterator[Callable[[int], None]]:
        """While somebody listens, the node acknowledges each message."""
        subscription = self._node.create_subscription(UInt64, f"{_NAME}/received", self._take, _LATCHED)
        try:
            yield lambda count: _until(lambda: self._received >= count, f"{count} received", 0.0005)
        finally:
            self._node.destroy_subscription(subscription)

    def _take(self, message: UInt64) -> None:
        self._received = message.data


def _paced(part: Iterator[BagMessage], pace: float) -> Iterator[BagMessage]:
    """At its stamps where these are of the present, else from now on."""
    begin_s, first_ns = None, 0
    for m in part:
        if begin_s is None:
            begin_s, first_ns = time.monotonic(), m.log_ns
            if pace == 1.0:
                begin_s += 1e-9 * (m.log_ns - time.time_ns())
        if (left_s := begin_s + 1e-9 * (m.log_ns - first_ns) / pace - time.monotonic()) > 0.0:
            time.sleep(left_s)
        yield m


def _until(condition: Callable[[], bool], what: str, rest_s: float = 0.02) -> None:
    """Poll for what must come to be."""
    deadline_s = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise SystemExit(f"no {what} in {_PATIENCE_S:g} s")
        time.sleep(rest_s)


if __name__ == "__main__":
    rclpy.init()
    bare, executor = Node("bare"), SingleThreadedExecutor()
    for name in sys.argv[1:]:
        bare.create_subscription(message_class(TYPES[name]), name, lambda message: None, _DEEP)
    executor.add_node(bare)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
