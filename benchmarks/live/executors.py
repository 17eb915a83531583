"""Receiving odometry in Python: what a message costs with each of rclpy's executors, and how many come through.

Alone; beside a thread of the same process that computes in Python without end, so that whoever receives waits for the
interpreter's lock; and with callbacks that take longer than messages take to come.
"""

import sys
import threading
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from benchmarks import options
from benchmarks.live.processes import PATIENCE_S, Process, asked, percentile, reply, ros, running, until
from benchmarks.table import Row

_SINGLE, _EVENTS = "SingleThreadedExecutor", "EventsExecutor"
_RAW = ", raw"
_ALONE, _THREAD, _QUICK_THREAD, _SLOW = "", "a busy thread", "a busy thread, switched every 0.5 ms", "callbacks of 2 ms"
_CASES = (  # rate (0: as fast as they can be sent), what else there is, kinds
    *((rate, _ALONE, (_SINGLE, _SINGLE + _RAW, _EVENTS, _EVENTS + _RAW)) for rate in (100, 500, 1000, 0)),
    *((1000, load, (_SINGLE + _RAW, _EVENTS + _RAW)) for load in (_THREAD, _QUICK_THREAD, _SLOW)),
)
_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
_TIMER_HZ = 20
_HERE = "benchmarks.live.executors"


def measure(short: bool) -> list[Row]:
    """One row for each rate, load and executor."""
    rows, seconds = [], 2.0 if short else 10.0
    for rate, load, kinds in _CASES:
        for kind in kinds:
            about = {"sent per s": rate or "flood", "beside": load, "executor": kind}
            rows.append(about | _one(kind, rate, load, seconds))
            options.say(f"executors: {rows[-1]}")
    return rows


def _one(kind: str, rate: int, load: str, seconds: float) -> Row:
    receiver, sender = Process(_HERE, "receive", kind, load), Process(_HERE, "send")
    with running(receiver, sender):
        receiver.answer()
        sender.answer()
        sender.tell(rate=rate, seconds=seconds + 2.0)
        time.sleep(1.0)
        begin, cpu_s, start = receiver.ask(), receiver.cpu_s, time.monotonic()
        time.sleep(seconds)
        end, cpu_s, took_s = receiver.ask(), receiver.cpu_s - cpu_s, time.monotonic() - start
        messages = end["messages"] - begin["messages"]
        return {
            "received per s": messages / took_s,
            "CPU us per message": 1e6 * cpu_s / max(messages, 1) if load in (_ALONE, _SLOW) else None,
            "late, median ms": 1e3 * percentile(end["late_s"], 0.5),
            "late, p99 ms": 1e3 * percentile(end["late_s"], 0.99),
            f"of a timer's {_TIMER_HZ} Hz": (end["timer"] - begin["timer"]) / took_s,
        }


def receive(kind: str, load: str) -> None:
    """A node with an empty callback and a timer; tells when asked how often they were called."""
    with ros():
        node = Node("receiver")
        raw = kind.endswith(_RAW)
        count = {"messages": 0, "timer": 0}
        late_s: list[float] = []

        def on_odometry(message: Any) -> None:
            count["messages"] += 1
            if count["messages"] % 10 == 0:
                late_s.append(1e-9 * (time.time_ns() - (_raw_stamp_ns(message) if raw else _stamp_ns(message))))
            if load == _SLOW:
                time.sleep(0.002)

        def on_timer() -> None:
            count["timer"] += 1

        node.create_subscription(Odometry, "odom", on_odometry, _QOS, raw=raw)
        node.create_timer(1.0 / _TIMER_HZ, on_timer)
        executor: Executor = EventsExecutor() if kind.startswith(_EVENTS) else SingleThreadedExecutor()
        executor.add_node(node)
        until(lambda: node.count_publishers("odom") == 1, lambda: executor.spin_once(timeout_sec=0.05), "publisher")
        threading.Thread(target=_answer, args=(count, late_s), daemon=True).start()
        if load in (_THREAD, _QUICK_THREAD):
            sys.setswitchinterval(0.005 if load == _THREAD else 0.0005)
            threading.Thread(target=_compute, daemon=True).start()
        while True:
            executor.spin_once(timeout_sec=0.1)


def _stamp_ns(message: Odometry) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def _raw_stamp_ns(cdr: bytes) -> int:
    return int.from_bytes(cdr[4:8], "little") * 10**9 + int.from_bytes(cdr[8:12], "little")


def _compute() -> None:
    while True:
        sum(range(1000))


def _answer(count: dict[str, int], late_s: list[float]) -> None:
    reply("ready")
    for _ in sys.stdin:
        told = {**count, "late_s": late_s.copy()}
        late_s.clear()
        reply(told)


def send() -> None:
    """Publish at a rate, stamped with the time of day."""
    with ros():
        node = Node("sender")
        publisher = node.create_publisher(Odometry, "odom", _QOS)
        until(lambda: publisher.get_subscription_count() == 1, lambda: time.sleep(0.02), "subscriber", 2 * PATIENCE_S)
        cdr = bytearray(serialize_message(Odometry()))
        reply("ready")
        order = asked()
        start, sent = time.monotonic(), 0
        while (now := time.monotonic()) < start + order["seconds"]:
            if order["rate"] and now < start + sent / order["rate"]:
                time.sleep(start + sent / order["rate"] - now)
            stamp_ns = time.time_ns()
            cdr[4:8] = (stamp_ns // 10**9).to_bytes(4, "little")
            cdr[8:12] = (stamp_ns % 10**9).to_bytes(4, "little")
            publisher.publish(bytes(cdr))
            sent += 1
        asked()


if __name__ == "__main__":
    {"receive": receive, "send": send}[sys.argv[1]](*sys.argv[2:])
