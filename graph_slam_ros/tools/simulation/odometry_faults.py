"""Faults of the driver of odometry, put into the messages of a recording."""

from collections.abc import Callable
from copy import deepcopy

import numpy as np
from numpy.random import Generator

from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.tools.simulation.drive import Drive, Message
from graph_slam_ros.tools.simulation.options import option
from graph_slam_ros.typing import Array


def recorded_twice(drive: Drive, _rng: Generator) -> None:
    """Odometry of which each message is in the recording twice."""
    again = []
    for m in drive.messages:
        again += [m] * (2 if m.topic == drive.odometry_topic else 1)
    drive.messages = again


def out_of_order(drive: Drive, rng: Generator) -> None:
    """Odometry of which one message in fifty is stamped 0.2 s too early."""
    for m in drive.odometry:
        m.stamp_ns -= NS // 5 if rng.random() < 0.02 else 0


def gap(drive: Drive, _rng: Generator) -> None:
    """Odometry of which a stretch of 5 s is lost, after a third of the drive."""
    at_ns = np.quantile(drive.odometry_ns, 0.33)
    drive.drop([m for m in drive.odometry if at_ns < m.stamp_ns <= at_ns + 5 * NS])


def slow_odometry(drive: Drive, _rng: Generator, hz: float = option(2.0, "so many a second", "Hz", 1e-3, 1e4)) -> None:
    """Odometry of which few messages are left."""
    number, out = -1, []
    for m in drive.odometry:
        now = int(m.stamp_ns * 1e-9 * hz)
        out += [m] if now == number else []
        number = now
    drive.drop(out)


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


def wrong_scale(
    drive: Drive,
    _rng: Generator,
    distance: float = option(1.05, "distance in odometry for each metre driven", "", -1e6, 1e6),
    turn: float = option(1.0, "and turn for each radian turned", "", -1e3, 1e3),
    begin: float = option(0.0, "when, as a part of the messages: 0 the first, 1 the last", "", 0, 1),
    lasting: float = option(1.0, "for how long, as a part of the messages", "", 0, 1),
) -> None:
    """Odometry that drives and turns more than the robot: wheels, track width, units, sign."""
    poses = drive.poses
    moved, turned = _steps(poses)
    number = np.arange(len(poses))
    first, last = begin * len(poses), (begin + lasting) * len(poses)
    is_wrong = ((number >= first) & (number <= last))[:, None]
    ways, turns = np.where(is_wrong, distance, 1.0), np.where(is_wrong, turn, 1.0)
    drive.poses = _chained(poses[0], moved * ways[1:], turned * turns[1:])
    factors = iter(zip(ways[:, 0].tolist(), turns[:, 0].tolist(), strict=True))

    def changed(v: Array, w: Array, _: Array) -> tuple[Array, Array]:
        of_way, of_turn = next(factors)
        return v * of_way, w * of_turn

    _twists(drive, changed)


def wrong_twist(
    drive: Drive,
    _rng: Generator,
    linear: float = option(1.0, "factor of the speed", "", -1e6, 1e6),
    angular: float = option(1.0, "factor of the turn rate", "", -1e6, 1e6),
    axes: str = option("base", "along the axes of this frame", choices=("base", "odom")),
) -> None:
    """Odometry whose twist is in other units or axes than its pose."""

    def changed(v: Array, w: Array, pose: Array) -> tuple[Array, Array]:
        along = np.array(so3.act(tuple(pose[3:]), tuple(v))) if axes == "odom" else v
        return along * linear, w * angular

    _twists(drive, changed)


def twist_variance(
    drive: Drive, _rng: Generator, variance: float = option(1e-12, "of each axis", "(m/s)^2", -1e12, 1e12)
) -> None:
    """Odometry whose twist has another covariance."""
    for m in drive.odometry:
        covariance = np.array(m.content.twist.covariance)
        covariance[[0, 7, 35]] = variance
        m.content.twist.covariance = covariance


def standing(drive: Drive, _rng: Generator) -> None:
    """Odometry that is not connected: it always says the same pose."""
    drive.poses = np.repeat(drive.poses[:1], len(drive.odometry), axis=0)
    _twists(drive, lambda v, w, _: (0.0 * v, 0.0 * w))


def _moved(poses: Array, at: int, T: se3.Pose) -> Array:
    """Poses of which those from a number on are moved together, so that the first of them lies there."""
    motion = se3.compose(T, se3.inverse(tuple(poses[at].tolist())))
    later = np.stack(se3.compose(motion, tuple(poses[at:].T)), axis=1)
    return np.concatenate([poses[:at], later])


def restarted(drive: Drive, _rng: Generator) -> None:
    """Odometry whose driver is restarted half-way, and begins at zero again."""
    poses = drive.poses
    first = min(round(0.5 * len(poses)), len(poses) - 1)
    moved = _moved(poses, first, se3.IDENTITY)
    moved[first] = se3.IDENTITY
    drive.poses = moved


def corrected(drive: Drive, rng: Generator) -> None:
    """Odometry that a localiser corrects every 20 s, by some 0.3 m and 0.05 rad."""
    poses, stamps_ns = drive.poses, drive.odometry_ns
    for at_ns in np.arange(stamps_ns[0] + 20.0 * NS, stamps_ns[-1], 20.0 * NS):
        at = int(np.searchsorted(stamps_ns, at_ns))
        by = (*(0.3 * rng.standard_normal(2)), 0.0, *so3.exp((0.0, 0.0, 0.05 * rng.normal())))
        poses = _moved(poses, at, se3.compose(tuple(poses[at].tolist()), by))
    drive.poses = poses


def other_publisher(drive: Drive, _rng: Generator) -> None:
    """Odometry that a second node publishes on the same topic, a little later, from an origin of its own."""
    messages, later_ns, x_m, distance = [], NS // 100, 8.0, 0.98
    for m in drive.messages:
        messages.append(m)
        if m.topic == drive.odometry_topic:
            other = Message(m.topic, m.type, m.log_ns + later_ns, deepcopy(m.content))
            other.stamp_ns = m.stamp_ns + later_ns
            at, twist = other.content.pose.pose.position, other.content.twist.twist.linear
            at.x, at.y = x_m + distance * at.x, distance * at.y
            twist.x, twist.y = distance * twist.x, distance * twist.y
            messages.append(other)
    drive.messages = sorted(messages, key=lambda m: m.log_ns)


def not_a_number(drive: Drive, rng: Generator) -> None:
    """Odometry with one position in a hundred that is no number."""
    for m in drive.odometry:
        if rng.random() < 0.01:
            m.content.pose.pose.position.x = float("nan")


_KINDS = (
    *(recorded_twice, out_of_order, gap, slow_odometry, wrong_scale, wrong_twist, twist_variance),
    *(standing, restarted, corrected, other_publisher, not_a_number),
)
ODOMETRY_KINDS = {put.__name__: put for put in _KINDS}
