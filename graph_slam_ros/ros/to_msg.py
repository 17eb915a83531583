"""Results to messages, as CDR bytes: the node publishes them as they are, replay and simulation write them into bags.

One encoder for all, rosbags' type store, so nothing here needs ROS. A path is written with NumPy: 10,000 poses as
message objects would cost a tenth of a second each time.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.ros.interfaces import typestore

Array = NDArray[np.float64]

_NS = 1_000_000_000
_HEADER = b"\x00\x01\x00\x00"  # CDR, little endian


def encode(message: Any) -> bytes:
    """CDR bytes of a message object of rosbags' type store."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def make(name: str, **fields: Any) -> Any:
    """A message object, ``make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.0)``."""
    return typestore().types[name](**fields)


def time(stamp_ns: int) -> Any:
    """builtin_interfaces/Time."""
    return make("builtin_interfaces/msg/Time", sec=int(stamp_ns // _NS), nanosec=int(stamp_ns % _NS))


def header(stamp_ns: int, frame: str) -> Any:
    """std_msgs/Header."""
    return make("std_msgs/msg/Header", stamp=time(stamp_ns), frame_id=frame)


def point(x: float, y: float, z: float = 0.0) -> Any:
    """geometry_msgs/Point."""
    return make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))


def vector(x: float, y: float, z: float = 0.0) -> Any:
    """geometry_msgs/Vector3."""
    return make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))


def heading(theta: float) -> Any:
    """geometry_msgs/Quaternion of a rotation about z."""
    w, z = float(np.cos(0.5 * theta)), float(np.sin(0.5 * theta))
    return make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)


def pose(p: se2.Pose) -> Any:
    """geometry_msgs/Pose."""
    return make("geometry_msgs/msg/Pose", position=point(p[0], p[1]), orientation=heading(p[2]))


def covariance6(planar: Array, unused: float) -> Array:
    """(3, 3) over (x, y, yaw) in ROS's row-major 6x6; z, roll and pitch get the variance ``unused``."""
    full = np.diag([0.0, 0.0, unused, unused, unused, 0.0])
    full[np.ix_([0, 1, 5], [0, 1, 5])] = planar
    return full.ravel()


def in_parent_axes(p: se2.Pose, covariance: Array) -> Array:
    """Tangent-space covariance (3, 3) of a pose turned into the axes of its parent frame, as ROS publishes it."""
    c, s = np.cos(p[2]), np.sin(p[2])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T


def pose_stamped(stamp_ns: int, frame: str, p: se2.Pose) -> bytes:
    """geometry_msgs/PoseStamped."""
    return encode(make("geometry_msgs/msg/PoseStamped", header=header(stamp_ns, frame), pose=pose(p)))


def pose_with_covariance(stamp_ns: int, frame: str, p: se2.Pose, covariance: Array, unused: float) -> bytes:
    """geometry_msgs/PoseWithCovarianceStamped from a tangent-space covariance (3, 3)."""
    full = covariance6(in_parent_axes(p, covariance), unused)
    inner = make("geometry_msgs/msg/PoseWithCovariance", pose=pose(p), covariance=full)
    return encode(make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header(stamp_ns, frame), pose=inner))


def transform(stamp_ns: int, parent: str, child: str, T_parent_child: se2.Pose) -> bytes:
    """tf2_msgs/TFMessage with one transform."""
    x, y, theta = T_parent_child
    moved = make("geometry_msgs/msg/Transform", translation=vector(x, y), rotation=heading(theta))
    stamped = make(
        "geometry_msgs/msg/TransformStamped", header=header(stamp_ns, parent), child_frame_id=child, transform=moved
    )
    return encode(make("tf2_msgs/msg/TFMessage", transforms=[stamped]))


def clock(stamp_ns: int) -> bytes:
    """rosgraph_msgs/Clock."""
    return encode(make("rosgraph_msgs/msg/Clock", clock=time(stamp_ns)))


