"""Messages that become odometry: absolute poses in a frame that drifts, and the turn rate of a gyro."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from graph_slam_ros.lie import se3, so3
from graph_slam_ros.measurements.types import AngularVelocity, Odometry
from graph_slam_ros.messages.inputs import checks
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.odometry_bytes import OdometryRun
from graph_slam_ros.messages.inputs.source import InputContext
from graph_slam_ros.messages.inputs.transforms import pose
from graph_slam_ros.typing import Numbers

TYPE = "nav_msgs/msg/Odometry"
_MOST_SIMILAR, _LONGEST = 3, 80  # transforms that are named, and letters of a frame's name
_SLASHED = ("/", "")
UNUSED = 1e6  # [m^2/s^2, rad^2/s^2]: what drivers of wheels write for what these do not measure


def odometry(source: InputContext, m: Any) -> Iterator[Odometry]:
    """nav_msgs/Odometry, decoded; ``of_run`` does the same for many at once."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    p, parent = m.pose.pose, source.frame(m.header.frame_id)
    at = _in_odom(source, parent, _named(source, m.child_frame_id), p.position, p.orientation)
    twist = None
    if source.config.odometry.noise == "twist" and m.child_frame_id.lstrip("/") == source.config.frames.base:
        twist = _twist_covariance(source, m.twist.covariance)  # that of another point of the robot says nothing
    yield Odometry(stamp_ns, at, twist, source.name)


@np.errstate(all="ignore")  # of strange numbers, which are decoded and refused by name
def of_run(source: InputContext, read: OdometryRun, after_ns: int) -> list[Odometry]:
    """The odometry of the first messages of a run, as far as stamps ascend, and nothing is refused or repaired.

    Only their covariance may be repaired, which is for ``count_repairs``.

    Parameters
    ----------
    after_ns : a stamp that the first is later than
    """
    if not _is_of_base(source, read) or not _is_judged(source, read.twist_covariance):
        return []
    numbers, stamps = read.numbers[:, :7], source.valid_stamps_ns(read.sec, read.nanosec)
    are_sound = checks.are_sound(*numbers[:, :3].T) & checks.are_units(*numbers[:, 3:].T)
    poses = source.of_robots_in_plane(numbers, are_sound & (np.diff(stamps, prepend=after_ns) > 0))
    twist = source.state["judged"][0] if source.config.odometry.noise == "twist" else None
    return [Odometry(stamp, at, twist, source.name) for stamp, at in zip(stamps.tolist(), poses, strict=False)]


def _is_of_base(source: InputContext, read: OdometryRun) -> bool:
    """Return whether messages are of the base in odometry's frame, by names that need no change."""
    frames, parent, child = source.config.frames, source.settings.frame or read.frame_id, read.child_frame_id
    is_of_base = parent == frames.odom and child == frames.base and parent != child
    return is_of_base and child[:1] not in _SLASHED and parent[:1] != "/"


def _is_judged(source: InputContext, raw: bytes) -> bool:
    """Return whether the twist's covariance is not needed, or was accepted before; else the decoded message tells."""
    if source.config.odometry.noise != "twist":
        return True
    return raw == source.state.get("raw") and not isinstance(source.state["judged"][0], MessageError)


def count_repairs(source: InputContext, times: int) -> None:
    """Count the repairs of that covariance for so many messages."""
    for repair in source.state["judged"][1] if source.config.odometry.noise == "twist" else ():
        source.count(repair, times)


def pose_stamped(source: InputContext, m: Any) -> Iterator[Odometry]:
    """geometry_msgs/PoseStamped and PoseWithCovarianceStamped: of the base, or of the configured mount."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    p = m.pose.pose if hasattr(m.pose, "pose") else m.pose
    parent = source.frame(m.header.frame_id)
    yield Odometry(stamp_ns, _in_odom(source, parent, "", p.position, p.orientation), None, source.name)


def transforms(source: InputContext, m: Any) -> Iterator[Odometry]:
    """tf2_msgs/TFMessage: the transform from odometry's frame, or from the configured one, to the base."""
    frames = source.config.frames
    parent = source.settings.frame or frames.odom
    for t in m.transforms:
        above, child = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
        is_of_robot = source.transforms.lookup(frames.base, child) is not None
        if above != parent or not is_of_robot:
            _note_similar(source, above, child, is_similar=above == parent or (is_of_robot and above != frames.map))
            continue  # /tf tells of everything
        source.state["found"] = True
        try:
            stamp_ns = source.stamp_ns(t.header.stamp)
            at = _in_odom(source, frames.odom, child, t.transform.translation, t.transform.rotation)
            yield Odometry(stamp_ns, at, None, source.name)
        except MessageError as reason:
            source.count(str(reason))


def _note_similar(source: InputContext, parent: str, child: str, *, is_similar: bool) -> None:
    similar: dict[tuple[str, str], None] = source.state.setdefault("similar", {})
    if is_similar and len(similar) < _MOST_SIMILAR and not source.state.get("found"):
        similar[parent, child] = None


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
    checks.point(position)
    q = source.unit(orientation)
    frames = source.config.frames
    if parent == frames.odom and child == frames.base:
        return source.of_robot(pose(position, q))
    T_odom_parent = source.T_fixed(frames.odom, parent)
    T_child_base = se3.inverse(source.T_base_child(child))
    return source.of_robot(se3.compose(se3.compose(T_odom_parent, pose(position, q)), T_child_base))


def _named(source: InputContext, child: str) -> str:
    if child.startswith("/"):
        source.count("frame_slash_stripped")
        child = child[1:]
    if not child and not source.settings.mount:
        raise MessageError("frame_empty")
    return child


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
