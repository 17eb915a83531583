"""Results to messages, as CDR bytes: the node publishes them as they are, replay and simulation write them into bags.

A pose is (x, y, theta) or (x, y, z, qx, qy, qz, qw) throughout, its covariance (3, 3) or (6, 6). One encoder for all,
rosbags' type store, so nothing here needs ROS. A path is written with NumPy: 10,000 poses as
message objects would cost a tenth of a second each time.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.formats.cdr import LATEST_NS, NS, CdrWriter
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.typing import Array, Numbers

UNKNOWN = 1e6  # variance [m^2, rad^2] of what is not known at all
UNUSED = 0.25  # variance of z, roll and pitch of a pose in the plane; RViz draws those of 1e6 a kilometre large
_IN_PLANE = np.array([0, 1, 5, 6, 7, 11, 30, 31, 35])  # of the 36 numbers: x, y and yaw
_OUT_OF_PLANE = np.array([14, 21, 28])  # the variances of z, roll and pitch
_UNKNOWN_TWIST = np.concatenate((np.zeros(6), UNKNOWN * np.eye(6).ravel())).tobytes()


def encode(message: Any) -> bytes:
    """CDR bytes of a message object of rosbags' type store."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def make(name: str, /, **fields: Any) -> Any:
    """A message object, ``make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.0)``."""
    return typestore().types[name](**fields)


def time(stamp_ns: int) -> Any:
    """builtin_interfaces/Time; later stamps become the largest that it can represent."""
    sec, nanosec = divmod(min(int(stamp_ns), LATEST_NS), NS)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return make("std_msgs/msg/Header", stamp=time(stamp_ns), frame_id=frame)


def point(x: float, y: float, z: float = 0.0) -> Any:
    """geometry_msgs/Point."""
    return make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))


def vector(x: float, y: float, z: float = 0.0) -> Any:
    """geometry_msgs/Vector3."""
    return make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))


def quaternion(x: float, y: float, z: float, w: float) -> Any:
    """geometry_msgs/Quaternion."""
    return make("geometry_msgs/msg/Quaternion", x=float(x), y=float(y), z=float(z), w=float(w))


def pose(p: ArrayLike) -> Any:
    """geometry_msgs/Pose."""
    x, y, z, *quat_xyzw = se3.in_space(p).tolist()
    return make("geometry_msgs/msg/Pose", position=point(x, y, z), orientation=quaternion(*quat_xyzw))


def covariance6(covariance: Array, unused: float) -> Array:
    """ROS's row-major 6x6, from (6, 6), or from (3, 3) over (x, y, yaw) with the variance ``unused`` for the rest."""
    if len(covariance) == 6:
        return np.ravel(covariance)
    full = np.zeros(36)
    full[_IN_PLANE], full[_OUT_OF_PLANE] = np.ravel(covariance), unused
    return full


def pose_with_covariance(p: Numbers, covariance: Array, unused: float) -> Any:
    """geometry_msgs/PoseWithCovariance, in the axes of the parent frame, from a covariance in the pose's tangent space.

    In the plane z, roll and pitch get the variance ``unused``.
    """
    space = PLANAR if len(p) == 3 else SPATIAL
    full = covariance6(space.in_parent_axes(p, covariance), unused)
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose(p), covariance=full)


def pose_stamped(stamp_ns: int, frame: str, p: Numbers) -> bytes:
    """geometry_msgs/PoseStamped."""
    return encode(make("geometry_msgs/msg/PoseStamped", header=header(stamp_ns, frame), pose=pose(p)))


def pose_with_covariance_stamped(stamp_ns: int, frame: str, p: Numbers, covariance: Array, unused: float) -> bytes:
    """geometry_msgs/PoseWithCovarianceStamped; see ``pose_with_covariance``. It is fast, as ``odometry`` is."""
    out = CdrWriter()
    out.header(stamp_ns, frame)
    _add_pose(out, p, covariance, unused)
    return out.message()


def transform(stamp_ns: int, parent: str, child: str, T_parent_child: Numbers) -> bytes:
    """tf2_msgs/TFMessage with one transform. It is fast, because it is sent with every odometry message."""
    out = CdrWriter()
    out.numbers("I", 1)
    out.header(stamp_ns, parent)
    out.text(child)
    out.array(se3.in_space(T_parent_child))
    return out.message()


