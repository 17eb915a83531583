"""What a robot sends, in the order it sends it: messages as the middleware's own bytes, made by our simulator."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias
from unittest.mock import patch

import numpy as np
from numpy.random import PCG64, Generator

from benchmarks.problem import Array, city_problem
from graph_slam_ros.lie import se2
from graph_slam_ros.messages import to_msg
from graph_slam_ros.recordings.bag import BagMessage, open_bag
from graph_slam_ros.tools.simulation import simulate, write_bag
from graph_slam_ros.tools.simulation import warehouse as slower
from graph_slam_ros.tools.simulation.recording import START_NS

ODOMETRY, LANDMARKS, CLOSURES = "/odom", "/landmarks", "/closures"
TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    LANDMARKS: "vision_msgs/msg/Detection3DArray",
    CLOSURES: "vision_msgs/msg/Detection3DArray",
}
Motion: TypeAlias = tuple[int, se2.Pose]
Motions: TypeAlias = dict[int, Motion]
_NS = 1_000_000_000
_UNUSED = 1e6
_LAP_S = 60.0  # of a warehouse, at least
STEP_NS = _NS  # of a city, from one pose to the next
AFTER_NS = 60_000_000  # of a city: odometry that releases what was measured at the pose, 50 ms of stamps before
BEFORE_NS = 1_000  # of a city: closures are stamped by that much before the pose's odometry, and get its keyframe
CITY_SIGMA_M, CITY_SIGMA_RAD = 0.05, 0.01


def warehouse(seconds: float, odometry_hz: int, landmarks_hz: int) -> Iterator[BagMessage]:
    """Laps through a warehouse with so many odometry and landmark messages a second."""
    rates = {"TICK_NS": _NS // odometry_hz, "OBSERVE_EVERY": odometry_hz // landmarks_hz}
    with tempfile.TemporaryDirectory() as folder, patch.multiple(slower, **rates):
        recording = simulate("warehouse", 7, laps=int(seconds / _LAP_S) + 1)
        write_bag(recording, Path(folder) / "drive.mcap")
        messages = open_bag(Path(folder) / "drive.mcap").messages({ODOMETRY, LANDMARKS})
        found = [m for m in messages if m.log_ns < START_NS + seconds * _NS]
    yield from found


def city_steps(poses: int) -> tuple[Motions, Motions]:
    """Odometry and closures of Manhattan by their later pose: the earlier one, and the motion."""
    relative, steps, closures = city_problem(poses).relative, dict[int, Motion](), dict[int, Motion]()
    for (earlier, later), measured in zip(relative.ends.tolist(), relative.measured.tolist(), strict=True):
        (steps if later == earlier + 1 else closures)[later] = earlier, tuple(measured)
    return steps, closures


def city(poses: int) -> Iterator[BagMessage]:
    """Manhattan of 60 by 60 blocks with a closure per three poses.

    A pose per second: its odometry, the closure that ends there, and odometry that releases both.
    """
    steps, closures = city_steps(poses)
    covariance, at = np.diag(np.square([CITY_SIGMA_M, CITY_SIGMA_M, CITY_SIGMA_RAD])), se2.IDENTITY
    for k in range(poses):
        stamp_ns = START_NS + k * STEP_NS
        if k:
            at = tuple(map(float, se2.compose(at, steps[k][1])))
        yield BagMessage(ODOMETRY, stamp_ns, _odometry(stamp_ns, at))
        if k in closures:
            yield _closure(stamp_ns - BEFORE_NS, START_NS + closures[k][0] * STEP_NS, closures[k][1], covariance)
        if k + 1 < poses:
            ahead = se2.interpolate(se2.IDENTITY, steps[k + 1][1], AFTER_NS / STEP_NS)
            then_ns = stamp_ns + AFTER_NS
            yield BagMessage(ODOMETRY, then_ns, _odometry(then_ns, se2.compose(at, ahead)))


def standing(hours: float, jitter_m: float) -> Iterator[BagMessage]:
    """A robot that does not move: odometry at 10 Hz that says so, each position and heading off by some noise."""
    rng = Generator(PCG64(3))
    count = round(hours * 36_000)
    still = np.concatenate([np.zeros(6), np.diag([0.05, 0.01, 0.01, 0.01, 0.01, 0.05]).ravel() ** 2]).tobytes()
    for k, pose in enumerate((jitter_m * rng.standard_normal((count, 3))).tolist()):
        stamp_ns = START_NS + k * (_NS // 10)
        yield BagMessage(ODOMETRY, stamp_ns, _odometry(stamp_ns, tuple(pose), still))


STREAMS = {"warehouse": warehouse, "city": city, "standing": standing}


def later(m: BagMessage, by_ns: int) -> BagMessage:
    """The same at another time; headers inside keep theirs, nobody reads them."""
    stamp_ns = m.log_ns + by_ns
    stamp = np.array([stamp_ns // _NS, stamp_ns % _NS], dtype="<u4").tobytes()
    return BagMessage(m.topic, stamp_ns, m.cdr[:4] + stamp + m.cdr[12:])


def stamp_ns(cdr: bytes, at: int = 4) -> int:
    """Stamp of the header, or of that of the first of a list (at 8)."""
    return int.from_bytes(cdr[at : at + 4], "little") * _NS + int.from_bytes(cdr[at + 4 : at + 8], "little")


def _odometry(stamp_ns: int, at: tuple[float, ...], twist: bytes | None = None) -> bytes:
    return to_msg.odometry(stamp_ns, "odom", "base_link", at, np.eye(3), _UNUSED, twist)


def _closure(stamp_ns: int, earlier_ns: int, T_earlier_later: tuple[float, ...], covariance: Array) -> BagMessage:
    """Where the robot was earlier, as it is seen from where it is."""
    seen = tuple(map(float, se2.inverse(T_earlier_later)))
    turned = se2.adjoint(T_earlier_later)
    posed = to_msg.pose_with_covariance(seen, turned @ covariance @ turned.T, _UNUSED)
    head, make = to_msg.header(stamp_ns, "base_link"), to_msg.make
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id="", score=1.0)
    one = make(
        "vision_msgs/msg/Detection3D",
        header=head,
        results=[make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=posed)],
        bbox=make("vision_msgs/msg/BoundingBox3D", center=posed.pose, size=to_msg.vector(0.0, 0.0)),
        id=str(earlier_ns),
    )
    return BagMessage(CLOSURES, stamp_ns, to_msg.encode(make(TYPES[CLOSURES], header=head, detections=[one])))
