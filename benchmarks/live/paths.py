"""What it costs the node to tell a subscriber a long path: from the estimate to the middleware's hands.

A robot drives in circles until it has so many keyframes; then its path is published as the node does it, to a
subscriber in a process of its own. CPU time: of the calling thread, which is what a callback takes, and of the whole
process, the middleware's threads included, until the path has arrived.
"""

import sys
import time
from statistics import median
from typing import Any

import rclpy
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

from benchmarks import options
from benchmarks.live.processes import Process, asked, reply, ros, running, until
from benchmarks.table import Row
from graph_slam_ros.lie import se2
from graph_slam_ros.messages import results
from graph_slam_ros.slam import Config, GraphSlam, Odometry

_HERE = "benchmarks.live.paths"
_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STEP: se2.Pose = (0.5, 0.0, 0.01)  # more than the distance between keyframes
_STEPS = ("encoding", "publishing", "callback", "process")


def measure(short: bool) -> list[Row]:
    """One row for each length of path, bounded as the node's parameters say."""
    rows = []
    for keyframes, reps in ((1_000, 3), (10_000, 3)) if short else ((1_000, 20), (10_000, 20), (100_000, 20)):
        publisher, listener = Process(_HERE, "publish", keyframes, reps), Process(_HERE, "listen")
        with running(publisher, listener):
            told = publisher.answer()
        rows.append({"keyframes": keyframes, "poses published": told["poses"]})
        rows[-1] |= {f"{name}, CPU ms": median(told["cpu_ms"][name]) for name in _STEPS}
        options.say(f"path: {rows[-1]}")
    return rows


def publish(keyframes: str, reps: str) -> None:
    """CPU milliseconds of each step, of each repetition; every path has arrived before the next is sent."""
    with ros():
        slam = _drive(int(keyframes))
        node = Node("publisher")
        publisher = node.create_publisher(Path, "path", _LATCHED)
        heard: list[int] = []
        node.create_subscription(UInt64, "heard", lambda message: heard.append(message.data), 10)

        def rest(seconds: float = 0.02) -> Any:
            return rclpy.spin_once(node, timeout_sec=seconds)

        until(lambda: publisher.get_subscription_count() == 1, rest, "subscriber", 60.0)
        until(lambda: node.count_publishers("heard") == 1, rest, "answer")
        cpu_ms: dict[str, list[float]] = {name: [] for name in _STEPS}
        for rep in range(int(reps) + 1):
            process, start = time.process_time(), time.thread_time()
            message = results.path(slam.view, slam.view.config.output.path_max_poses)
            encoded = time.thread_time()
            publisher.publish(message)
            end = time.thread_time()
            until(lambda wanted=rep: len(heard) > wanted, lambda: rest(0.2), "path that arrives")
            done = time.process_time()
            if rep:  # the first opens the way
                spent = encoded - start, end - encoded, end - start, done - process
                for name, seconds in zip(_STEPS, spent, strict=True):
                    cpu_ms[name].append(1e3 * seconds)
        reply({"poses": heard[-1], "cpu_ms": cpu_ms})
        asked()


def _drive(keyframes: int) -> GraphSlam:
    """A robot with so many keyframes, which it has solved for now and then."""
    slam, pose, stamp_ns = GraphSlam(Config.from_mapping({"solve.every_keyframes": 100})), se2.IDENTITY, 1
    while len(slam.view.keyframes) < keyframes:
        slam.process(Odometry(stamp_ns, pose))
        pose, stamp_ns = se2.compose(pose, _STEP), stamp_ns + 500_000_000
    return slam


def listen() -> None:
    """The subscriber: answers each path with its number of poses."""
    with ros():
        node = Node("listener")
        answer = node.create_publisher(UInt64, "heard", 10)
        node.create_subscription(Path, "path", lambda path: answer.publish(UInt64(data=len(path.poses))), _LATCHED)
        rclpy.spin(node)


if __name__ == "__main__":
    {"publish": publish, "listen": listen}[sys.argv[1]](*sys.argv[2:])
