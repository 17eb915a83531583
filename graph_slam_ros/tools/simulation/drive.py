"""A recording as decoded messages, for faults of drivers and clocks. It need not be a simulated one.

The topics are those of ``write_bag``, or the only one of their type. All other messages stay bytes.
"""

import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.formats.durable import replaced
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.from_msg import own_decoder
from graph_slam_ros.messages.to_msg import encode, time, transform
from graph_slam_ros.recordings.bag import BagWriter, open_bag
from graph_slam_ros.tools.simulation.bag import ODOMETRY_TOPIC, TRUE_LANDMARKS_TOPIC, TRUTH_TOPIC
from graph_slam_ros.tools.simulation.recording import LANDMARKS_TOPIC
from graph_slam_ros.typing import Array, Index

_ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
DETECTIONS, POINTS = "vision_msgs/msg/Detection3DArray", "sensor_msgs/msg/PointCloud2"
_DOUBLE = 8  # of sensor_msgs/PointField


class Message:
    """One message: its receive time, and its object, or its bytes if nothing changes it."""

    def __init__(self, topic: str, type_name: str, log_ns: int, content: Any) -> None:
        self.topic, self.type, self.log_ns, self.content = topic, type_name, log_ns, content

    @property
    def stamp_ns(self) -> int:
        """The stamp of its header, or of its first transform. Setting it sets all stamps of the message."""
        stamp = next(self._headers()).stamp
        return int(stamp.sec * NS + stamp.nanosec)

    @stamp_ns.setter
    def stamp_ns(self, stamp_ns: int) -> None:
        for header in self._headers():
            header.stamp = time(max(stamp_ns, 0))

    @property
    def frame(self) -> str:
        """The frame of its header."""
        return str(self.content.header.frame_id)

    @frame.setter
    def frame(self, frame: str) -> None:
        for header in self._headers():
            header.frame_id = frame

    def _headers(self) -> Iterator[Any]:
        parts = [getattr(self.content, name, ()) for name in ("detections", "transforms")]
        yield from (one.header for one in (self.content, *parts[0], *parts[1]) if hasattr(one, "header"))


class Drive:
    """The messages of a recording in the order recorded.

    Attributes
    ----------
    messages : all of them; faults change, drop and add some
    part_of_file : so much of the file is left by ``write``

    Raises
    ------
    GraphSlamError
        The recording has no odometry, or landmarks of a type that faults cannot be put into.
    """

    def __init__(self, path: Path | str) -> None:
        bag = open_bag(path)
        types = {name: topic.type for name, topic in bag.topics.items()}
        self.odometry_topic = _only(types, ODOMETRY_TOPIC, (_ODOMETRY,))
        self.landmarks_topic = _only(types, LANDMARKS_TOPIC, (DETECTIONS, POINTS))
        changed = {self.odometry_topic, self.landmarks_topic}
        decode = {name: own_decoder(types[name]) for name in changed}
        self.part_of_file = 1.0
        self.messages = [
            Message(m.topic, types[m.topic], m.log_ns, decode[m.topic](m.cdr) if m.topic in changed else m.cdr)
            for m in bag.messages(set(bag.topics))
        ]

    @property
    def odometry(self) -> list[Message]:
        """The messages of odometry."""
        return [m for m in self.messages if m.topic == self.odometry_topic]

    @property
    def landmarks(self) -> list[Message]:
        """The messages of landmarks that can be decoded."""
        return [m for m in self.messages if m.topic == self.landmarks_topic and not isinstance(m.content, bytes)]

    def decoded(self, types: Collection[str]) -> list[Message]:
        """The messages of some types, decoded, without those of the truth and landmarks that cannot be."""
        others = {TRUTH_TOPIC, TRUE_LANDMARKS_TOPIC, self.landmarks_topic}
        found = [*self.landmarks] if {DETECTIONS, POINTS} & {*types} else []
        found += [m for m in self.messages if m.type in types and m.topic not in others]
        decode = {name: own_decoder(name) for name in {m.type for m in found if isinstance(m.content, bytes)}}
        for m in found:
            if isinstance(m.content, bytes):
                m.content = decode[m.type](m.content)
        return found

    @property
    def poses(self) -> Array:
        """(n, 7) Poses of odometry."""
        rows = []
        for m in self.odometry:
            p, q = m.content.pose.pose.position, m.content.pose.pose.orientation
            rows.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        return np.array(rows)

    @poses.setter
    def poses(self, poses: Array) -> None:
        for m, row in zip(self.odometry, poses.tolist(), strict=True):
            p, q = m.content.pose.pose.position, m.content.pose.pose.orientation
            (p.x, p.y, p.z, q.x, q.y, q.z, q.w) = row

    @property
    def twists(self) -> Array:
        """(n, 6) Velocities of odometry, linear and angular."""
        both = [(m.content.twist.twist.linear, m.content.twist.twist.angular) for m in self.odometry]
        return np.array([(v.x, v.y, v.z, w.x, w.y, w.z) for v, w in both])

    @twists.setter
    def twists(self, twists: Array) -> None:
        for m, row in zip(self.odometry, twists.tolist(), strict=True):
            v, w = m.content.twist.twist.linear, m.content.twist.twist.angular
            (v.x, v.y, v.z, w.x, w.y, w.z) = row

    @property
    def odometry_ns(self) -> Index:
        """(n,) Stamps of odometry."""
        return np.array([m.stamp_ns for m in self.odometry], dtype=np.int64)

    def restamp(self, messages: list[Message], change: Callable[[Index], Index]) -> None:
        """Change the stamps of some messages."""
        stamps_ns = change(np.array([m.stamp_ns for m in messages], dtype=np.int64))
        for m, stamp_ns in zip(messages, stamps_ns.tolist(), strict=True):
            m.stamp_ns = stamp_ns

    def drop(self, messages: list[Message]) -> None:
        """Remove some messages."""
        out = set(map(id, messages))
        self.messages = [m for m in self.messages if id(m) not in out]

    def add_transform(self, parent: str, child: str, pose: se3.Pose) -> None:
        """Add a message on /tf_static, recorded first."""
        first_ns = self.messages[0].log_ns
        content = transform(first_ns, parent, child, pose)
        self.messages.insert(0, Message("/tf_static", TRANSFORMS, first_ns, content))

    def write(self, path: Path | str) -> None:
        """Write the recording as mcap, completely or not at all."""
        with replaced(Path(path)) as new:
            with BagWriter(new) as bag:
                for m in self.messages:
                    content = m.content if isinstance(m.content, bytes) else encode(m.content)
                    bag.write(m.topic, m.type, m.log_ns, content)
            if self.part_of_file < 1.0:
                os.truncate(new, int(self.part_of_file * Path(new).stat().st_size))


