"""Messages that become odometry: absolute poses in a frame that drifts, and the turn rate of a gyro."""

import math
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np

from graph_slam_ros.lie import se3, so3
from graph_slam_ros.measurements.types import AngularVelocity, Odometry
from graph_slam_ros.messages.inputs import checks
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.odometry_bytes import OdometryRun
from graph_slam_ros.messages.inputs.source import InputContext
from graph_slam_ros.typing import Numbers

TYPE = "nav_msgs/msg/Odometry"
_MOST_SIMILAR, _LONGEST = 3, 80  # transforms that are named, and letters of a frame's name
_SLASHED = ("/", "")
UNUSED = 1e6  # [m^2/s^2, rad^2/s^2]: what drivers of wheels write for what these do not measure


def odometry(source: InputContext, m: Any) -> Iterator[Odometry]:
    """nav_msgs/Odometry, decoded; ``of_run`` does the same for many at once."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    p, parent = m.pose.pose, source.frame(m.header.frame_id)
    at = _in_odom(source, parent, source.named(m.child_frame_id), p.position, p.orientation)
    twist = None
    if source.config.odometry.noise == "twist" and m.child_frame_id.lstrip("/") == source.config.frames.base:
        twist = _twist_covariance(source, m.twist.covariance)  # that of another point of the robot says nothing
    yield Odometry(stamp_ns, at, twist, source.name)


@np.errstate(all="ignore")  # of strange numbers, which are decoded and refused by name
def of_run(source: InputContext, read: OdometryRun, after_ns: int) -> tuple[list[Odometry], list[str]]:
    """The odometry of the first messages of a run, as far as stamps ascend, and nothing is refused or repaired.

    Only the covariance of their twist may be repaired. It was judged before, with a message that was decoded.

    Parameters
    ----------
    after_ns : a stamp that the first is later than

    Returns
    -------
    The odometry, and the repairs of each.
    """
    needs_twist, state = source.config.odometry.noise == "twist", source.state
    twist, repairs = state.get("judged", (None, [])) if needs_twist else (None, [])
    is_judged = not needs_twist or (read.twist_covariance == state.get("raw") and not isinstance(twist, MessageError))
    if not _is_of_base(source, read) or not is_judged:
        return [], []
    numbers, stamps = read.numbers[:, :7], checks.stamps_ns(read.sec, read.nanosec, source.offset_ns)
    are_sound = checks.are_sound(*numbers[:, :3].T) & checks.are_units(*numbers[:, 3:].T)
    poses = source.of_robots_in_plane(numbers, are_sound & (np.diff(stamps, prepend=after_ns) > 0))
    run = [Odometry(stamp, at, twist, source.name) for stamp, at in zip(stamps.tolist(), poses, strict=False)]
    return run, repairs


def _is_of_base(source: InputContext, read: OdometryRun) -> bool:
    """Return whether messages are of the base in odometry's frame, by names that need no change."""
    frames, parent, child = source.config.frames, source.settings.frame or read.frame_id, read.child_frame_id
    is_of_base = parent == frames.odom and child == frames.base and parent != child
    return is_of_base and child[:1] not in _SLASHED and parent[:1] != "/"


def pose_stamped(source: InputContext, m: Any) -> Iterator[Odometry]:
    """geometry_msgs/PoseStamped and PoseWithCovarianceStamped: of the base, or of the configured mount."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    p = m.pose.pose if hasattr(m.pose, "pose") else m.pose
    parent = source.frame(m.header.frame_id)
    yield Odometry(stamp_ns, _in_odom(source, parent, "", p.position, p.orientation), None, source.name)


def transforms(source: InputContext, m: Any) -> Iterable[Odometry]:
    """tf2_msgs/TFMessage: the transform from odometry's frame, or from the configured one, to the base."""
    own = [t for t in m.transforms if _is_of_robot(source, t)]  # /tf tells of everything
    return source.each(own, partial(_of_transform, source))


def _of_transform(source: InputContext, t: Any) -> Odometry:
    stamp_ns, child, at = source.stamp_ns(t.header.stamp), t.child_frame_id.lstrip("/"), t.transform
    T_odom_base = _in_odom(source, source.config.frames.odom, child, at.translation, at.rotation)
    return Odometry(stamp_ns, T_odom_base, None, source.name)