def odometry(
    stamp_ns: int, frame: str, child: str, p: Numbers, covariance: Array, unused: float, twist: bytes | None = None
) -> bytes:
    """nav_msgs/Odometry. It is fast, because it is sent with every odometry message.

    Parameters
    ----------
    covariance : of the pose, in its tangent space
    unused : variance of what a pose in the plane does not have
    twist : geometry_msgs/TwistWithCovariance as ``from_msg.twist_of`` gives it
    """
    out = CdrWriter()
    out.header(stamp_ns, frame)
    out.text(child)
    _add_pose(out, p, covariance, unused)
    return out.message() + (_UNKNOWN_TWIST if twist is None else twist)


def _add_pose(out: CdrWriter, p: Numbers, covariance: Array, unused: float) -> None:
    """geometry_msgs/PoseWithCovariance, as ``pose_with_covariance`` makes it."""
    space = PLANAR if len(p) == 3 else SPATIAL
    out.array(se3.in_space(p))
    out.array(covariance6(space.in_parent_axes(p, covariance), unused))


OK, WARN, ERROR, STALE = range(4)


@dataclass(frozen=True, slots=True)
class Status:
    """diagnostic_msgs/DiagnosticStatus: ``level`` is one of ``OK``, ``WARN``, ``ERROR``, ``STALE``."""

    level: int
    name: str
    message: str = ""
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=dict)


def diagnostics(stamp_ns: int, statuses: Iterable[Status]) -> bytes:
    """diagnostic_msgs/DiagnosticArray, without a frame."""
    head, listed = header(stamp_ns, ""), [_status(one) for one in statuses]
    return encode(make("diagnostic_msgs/msg/DiagnosticArray", header=head, status=listed))


def _status(one: Status) -> Any:
    kind, pair = "diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/KeyValue"
    values = [make(pair, key=key, value=value) for key, value in one.values.items()]
    return make(kind, level=one.level, name=one.name, message=one.message, hardware_id=one.hardware_id, values=values)


def clock(stamp_ns: int) -> bytes:
    """rosgraph_msgs/Clock."""
    return encode(make("rosgraph_msgs/msg/Clock", clock=time(stamp_ns)))


def path(frame: str, stamps_ns: ArrayLike, poses: Array, newest_ns: int | None = None) -> bytes:
    """nav_msgs/Path of poses (n, 3) or (n, 7) and their stamps (n,). Its header has the newest stamp, the last one.

    All poses after the first take the same number of bytes. The first has its own padding.
    """
    stamps, name = np.asarray(stamps_ns, dtype=np.int64), frame.encode() + b"\x00"
    if newest_ns is None:
        newest_ns = int(stamps[-1]) if len(stamps) else 0
    out = CdrWriter()
    out.header(newest_ns, frame)
    out.numbers("I", len(stamps))
    for stamp_ns, pose in zip(stamps[:1], poses, strict=False):
        out.header(int(stamp_ns), frame)
        out.array(se3.in_space(pose))
    numbers = [("sec", "<i4"), ("nanosec", "<u4"), ("length", "<u4")]
    text = [("frame", f"S{len(name)}"), ("padding", f"V{-(12 + len(name)) % 8}")]
    rows = np.zeros(max(0, len(stamps) - 1), dtype=[*numbers, *text, ("values", "<f8", 7)])
    rows["sec"], rows["nanosec"] = np.divmod(stamps[1:], NS)
    rows["length"], rows["frame"] = len(name), name
    if len(rows):
        rows["values"] = se3.in_space(poses[1:])
    return b"".join((out.message(), rows.view(np.uint8).data))  # a megabyte, copied once


def detections(stamp_ns: int, frame: str, names: Sequence[str], poses: Array, covariances: Array) -> bytes:
    """vision_msgs/Detection3DArray: detected or known objects by id, each with one hypothesis without a class.

    Parameters
    ----------
    poses : (n, 7); covariances : (n, 6, 6) in the axes of ``frame``
    """
    certain, size = np.ones((len(names), 1)), np.zeros((len(names), 3))
    rows = np.concatenate((certain, poses, covariances.reshape(-1, 36), poses, size), axis=1)
    out = CdrWriter()
    out.header(stamp_ns, frame)
    out.numbers("I", len(names))
    for name, row in zip(names, rows, strict=True):
        out.header(stamp_ns, frame)
        out.numbers("I", 1)  # hypothesis
        out.text("")
        out.array(row)  # its score, pose and covariance; centre and size of the box
        out.text(name)
    return out.message()
