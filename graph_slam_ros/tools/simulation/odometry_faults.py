"""Faults of the driver of odometry, put into the messages of a recording."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.tools.simulation.drive import Drive, Message
from graph_slam_ros.tools.simulation.options import Kind, option
from graph_slam_ros.typing import Array

AT = "when, as a part of the messages: 0 the first, 1 the last"
CHANGED = "of the messages"


@dataclass(frozen=True, slots=True)
class RecordedTwice:
    """Odometry of which each message is in the recording twice."""


@dataclass(frozen=True, slots=True)
class OutOfOrder:
    """Odometry of which some messages are stamped too early."""

    seconds: float = option(0.2, "by so much", "s", 0, 100)
    rate: float = option(0.02, CHANGED, "", 0, 1)


@dataclass(frozen=True, slots=True)
class Gap:
    """Odometry of which a stretch is lost."""

    seconds: float = option(5.0, "how long", "s", 0, 1e6)
    at: float = option(0.33, AT, "", 0, 1)


@dataclass(frozen=True, slots=True)
class SlowOdometry:
    """Odometry of which few messages are left."""

    hz: float = option(2.0, "so many a second", "Hz", 1e-3, 1e4)


@dataclass(frozen=True, slots=True)
class Jitter:
    """Odometry that is stamped when it arrives."""

    seconds: float = option(0.06, "mean delay", "s", 0, 100)


@dataclass(frozen=True, slots=True)
class WrongScale:
    """Odometry that drives and turns more than the robot: wheels, track width, units, sign."""

    distance: float = option(1.05, "distance in odometry for each metre driven", "", -1e6, 1e6)
    turn: float = option(1.0, "and turn for each radian turned", "", -1e3, 1e3)
    begin: float = option(0.0, AT, "", 0, 1)
    lasting: float = option(1.0, "for how long, as a part of the messages", "", 0, 1)


@dataclass(frozen=True, slots=True)
class WrongTwist:
    """Odometry whose twist is in other units or axes than its pose."""

    linear: float = option(1.0, "factor of the speed", "", -1e6, 1e6)
    angular: float = option(1.0, "factor of the turn rate", "", -1e6, 1e6)
    axes: str = option("base", "along the axes of this frame", choices=("base", "odom"))


@dataclass(frozen=True, slots=True)
class TwistVariance:
    """Odometry whose twist has another covariance."""

    variance: float = option(1e-12, "of each axis", "(m/s)^2", -1e12, 1e12)


@dataclass(frozen=True, slots=True)
class Standing:
    """Odometry that is not connected: it always says the same pose."""


@dataclass(frozen=True, slots=True)
class Restarted:
    """Odometry whose driver is restarted, and begins at zero again."""

    at: float = option(0.5, AT, "", 0, 1)


@dataclass(frozen=True, slots=True)
class Corrected:
    """Odometry that a localiser corrects."""

    every_s: float = option(20.0, "how often", "s", 0.1, 1e6)
    sigma_m: float = option(0.3, "by how much", "m", 0, 1e3)
    sigma_rad: float = option(0.05, "and how much it is turned", "rad", 0, 3.0)


@dataclass(frozen=True, slots=True)
class OtherPublisher:
    """Odometry that a second node publishes on the same topic, a little later, from an origin of its own."""

    seconds: float = option(0.01, "how much later", "s", 1e-6, 100)
    x_m: float = option(8.0, "where the robot of the first is in the odometry of the second", "m", -1e6, 1e6)
    distance: float = option(0.98, "its distance for each metre of the first", "", 1e-3, 1e3)


@dataclass(frozen=True, slots=True)
class NotANumber:
    """Odometry with positions that are no numbers."""

    rate: float = option(0.01, CHANGED, "", 0, 1)


def _recorded_twice(drive: Drive, _fault: RecordedTwice, _rng: Generator) -> None:
    again = []
    for m in drive.messages:
        again += [m] * (2 if m.topic == drive.odometry_topic else 1)
    drive.messages = again


def _out_of_order(drive: Drive, fault: OutOfOrder, rng: Generator) -> None:
    for m in drive.odometry:
        m.stamp_ns -= round(fault.seconds * NS) if rng.random() < fault.rate else 0


def _gap(drive: Drive, fault: Gap, _rng: Generator) -> None:
    at_ns = np.quantile(drive.odometry_ns, fault.at)
    drive.drop([m for m in drive.odometry if at_ns < m.stamp_ns <= at_ns + fault.seconds * NS])


def _slow(drive: Drive, fault: SlowOdometry, _rng: Generator) -> None:
    number, out = -1, []
    for m in drive.odometry:
        now = int(m.stamp_ns * 1e-9 * fault.hz)
        out += [m] if now == number else []
        number = now
    drive.drop(out)


def _jitter(drive: Drive, fault: Jitter, rng: Generator) -> None:
    drive.restamp(drive.odometry, lambda t: np.sort(t + (rng.exponential(fault.seconds, len(t)) * NS).astype(np.int64)))


def _chained(first: Array, moved: Array, turned: Array) -> Array:
    """Poses (n + 1, 7) of steps: motions (n, 3) and rotation vectors (n, 3)."""
    rotations = np.stack(so3.exp(tuple(turned.T)), axis=1)
    poses = [tuple(first.tolist())]
    for at, q in zip(moved.tolist(), rotations.tolist(), strict=True):
        x, y, z, *turn = se3.compose(poses[-1], (*at, *q))
        norm = sum(n * n for n in turn) ** 0.5
        poses.append((x, y, z, *(n / norm for n in turn)))
    return np.array(poses)


def _steps(poses: Array) -> tuple[Array, Array]:
    motion = np.stack(se3.between(tuple(poses[:-1].T), tuple(poses[1:].T)), axis=1)
    return motion[:, :3], np.stack(so3.log(tuple(motion[:, 3:].T)), axis=1)


def _twists(drive: Drive, change: Callable[[Array, Array, Array], tuple[Array, Array]]) -> None:
    for m, pose in zip(drive.odometry, drive.poses, strict=True):
        v, w = m.content.twist.twist.linear, m.content.twist.twist.angular
        linear, angular = change(np.array([v.x, v.y, v.z]), np.array([w.x, w.y, w.z]), pose)
        v.x, v.y, v.z = map(float, linear)
        w.x, w.y, w.z = map(float, angular)


def _wrong_scale(drive: Drive, fault: WrongScale, _rng: Generator) -> None:
    poses = drive.poses
    moved, turned = _steps(poses)
    number = np.arange(len(poses))
    first, last = fault.begin * len(poses), (fault.begin + fault.lasting) * len(poses)
    is_wrong = ((number >= first) & (number <= last))[:, None]
    distance, turn = np.where(is_wrong, fault.distance, 1.0), np.where(is_wrong, fault.turn, 1.0)
    drive.poses = _chained(poses[0], moved * distance[1:], turned * turn[1:])
    factors = iter(zip(distance[:, 0].tolist(), turn[:, 0].tolist(), strict=True))

    def changed(v: Array, w: Array, _: Array) -> tuple[Array, Array]:
        of_way, of_turn = next(factors)
        return v * of_way, w * of_turn

    _twists(drive, changed)


def _wrong_twist(drive: Drive, fault: WrongTwist, _rng: Generator) -> None:
    def changed(v: Array, w: Array, pose: Array) -> tuple[Array, Array]:
        along = np.array(so3.act(tuple(pose[3:]), tuple(v))) if fault.axes == "odom" else v
        return along * fault.linear, w * fault.angular

    _twists(drive, changed)


def _twist_variance(drive: Drive, fault: TwistVariance, _rng: Generator) -> None:
    for m in drive.odometry:
        covariance = np.array(m.content.twist.covariance)
        covariance[[0, 7, 35]] = fault.variance
        m.content.twist.covariance = covariance


def _standing(drive: Drive, _fault: Standing, _rng: Generator) -> None:
    drive.poses = np.repeat(drive.poses[:1], len(drive.odometry), axis=0)
    _twists(drive, lambda v, w, _: (0.0 * v, 0.0 * w))


def _moved(poses: Array, at: int, T: se3.Pose) -> Array:
    """Poses of which those from a number on are moved together, so that the first of them lies there."""
    motion = se3.compose(T, se3.inverse(tuple(poses[at].tolist())))
    later = np.stack(se3.compose(motion, tuple(poses[at:].T)), axis=1)
    return np.concatenate([poses[:at], later])


def _restarted(drive: Drive, fault: Restarted, _rng: Generator) -> None:
    poses = drive.poses
    at = min(round(fault.at * len(poses)), len(poses) - 1)
    moved = _moved(poses, at, se3.IDENTITY)
    moved[at] = se3.IDENTITY
    drive.poses = moved


def _corrected(drive: Drive, fault: Corrected, rng: Generator) -> None:
    poses, stamps_ns = drive.poses, drive.odometry_ns
    for at_ns in np.arange(stamps_ns[0] + fault.every_s * NS, stamps_ns[-1], fault.every_s * NS):
        at = int(np.searchsorted(stamps_ns, at_ns))
        by = (*(fault.sigma_m * rng.standard_normal(2)), 0.0, *so3.exp((0.0, 0.0, fault.sigma_rad * rng.normal())))
        poses = _moved(poses, at, se3.compose(tuple(poses[at].tolist()), by))
    drive.poses = poses


def _other_publisher(drive: Drive, fault: OtherPublisher, _rng: Generator) -> None:
    messages = []
    for m in drive.messages:
        messages.append(m)
        if m.topic == drive.odometry_topic:
            later_ns = round(fault.seconds * NS)
            other = Message(m.topic, m.type, m.log_ns + later_ns, deepcopy(m.content))
            other.stamp_ns = m.stamp_ns + later_ns
            at, twist = other.content.pose.pose.position, other.content.twist.twist.linear
            at.x, at.y = fault.x_m + fault.distance * at.x, fault.distance * at.y
            twist.x, twist.y = fault.distance * twist.x, fault.distance * twist.y
            messages.append(other)
    drive.messages = sorted(messages, key=lambda m: m.log_ns)


def _not_a_number(drive: Drive, fault: NotANumber, rng: Generator) -> None:
    for m in drive.odometry:
        if rng.random() < fault.rate:
            m.content.pose.pose.position.x = float("nan")


ODOMETRY_KINDS: dict[str, Kind] = {
    "recorded_twice": Kind(RecordedTwice, _recorded_twice),
    "out_of_order": Kind(OutOfOrder, _out_of_order),
    "gap": Kind(Gap, _gap),
    "slow_odometry": Kind(SlowOdometry, _slow),
    "jitter": Kind(Jitter, _jitter),
    "wrong_scale": Kind(WrongScale, _wrong_scale),
    "wrong_twist": Kind(WrongTwist, _wrong_twist),
    "twist_variance": Kind(TwistVariance, _twist_variance),
    "standing": Kind(Standing, _standing),
    "restarted": Kind(Restarted, _restarted),
    "corrected": Kind(Corrected, _corrected),
    "other_publisher": Kind(OtherPublisher, _other_publisher),
    "not_a_number": Kind(NotANumber, _not_a_number),
}