def _only(types: dict[str, str], usual: str, wanted: tuple[str, ...]) -> str:
    found = [name for name, type_name in types.items() if type_name in wanted]
    if usual in found or len(found) == 1:
        return usual if usual in found else found[0]
    raise GraphSlamError(f"faults are put into {usual}, or the only topic of {' or '.join(wanted)}: there are {found}")


class Sightings:
    """The landmarks in one message, whatever its type.

    Attributes
    ----------
    stamp_ns : of the message
    ids : of each, as text
    points : (k, 3) in the frame of the message; of ranges and bearings as far as they say
    """

    def __init__(self, message: Message) -> None:
        self._content, self._is_cloud = message.content, message.type == POINTS
        self.stamp_ns = message.stamp_ns
        if not self._is_cloud:
            self.ids = [one.id for one in self._content.detections]
            at = [_pose(one).position for one in self._content.detections]
            self.points = np.array([(p.x, p.y, p.z) for p in at]).reshape(-1, 3)
            return
        names = [f.name for f in self._content.fields]
        if any(f.datatype != _DOUBLE for f in self._content.fields) or not (
            "id" in names and {"range", "bearing"} & set(names)
        ):
            raise GraphSlamError("faults need points with an id and a range or a bearing, as doubles")
        self._rows = np.frombuffer(self._content.data.tobytes(), dtype="<f8").reshape(-1, len(names)).copy()
        self._column = {name: self._rows[:, k] for k, name in enumerate(names)}
        self.ids = [str(int(number)) for number in self._column["id"]]
        none = np.zeros(len(self._rows))
        r, b, up = (self._column.get(*of) for of in (("range", none + 1.0), ("bearing", none), ("elevation", none)))
        self.points = np.stack([r * np.cos(up) * np.cos(b), r * np.cos(up) * np.sin(b), r * np.sin(up)], axis=1)

    @property
    def sigmas(self) -> Array:
        """The standard deviation (k,) of the position along x, or of what is measured first."""
        if self._is_cloud:
            return np.array(self._column["sigma"])
        return np.array([max(float(one.results[0].pose.covariance[0]), 0.0) ** 0.5 for one in self._content.detections])

    def scale_bearings(self, factor: float) -> None:
        """Multiply bearings, also beyond half a turn."""
        bearings = {"bearing", "elevation"} & self._column.keys() if self._is_cloud else ()
        if not bearings:
            raise GraphSlamError("the landmarks of this recording have no bearings")
        for name in bearings:
            self._column[name][:] *= factor
        self._content.data = self._rows.ravel().view(np.uint8)

    def set_noise(self, sigma: float) -> None:
        """Set the standard deviations of everything [m, rad]."""
        if self._is_cloud:
            for name in (name for name in self._column if name.startswith("sigma")):
                self._column[name][:] = sigma
            self._content.data = self._rows.ravel().view(np.uint8)
            return
        for one in self._content.detections:
            for result in one.results:
                result.pose.covariance = (sigma**2 * np.eye(6)).ravel()

    def turn(self, by: Array) -> None:
        """Turn points and orientations by an orthogonal matrix (3, 3)."""
        self.points = self.points @ by.T
        for one in self._content.detections if not self._is_cloud else ():
            q, matrix = _pose(one).orientation, np.eye(4)
            matrix[:3, :3] = by @ se3.to_matrix((0, 0, 0, q.x, q.y, q.z, q.w))[:3, :3]
            if np.linalg.det(by) < 0.0:
                matrix[:3, 1] *= -1.0  # what is mirrored stays a rotation
            q.x, q.y, q.z, q.w = map(float, se3.from_matrix(matrix)[3:])

    def store(self) -> None:
        """Write ids and points back."""
        if self._is_cloud:
            x, y, z = self.points.T
            self._column["id"][:] = [float(name) for name in self.ids]
            if "range" in self._column:
                self._column["range"][:] = np.sqrt(x**2 + y**2 + (z**2 if "elevation" in self._column else 0.0))
            if "bearing" in self._column:
                self._column["bearing"][:] = np.arctan2(y, x)
            if "elevation" in self._column:
                self._column["elevation"][:] = np.arctan2(z, np.hypot(x, y))
            self._content.data = self._rows.ravel().view(np.uint8)
            return
        for one, name, at in zip(self._content.detections, self.ids, self.points.tolist(), strict=True):
            one.id = name
            for p in (_pose(one).position, one.bbox.center.position):
                p.x, p.y, p.z = at
            for result in one.results:
                result.hypothesis.class_id = name


def _pose(detection: Any) -> Any:
    return detection.results[0].pose.pose if len(detection.results) else detection.bbox.center
