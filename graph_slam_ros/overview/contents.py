"""A summary of a whole recording: the span and frames of each topic, and how it can be used."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.lie import so3
from graph_slam_ros.messages.from_msg import TRANSFORMS
from graph_slam_ros.messages.inputs import APRILTAGS, known_types
from graph_slam_ros.messages.inputs.detections import names_of
from graph_slam_ros.messages.receive_times import clock_offset_s
from graph_slam_ros.recordings.bag import Bag, BagError, Topic
from graph_slam_ros.recordings.definitions import recorded_decoder
from graph_slam_ros.typing import Numbers

_SAMPLED, _EVERY = 2000, 8  # the first messages of each topic; of odometry then every so many
_MOST_NAMES, _LAGS = 1000, 100  # lags: at least so many of a longer topic
_ITEMS = ("landmarks", "markers", "sensed_data", "detections", "poses")
_LEVEL_M, _UPRIGHT = 0.5, math.cos(math.radians(20.0))  # as for what is counted as out of the plane


@dataclass(slots=True)
class TopicContents:
    """The contents of one topic.

    Attributes
    ----------
    trouble : why its messages cannot be read; empty where they can
    first_ns, last_ns : of its messages, by the time they were received
    received_ns, lag_s : receive time, and that less the header stamp, of messages evenly over all that were read
    headers, every : headers so far; of so many one has its lag here
    is_stamped : whether any header has a stamp
    frame, child : of the first header that names them
    items, without_id : what its messages hold (detections, points, transforms), and how many of these have no identity
    ids, classes : identities and class ids that occur
    is_repeated : whether one message has a class id twice
    has_noise : whether the first message tells its covariance
    usable : messages that can be used at all: with a fix, with an orientation
    felt : sum of the accelerations of an IMU along its axes [m/s^2]
    path_m, off_plane : of odometry and poses: length of the path, and messages above, below or tilted against the first
    """

    topic: Topic
    trouble: str = ""
    first_ns: int = 0
    last_ns: int = 0
    read: int = 0
    skipped: int = 0
    received_ns: list[int] = field(default_factory=list)
    lag_s: list[float] = field(default_factory=list)
    headers: int = 0
    every: int = 1
    is_stamped: bool = False
    frame: str = ""
    child: str = ""
    items: int = 0
    without_id: int = 0
    ids: set[str] = field(default_factory=set)
    classes: set[str] = field(default_factory=set)
    fields: set[str] = field(default_factory=set)
    is_repeated: bool = False
    has_noise: bool = False
    usable: int = 0
    felt: Numbers = (0.0, 0.0, 0.0)
    path_m: float = 0.0
    off_plane: int = 0
    last_at: tuple[float, float, float] | None = None
    height_m: float = 0.0

    def add_lag(self, received_ns: int, stamp_ns: int) -> None:
        """Add the lag of a message, if it is its turn. A stamp of zero has none."""
        self.headers += 1
        if self.headers % self.every or not stamp_ns:
            return
        self.received_ns.append(received_ns)
        self.lag_s.append((received_ns - stamp_ns) * 1e-9)
        if len(self.lag_s) >= 2 * _LAGS:
            del self.received_ns[1::2], self.lag_s[1::2]
            self.every *= 2

    def clock_offset_s(self, other: "TopicContents") -> float:
        """Return what must be added to its stamps to have the clock of another topic [s]; 0 where that is not known."""
        return clock_offset_s(self.received_ns, self.lag_s, other.received_ns, other.lag_s)

    @property
    def is_zero(self) -> bool:
        """Return whether all its stamps are zero."""
        return self.headers > 0 and not self.is_stamped


@dataclass(slots=True)
class Recording:
    """The contents of a recording: of topics by name; parents of frames that move in them and that do not, by child."""

    topics: dict[str, TopicContents]
    moving: dict[str, str] = field(default_factory=dict)
    fixed: dict[str, str] = field(default_factory=dict)

    def is_linked(self, frame: str, base: str) -> bool:
        """Return whether TF has the pose of a frame on the robot."""
        links = self.fixed | {child: parent for child, parent in self.moving.items() if child != base}
        return root_of(links, frame) == root_of(links, base)

    def alike(self, frame: str, base: str) -> str:
        """Return the frame of TF that differs in slashes, blanks, capitals, or by the robot's prefix; empty if none."""
        known, prefixed = {*self.fixed, *self.fixed.values(), *self.moving}, f"{base.rpartition('/')[0]}{frame}"
        plain = {one: one.replace("/", "").strip().lower() for one in (frame, prefixed, *known)}
        wanted = (plain[frame], plain[prefixed])
        return next((one for one in sorted(known - {frame}) if frame and plain[one] in wanted), "")

    def moves_in(self, base: str, frame: str) -> bool:
        """Return whether TF has the moving pose of the robot in a frame."""
        links, seen = self.fixed | self.moving, set[str]()
        while base in links and base not in seen and base != frame:
            seen.add(base)
            base = links[base]
        return bool(seen) and base == frame


def root_of(links: Mapping[str, str], frame: str) -> str:
    """Return the frame that the tree of a frame begins with, given the parent of each."""
    seen = {frame}
    while frame in links and links[frame] not in seen:
        frame = links[frame]
        seen.add(frame)
    return frame