def _is_of_robot(source: InputContext, t: Any) -> bool:
    """Return whether a transform is odometry; of others, the first that may be meant are remembered."""
    frames, parent, child = source.config.frames, t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
    is_in_odom = parent == (source.settings.frame or frames.odom)
    is_of_robot = source.transforms.lookup(frames.base, child) is not None
    if is_in_odom and is_of_robot:
        source.state["found"] = True
        return True
    similar: dict[tuple[str, str], None] = source.state.setdefault("similar", {})
    if (is_in_odom or (is_of_robot and parent != frames.map)) and len(similar) < _MOST_SIMILAR:
        similar[parent, child] = None
    return False


def angular_velocity(source: InputContext, m: Any) -> Iterator[AngularVelocity]:
    """sensor_msgs/Imu as a gyro: its rate about the axes of the base, in the plane about z."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    if m.angular_velocity_covariance[0] == -1.0:
        raise MessageError("no_angular_velocity")
    w, plane = m.angular_velocity, source.space.dimensions == 2
    turn = se3.rotation(source.T_base(source.frame(m.header.frame_id), stamp_ns))
    rate = tuple(map(float, so3.act(turn, (w.x, w.y, w.z))))
    if not all(map(math.isfinite, rate)):  # a large number may become infinite as it is turned
        raise MessageError("nonfinite")
    covariance = _rate_covariance(source, turn, m.angular_velocity_covariance)
    yield AngularVelocity(stamp_ns, source.name, rate[2:] if plane else rate, covariance)


def _rate_covariance(source: InputContext, turn: so3.Quaternion, flat: Any) -> Numbers | None:
    key = flat.tobytes(), turn
    if source.settings.noise == "message" and key != source.state.get("rate_key"):  # drivers repeat the same one
        rotation = so3.matrix(turn)
        full = rotation @ np.asarray(flat, dtype=float).reshape(3, 3) @ rotation.T
        block = full[2:, 2:] if source.space.dimensions == 2 else full
        source.state.update(rate_key=key, rate_covariance=source.checked(block, 0) if block.any() else None)
    covariance: Numbers | None = source.state.get("rate_covariance")
    return covariance


def not_found(source: InputContext) -> str:
    """The transform of odometry on /tf if it has never come, and the transform that may be meant; else empty."""
    if source.settings.type != "tf2_msgs/msg/TFMessage" or source.state.get("found"):
        return ""
    frames, name = source.config.frames, source.name
    key = f"{name}.frame" if source.settings.frame else "frames.odom"
    has = ", ".join(f"{parent[:_LONGEST]} -> {child[:_LONGEST]}" for parent, child in source.state.get("similar", ()))
    return (
        f"no transform {source.settings.frame or frames.odom} -> {frames.base} has come{has and ', but '}{has}:"
        f" correct {key} or frames.base, or have it published"
    )


def _in_odom(source: InputContext, parent: str, child: str, position: Any, orientation: Any) -> Numbers:
    if parent == child:
        raise MessageError("frame_in_itself")
    T_parent_child, frames = source.placed(position, orientation), source.config.frames
    if parent == frames.odom and child == frames.base:
        return source.of_robot(T_parent_child)
    T_odom_parent = source.T_fixed(frames.odom, parent)
    T_child_base = se3.inverse(source.T_base_child(child))
    return source.of_robot(se3.compose(se3.compose(T_odom_parent, T_parent_child), T_child_base))


def _twist_covariance(source: InputContext, flat: Any) -> Numbers | None:
    """The covariance of a twist in the base frame; None if any part of it is unknown."""
    raw = flat.tobytes()
    if raw != source.state.get("raw"):  # drivers repeat the same one
        source.state.update(raw=raw, judged=_judged(source, np.asarray(flat, dtype=float).reshape(6, 6)))
    covariance, repairs = source.state["judged"]
    if isinstance(covariance, MessageError):
        raise covariance
    for repair in repairs:
        source.count(repair)
    return covariance


def _judged(source: InputContext, full: Any) -> tuple[Numbers | MessageError | None, list[str]]:
    block = source.block(full)
    if not block.any():
        return None, ["covariance_unknown"]
    variances = np.diag(block)
    if (variances >= UNUSED).any() or (source.space.dimensions == 3 and (variances == 0.0).any()):
        return None, ["covariance_of_some_axes_unknown"]
    try:
        covariance, repairs = checks.covariance(block, source.space.dimensions)
    except MessageError as reason:
        return reason, []
    return tuple(covariance.ravel().tolist()), repairs
