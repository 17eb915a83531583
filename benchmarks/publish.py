"""What it costs the node to tell a subscriber a long path: from the estimate to the middleware's hands.

``python -m benchmarks.publish``, where ROS 2 is installed. A robot drives in circles until it has so many keyframes;
then its path is published as the node does it, to a subscriber in a process of its own. CPU time: of the calling
thread, which is what a callback takes, and of the whole process, the middleware's threads included, until the
path has arrived.
"""

import argparse
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median

import rclpy
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import UInt64

from benchmarks.fresh import ROOT
from graph_slam_ros.lie import se2
from graph_slam_ros.ros import results
from graph_slam_ros.slam import GraphSlam, Odometry

_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_STEP: se2.Pose = (0.5, 0.0, 0.01)  # more than the distance between keyframes
_PATIENCE_S = 20.0


def drive(keyframes: int) -> GraphSlam:
    """A robot with so many keyframes."""
    slam, pose, stamp_ns = GraphSlam(), se2.IDENTITY, 0
    while len(slam.keyframes) < keyframes:
        slam.process(Odometry(stamp_ns, pose))
        pose, stamp_ns = se2.compose(pose, _STEP), stamp_ns + 500_000_000
    return slam


def publish(slam: GraphSlam, reps: int) -> dict[str, list[float]]:
    """CPU milliseconds of each step, of each repetition; every path has arrived before the next is sent."""
    node = Node("publish")
    publisher = node.create_publisher(Path, "path", _LATCHED)
    heard: list[int] = []
    node.create_subscription(UInt64, "heard", lambda message: heard.append(message.data), 10)
    listener = subprocess.Popen([sys.executable, "-m", "benchmarks.publish", "--listen"], cwd=ROOT)
    times: dict[str, list[float]] = {"encode": [], "publish": [], "thread": [], "process": []}
    try:
        _until(lambda: publisher.get_subscription_count() == 1 and node.count_publishers("heard") == 1, node)
        for rep in range(reps + 1):
            process, start = time.process_time(), time.thread_time()
            message = results.path(slam)
            encoded = time.thread_time()
            publisher.publish(message)
            end = time.thread_time()
            _until(lambda wanted=rep: len(heard) > wanted, node, rest_s=0.2)
            done = time.process_time()
            if heard[-1] != len(slam.keyframes):
                raise SystemExit(f"{heard[-1]} poses arrived")
            for name, seconds in zip(times, (encoded - start, end - encoded, end - start, done - process), strict=True):
                times[name].append(1e3 * seconds)
    finally:
        listener.terminate()
        listener.wait()
    return {name: values[1:] for name, values in times.items()}  # the first opens the way


def _until(condition: Callable[[], bool], node: Node, rest_s: float = 0.02) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit("the subscriber does not answer")
        rclpy.spin_once(node, timeout_sec=rest_s)


def listen() -> None:
    """The subscriber: answers each path with its number of poses."""
    node = Node("listen")
    answer = node.create_publisher(UInt64, "heard", 10)
    node.create_subscription(Path, "path", lambda path: answer.publish(UInt64(data=len(path.poses))), _LATCHED)
    rclpy.spin(node)


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=10_000, metavar="N")
    parser.add_argument("--reps", type=int, default=20, metavar="N", help="repetitions; their medians are told")
    parser.add_argument("--listen", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 100)))
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    if args.listen:
        listen()
        return
    times = publish(drive(args.keyframes), args.reps)
    of = {name: median(values) for name, values in times.items()}
    print(f"a path of {args.keyframes} keyframes, CPU, median of {args.reps}")
    print(f"  node     {of['thread']:6.2f} ms   encoding {of['encode']:.2f}, publishing {of['publish']:.2f}")
    print(f"  process  {of['process']:6.2f} ms   with the middleware's threads, until it has arrived")


if __name__ == "__main__":
    main()