def path(frame: str, stamps_ns: ArrayLike, poses: Array) -> bytes:
    """nav_msgs/Path of poses (n, 3) and their stamps (n,); its header carries the newest stamp.

    All poses after the first take the same number of bytes; the first is preceded by its own padding.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    name = frame.encode() + b"\x00"
    head = _stamp(int(stamps[-1]) if len(stamps) else 0) + np.uint32(len(name)).tobytes() + name
    head += b"\x00" * (-len(head) % 4) + np.uint32(len(stamps)).tobytes()
    if not len(stamps):
        return _HEADER + head
    first, others = _pose_rows(name, stamps[:1], poses[:1], len(head)), _pose_rows(name, stamps[1:], poses[1:], 0)
    return b"".join((_HEADER, head, first.data, others.data))  # a megabyte, copied once


def _stamp(stamp_ns: int) -> bytes:
    return np.int32(stamp_ns // _NS).tobytes() + np.uint32(stamp_ns % _NS).tobytes()


def _pose_rows(name: bytes, stamps: NDArray[np.int64], poses: Array, start: int) -> NDArray[np.uint8]:
    """PoseStamped rows, as bytes, that begin at a multiple of 8 plus ``start`` from the head of the message."""
    text = 12 + len(name)
    row = np.dtype(
        [
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("length", "<u4"),
            ("frame", f"S{len(name)}"),
            ("padding", f"V{-(start + text) % 8}"),
            ("values", "<f8", 7),
        ]
    )
    rows = np.zeros(len(stamps), dtype=row)
    rows["sec"], rows["nanosec"] = np.divmod(stamps, _NS)
    rows["length"], rows["frame"] = len(name), name
    half = 0.5 * poses[:, 2]
    rows["values"][:, :2] = poses[:, :2]
    rows["values"][:, 5], rows["values"][:, 6] = np.sin(half), np.cos(half)
    return rows.view(np.uint8)


def landmark_markers(
    stamp_ns: int, frame: str, names: Sequence[str], positions: Array, covariances: Sequence[Array]
) -> bytes:
    """visualization_msgs/MarkerArray: all former markers deleted, then an ellipse (2 sigma) and a name each.

    Parameters
    ----------
    positions : (n, 2); covariances : n of (2, 2), both in ``frame``
    """
    markers = [_marker(stamp_ns, frame, "", 0, action=3)]
    for k, (name, position, covariance) in enumerate(zip(names, positions.tolist(), covariances, strict=True)):
        known = np.isfinite(covariance).all()
        variances, axes = np.linalg.eigh(covariance if known else np.zeros((2, 2)))
        size = np.maximum(4.0 * np.sqrt(np.maximum(variances, 0.0)), 0.05)
        tilt = float(np.arctan2(axes[1, 0], axes[0, 0]))
        at = (position[0], position[1], tilt)
        markers.append(_marker(stamp_ns, frame, "landmarks", k, type_=3, at=at, scale=(size[0], size[1], 0.05)))
        markers.append(_marker(stamp_ns, frame, "names", k, type_=9, at=at, scale=(0.0, 0.0, 0.25), text=name))
    return encode(make("visualization_msgs/msg/MarkerArray", markers=markers))


def _marker(
    stamp_ns: int,
    frame: str,
    namespace: str,
    number: int,
    *,
    action: int = 0,
    type_: int = 0,
    at: se2.Pose = se2.IDENTITY,
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
    text: str = "",
) -> Any:
    zero = make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    return make(
        "visualization_msgs/msg/Marker",
        header=header(stamp_ns, frame),
        ns=namespace,
        id=number,
        type=type_,
        action=action,
        pose=pose(at),
        scale=vector(*scale),
        color=make("std_msgs/msg/ColorRGBA", r=0.9, g=0.5, b=0.1, a=0.8),
        lifetime=zero,
        frame_locked=False,
        points=[],
        colors=[],
        texture_resource="",
        texture=make("sensor_msgs/msg/CompressedImage", header=header(0, ""), format="", data=np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text=text,
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
