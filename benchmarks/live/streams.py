"""What a robot sends, in the order it sends it: messages as the middleware's own bytes, made by our simulator."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.random import PCG64, Generator

from benchmarks.problem import city_problem
from graph_slam_ros.formats.cdr import stamp
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.messages import to_msg
from graph_slam_ros.recordings.bag import BagMessage, open_bag
from graph_slam_ros.slam import Closure, Odometry
from graph_slam_ros.tools.simulation import simulate, write_bag
from graph_slam_ros.tools.simulation import warehouse as slower
from graph_slam_ros.tools.simulation.recording import START_NS

ODOMETRY, LANDMARKS, CLOSURES = "/odom", "/landmarks", "/closures"
TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    LANDMARKS: "vision_msgs/msg/Detection3DArray",
    CLOSURES: "vision_msgs/msg/Detection3DArray",
}
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


def city_measurements(poses: int) -> Iterator[Odometry | Closure]:
    """Manhattan of 60 by 60 blocks with a closure per three poses.

    A pose per second: its odometry, the closure that ends there, and odometry that releases both.
    """
    relative, steps, closures = city_problem(poses).relative, dict[int, se2.Pose](), dict[int, tuple[int, se2.Pose]]()
    for (earlier, later), measured in zip(relative.ends.tolist(), relative.measured, strict=True):
        if later == earlier + 1:
            steps[later] = tuple(measured.tolist())
        else:
            closures[later] = earlier, tuple(measured.tolist())
    covariance = tuple(np.diag(np.square([CITY_SIGMA_M, CITY_SIGMA_M, CITY_SIGMA_RAD])).ravel().tolist())
    at = se2.IDENTITY
    for k in range(poses):
        stamp_ns = START_NS + k * STEP_NS
        at = tuple(map(float, se2.compose(at, steps[k]))) if k else at
        yield Odometry(stamp_ns, at)
        if k in closures:
            earlier, T_earlier_now = closures[k]
            from_ns = START_NS + earlier * STEP_NS
            yield Closure(stamp_ns - BEFORE_NS, from_ns, "closures", T_earlier_now, covariance)
        if k + 1 < poses:
            ahead = se2.interpolate(se2.IDENTITY, steps[k + 1], AFTER_NS / STEP_NS)
            yield Odometry(stamp_ns + AFTER_NS, tuple(map(float, se2.compose(at, ahead))))


def city(poses: int) -> Iterator[BagMessage]:
    """The same as messages."""
    for m in city_measurements(poses):
        if isinstance(m, Odometry):
            yield BagMessage(ODOMETRY, m.stamp_ns, _odometry(m.stamp_ns, m.T_odom_base))
        else:
            yield _closure(m)


def standing(hours: float, jitter_m: float) -> Iterator[BagMessage]:
    """A robot that does not move: odometry at 10 Hz that says so, each position and heading off by some noise."""
    rng = Generator(PCG64(3))
    count = round(hours * 36_000)
    still = np.concatenate([np.zeros(6), np.diag([0.05, 0.01, 0.01, 0.01, 0.01, 0.05]).ravel() ** 2]).tobytes()
    for k, pose in enumerate((jitter_m * rng.standard_normal((count, 3))).tolist()):
        stamp_ns = START_NS + k * (_NS // 10)
        yield BagMessage(ODOMETRY, stamp_ns, _odometry(stamp_ns, tuple(pose), still))


STREAMS: dict[str, tuple[Callable[..., Iterator[BagMessage]], tuple[str, ...]]] = {
    "warehouse": (warehouse, (ODOMETRY, LANDMARKS)),
    "city": (city, (ODOMETRY, CLOSURES)),
    "standing": (standing, (ODOMETRY,)),
}
"""What makes each, and its topics."""


def later(m: BagMessage, by_ns: int) -> BagMessage:
    """The same at another time; headers inside keep theirs, nobody reads them."""
    stamp_ns = m.log_ns + by_ns
    return BagMessage(m.topic, stamp_ns, m.cdr[:4] + stamp(stamp_ns) + m.cdr[12:])


def stamp_ns(cdr: bytes, at: int = 4) -> int:
    """Stamp of the header, or of that of the first of a list (at 8)."""
    return int.from_bytes(cdr[at : at + 4], "little") * _NS + int.from_bytes(cdr[at + 4 : at + 8], "little")


def _odometry(stamp_ns: int, at: tuple[float, ...], twist: bytes | None = None) -> bytes:
    return to_msg.odometry(stamp_ns, "odom", "base_link", at, np.eye(3), _UNUSED, twist)


def _closure(m: Closure) -> BagMessage:
    """Where the robot was earlier, as it is seen from where it is."""
    seen, turned = tuple(map(float, se2.inverse(m.T_from_base))), se2.adjoint(m.T_from_base)
    posed = to_msg.pose_with_covariance(seen, turned @ np.reshape(m.covariance, (3, 3)) @ turned.T, _UNUSED)
    poses, names = np.asarray(se3.in_space(np.array([seen]))), [str(m.from_stamp_ns)]
    cdr = to_msg.detections(m.stamp_ns, "base_link", names, poses, np.reshape(posed.covariance, (1, 6, 6)))
    return BagMessage(CLOSURES, m.stamp_ns, cdr)