def recording_of(bag: Bag) -> Recording:
    """Read a recording once."""
    out = Recording({name: TopicContents(topic) for name, topic in bag.topics.items()})
    known, decoders = known_types(), dict[str, Callable[[bytes], Any]]()
    for name, one in out.topics.items():
        if one.topic.type in known:
            try:
                decoders[name] = recorded_decoder(one.topic)
            except (BagError, ConfigError) as error:
                one.trouble = str(error)
    for message in bag.messages(set(bag.topics)):
        one = out.topics[message.topic]
        one.first_ns = one.first_ns or message.log_ns
        one.last_ns = message.log_ns
        if message.topic not in decoders:
            continue
        if one.read >= _SAMPLED:
            one.skipped += 1
            if one.topic.type != "nav_msgs/msg/Odometry" or one.skipped % _EVERY:
                continue
        one.read += 1
        try:
            _add(out, one, decoders[message.topic](message.cdr), message.log_ns)
        except Exception:  # damaged bytes: replay counts them
            one.trouble = one.trouble if one.frame or one.items else "its messages cannot be decoded"
    return out


def _add(recording: Recording, one: TopicContents, m: Any, log_ns: int) -> None:
    if one.topic.type == TRANSFORMS:
        links = recording.fixed if one.topic.name.endswith("tf_static") else recording.moving
        links.update((_plain(t.child_frame_id), _plain(t.header.frame_id)) for t in m.transforms)
        one.items += len(m.transforms)
        return
    items = next((getattr(m, name) for name in _ITEMS if hasattr(m, name)), ())
    parts = [m, *items[:1], *(item.pose for item in items[:1] if hasattr(item, "pose"))]
    if headers := [part.header for part in parts if hasattr(part, "header")]:
        one.frame = one.frame or next(filter(None, (_plain(h.frame_id) for h in headers)), "")
        one.child = one.child or _plain(getattr(m, "child_frame_id", ""))
        stamp_ns = next(filter(None, (h.stamp.sec * 10**9 + h.stamp.nanosec for h in headers)), 0)
        one.is_stamped |= stamp_ns != 0
        one.add_lag(log_ns, stamp_ns)
    if one.topic.type in _OF_TYPE:
        _OF_TYPE[one.topic.type](one, m)
    else:  # landmarks of a package that may not be installed
        one.items += len(items)


def _plain(frame: str) -> str:
    return frame.removeprefix("/")


# -- by type -----------------------------------------------------------------------------------------------------------


def _odometry(one: TopicContents, m: Any) -> None:
    one.has_noise |= one.last_at is None and bool(m.twist.covariance.any())
    _moved(one, m.pose.pose)


def _moved(one: TopicContents, pose: Any) -> None:
    """The robot is at this pose."""
    p, q = pose.position, pose.orientation
    at = float(p.x), float(p.y), float(p.z)
    if one.last_at is None:
        one.height_m = at[2]
    else:
        step = math.dist(at, one.last_at)
        one.path_m += step if math.isfinite(step) else 0.0
    one.last_at = at
    up = so3.act((q.x, q.y, q.z, q.w), (0.0, 0.0, 1.0))[2]
    one.off_plane += abs(at[2] - one.height_m) > _LEVEL_M or up < _UPRIGHT


def _detections(one: TopicContents, m: Any) -> None:
    classes = [names_of(d)[1] for d in m.detections if len(d.results)]
    one.is_repeated |= len(set(classes)) < len(classes)
    for d in m.detections:
        one.items += 1
        name = names_of(d)[0]
        one.without_id += not name
        if name and len(one.ids) < _MOST_NAMES:
            one.ids.add(name)
    one.classes.update(filter(None, islice(classes, _MOST_NAMES - len(one.classes))))


def _cloud(one: TopicContents, m: Any) -> None:
    one.fields = one.fields or {f.name for f in m.fields}
    one.items += int(m.width * m.height)


def _fix(one: TopicContents, m: Any) -> None:
    has_fix = m.status.status >= 0 and math.isfinite(m.latitude) and (m.latitude, m.longitude) != (0.0, 0.0)
    if has_fix and not one.usable:
        one.has_noise = m.position_covariance_type != 0 and bool(m.position_covariance[:5:4].all())
    one.usable += has_fix


def _imu(one: TopicContents, m: Any) -> None:
    q, a = m.orientation, m.linear_acceleration
    one.felt = tuple(total + part for total, part in zip(one.felt, (a.x, a.y, a.z), strict=True))
    is_known = m.orientation_covariance[0] != -1.0 and math.hypot(q.x, q.y, q.z, q.w) > 0.5
    one.has_noise |= is_known and not one.usable and bool(m.orientation_covariance[8] > 0.0)
    one.usable += is_known


def _pose(one: TopicContents, m: Any) -> None:
    one.has_noise |= hasattr(m.pose, "covariance") and bool(m.pose.covariance[:8:7].all())
    _moved(one, m.pose.pose if hasattr(m.pose, "covariance") else m.pose)


def _apriltags(one: TopicContents, m: Any) -> None:
    one.items += len(m.detections)
    one.ids.update(f"{d.family}:{d.id}" for d in m.detections if len(one.ids) < _MOST_NAMES)


_OF_TYPE: dict[str, Callable[[TopicContents, Any], None]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "vision_msgs/msg/Detection3DArray": _detections,
    "sensor_msgs/msg/PointCloud2": _cloud,
    "sensor_msgs/msg/NavSatFix": _fix,
    "sensor_msgs/msg/Imu": _imu,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose,
    "geometry_msgs/msg/PoseStamped": _pose,
    APRILTAGS: _apriltags,
}
