"""Messages that become odometry: absolute poses in a frame that drifts."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from graph_slam_ros.lie import se3
from graph_slam_ros.ros.inputs import checks
from graph_slam_ros.ros.inputs.checks import MessageError
from graph_slam_ros.ros.inputs.source import Numbers, Source
from graph_slam_ros.ros.transforms import pose
from graph_slam_ros.slam.measurements import Odometry

_UNUSED = 1e6  # [m^2/s^2, rad^2/s^2]: what drivers of wheels write for what these do not measure


def odometry(source: Source, m: Any) -> Iterator[Odometry]:
    """nav_msgs/Odometry."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    p, parent = m.pose.pose, source.frame(m.header.frame_id)
    at = _in_odom(source, parent, _named(source, m.child_frame_id), p.position, p.orientation)
    twist = None
    if source.config.odometry.noise == "twist" and m.child_frame_id.lstrip("/") == source.config.frames.base:
        twist = _twist_covariance(source, m.twist.covariance)  # that of another point of the robot says nothing
    yield Odometry(stamp_ns, at, twist, source.name)


def pose_stamped(source: Source, m: Any) -> Iterator[Odometry]:
    """geometry_msgs/PoseStamped and PoseWithCovarianceStamped: of the base, or of the configured mount."""
    stamp_ns = source.stamp_ns(m.header.stamp)
    p = m.pose.pose if hasattr(m.pose, "pose") else m.pose
    parent = source.frame(m.header.frame_id)
    yield Odometry(stamp_ns, _in_odom(source, parent, "", p.position, p.orientation), None, source.name)


def transforms(source: Source, m: Any) -> Iterator[Odometry]:
    """tf2_msgs/TFMessage: the transform from odometry's frame, or the one configured in its place, to the base."""
    frames = source.config.frames
    parent = source.settings.frame or frames.odom
    for t in m.transforms:
        child = t.child_frame_id.lstrip("/")
        if t.header.frame_id.lstrip("/") != parent or source.transforms.lookup(frames.base, child) is None:
            continue  # /tf tells of everything
        try:
            stamp_ns = source.stamp_ns(t.header.stamp)
            at = _in_odom(source, frames.odom, child, t.transform.translation, t.transform.rotation)
            yield Odometry(stamp_ns, at, None, source.name)
        except MessageError as reason:
            source.count(str(reason))


def _in_odom(source: Source, parent: str, child: str, position: Any, orientation: Any) -> Numbers:
    """T_odom_base from the pose of a child frame in its parent."""
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


def _named(source: Source, child: str) -> str:
    if child.startswith("/"):
        source.count("frame_slash_stripped")
        child = child[1:]
    if not child and not source.has_mount:
        raise MessageError("frame_empty")
    return child


def _twist_covariance(source: Source, flat: Any) -> Numbers | None:
    """Of a twist in the base frame; None where it is unknown, in part or altogether."""
    raw = flat.tobytes()
    if raw != source.state.get("raw"):  # drivers repeat the same one
        source.state.update(raw=raw, judged=_judged(source, np.asarray(flat, dtype=float).reshape(6, 6)))
    covariance, repairs = source.state["judged"]
    if isinstance(covariance, MessageError):
        raise covariance
    for repair in repairs:
        source.count(repair)
    return covariance


def _judged(source: Source, full: Any) -> tuple[Numbers | MessageError | None, list[str]]:
    block, variances = source.block(full), np.diag(full)
    if not block.any():
        return None, ["covariance_unknown"]
    if source.space.dimensions == 3 and ((variances == 0.0) | (variances >= _UNUSED)).any():
        return None, ["covariance_of_some_axes_unknown"]
    try:
        covariance, repairs = checks.covariance(block, source.space.dimensions)
    except MessageError as reason:
        return reason, []
    return tuple(covariance.ravel().tolist()), repairs
