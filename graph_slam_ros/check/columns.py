"""A recording as columns of numbers, collected in one pass over its messages.

A ``Collector`` gets each decoded message, and the measurements that the converters of a replay make of it. It returns
``Columns``. Each check is a function of ``Columns`` alone.
"""

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graph_slam_ros.check.located import mount_corrections
from graph_slam_ros.check.sightings import MOST, SightingCollector, SightingColumns, index
from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import ASSUMED, InputConfig
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import AngularVelocity, Control, Fix, Measured, Odometry, Sightings
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, OwnDecoder
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.inputs.detections import names_of
from graph_slam_ros.messages.inputs.odometry_bytes import OdometryBytes, OdometryRun
from graph_slam_ros.messages.inputs.transforms import Transforms, assumed_mount, pose
from graph_slam_ros.typing import Array, Index, Mask

_TWIST, _COLUMNS = (0, 7, 14, 21, 28, 35), 19  # places in a covariance; numbers of a message
Decoder = Callable[[bytes], Any]


@dataclass(frozen=True, slots=True, eq=False)
class TopicColumns:
    """The messages of one topic.

    Attributes
    ----------
    use : of its first input: odometry, landmarks, fix, closure; empty of transforms
    log_ns, stamp_ns : (n,) when recorded, and the stamp of the header with the input's ``offset_s``
    frames : how many messages name each frame
    """

    name: str
    type: str
    inputs: tuple[str, ...]
    use: str
    log_ns: Index
    stamp_ns: Index
    frames: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class OdometryColumns:
    """The odometry that is used, as its messages have it.

    Attributes
    ----------
    poses : (n, 7) of ``child`` in ``frame``
    twist, variances : (n, 6) of the message; NaN where its type has none
    """

    input: str
    topic: str
    frame: str
    child: str
    stamp_ns: Index
    poses: Array
    twist: Array
    variances: Array

    def some(self, which: Mask) -> "OdometryColumns":
        """Return the columns of some of the messages."""
        rows = (self.stamp_ns[which], self.poses[which], self.twist[which], self.variances[which])
        return OdometryColumns(self.input, self.topic, self.frame, self.child, *rows)


@dataclass(frozen=True, slots=True, eq=False)
class FixColumns:
    """The fixes of one input, as a replay uses them.

    Attributes
    ----------
    points, headings : (k,) of the plane, as complex numbers [m], and [rad]; NaN where there is none
    sigma_m : the median standard deviation of the points
    frame, T_base_frame : of a heading: its frame, and where that is on the robot
    """

    input: str
    topic: str
    stamp_ns: Index
    points: Array
    headings: Array
    sigma_m: float
    frame: str
    T_base_frame: se3.Pose


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A transform from a parent to a child frame, from /tf_static (``fixed``) or /tf."""

    parent: str
    child: str
    fixed: bool


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The whole recording.

    Attributes
    ----------
    assumed : parameters that were chosen for the recording, and that nobody has set
    path_ns, path : (m,) and (m, 7) T_odom_base, as a replay uses odometry
    gyro_ns, gyro : (g,) stamps and turn rate about the robot's z [rad/s] of the gyro that is used
    felt : (g, 6) turn rates [rad/s] and accelerations [m/s^2] about and along the axes of its sensor
    gyro_frame, T_base_gyro : its frame, and where that is on the robot; None where it is not fixed or not known
    """

    config: Config
    topics: Mapping[str, TopicColumns]
    odometry: OdometryColumns
    path_ns: Index
    path: Array
    sightings: tuple[SightingColumns, ...]
    links: tuple[Link, ...]
    counters: Counters
    assumed: Mapping[str, Any] = field(default_factory=dict)
    gyro_ns: Index = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    gyro: Array = field(default_factory=lambda: np.empty(0))
    felt: Array = field(default_factory=lambda: np.empty((0, 6)))
    gyro_frame: str = ""
    T_base_gyro: se3.Pose | None = None
    fixes: tuple[FixColumns, ...] = ()

    def topic_of(self, source: str) -> TopicColumns | None:
        """The topic of an input; None where nothing was collected of it."""
        return next((topic for topic in self.topics.values() if source in topic.inputs), None)


class _Topic:
    def __init__(self, name: str, type_name: str, inputs: tuple[str, ...], use: str, offset_ns: int) -> None:
        self.name, self.type, self.inputs, self.use, self.offset_ns = name, type_name, inputs, use, offset_ns
        self.begin_anew()

    def begin_anew(self) -> None:
        self.log_ns, self.stamp_ns = array("q"), array("q")
        self.frames: dict[str, int] = {}

    def add(self, log_ns: int, message: Any) -> None:
        header = getattr(message, "header", None)
        if header is not None:
            self.add_stamps([log_ns], [header.stamp.sec * 1_000_000_000 + header.stamp.nanosec], header.frame_id)

    def add_stamps(self, log_ns: Sequence[int], stamps_ns: Sequence[int], frame: str) -> None:
        if room := min(len(log_ns), MOST - len(self.log_ns)):
            self.log_ns.extend(log_ns[:room])
            self.stamp_ns.extend([stamp_ns + self.offset_ns if stamp_ns else 0 for stamp_ns in stamps_ns[:room]])
            self.frames[frame] = self.frames.get(frame, 0) + room

    def columns(self) -> TopicColumns:
        return TopicColumns(
            self.name, self.type, self.inputs, self.use, index(self.log_ns), index(self.stamp_ns), self.frames
        )


class Collector:
    """Collects the columns of a recording while its messages are converted.

    Parameters
    ----------
    topics : of each input by its name, with ``tf_static`` and ``tf``
    assumed : parameters that were chosen for the recording
    """

    def __init__(self, config: Config, topics: Mapping[str, str], assumed: Mapping[str, Any] | None = None) -> None:
        self._config, self._assumed = config, dict(assumed or {})
        used = {name: use for name, use in uses(config).items() if name in topics}
        by_name = {one.name: one for one in config.sources}
        self._main = next((name for name, use in used.items() if use == "odometry"), "")
        self._topics: dict[str, _Topic] = {}
        for topic in dict.fromkeys(topics[name] for name in used):
            names = tuple(name for name in used if topics[name] == topic)
            first = by_name[names[0]]
            self._topics[topic] = _Topic(topic, first.type, names, used[names[0]], round(first.offset_s * 1e9))
        seen, mounts = (name for name, use in used.items() if use == "landmarks"), mount_corrections(config)
        self._sightings = {name: SightingCollector(name, topics[name], mounts[name]) for name in seen}
        self._frame_of = {name: by_name[name].frame for name in used}
        self._fixes: dict[str, list[Fix]] = {name: [] for name, use in used.items() if use == "fix"}
        self._frames_of_fixes = dict[str, str]()
        self._odometry_topic = topics.get(self._main, "")
        self._frame, self._child, self._gyro_frame = "", "", ""
        self.begin_anew()
        self._links: dict[tuple[str, str, bool], Link] = {}
        self._transforms = Transforms()
        self._last: Any = None

    def begin_anew(self) -> None:
        """Drop all numbers; frames, and the places of sensors, stay."""
        for topic in self._topics.values():
            topic.begin_anew()
        for seen in self._sightings.values():
            seen.begin_anew()
        self._odometry_ns, self._numbers = array("q"), array("d")
        self._fixes = {name: list[Fix]() for name in self._fixes}
        self._path_ns, self._path = array("q"), array("d")
        self._gyro_ns, self._gyro, self._felt = array("q"), array("d"), array("d")

    def decoder(self, decode: Decoder) -> Decoder:
        """The same decoder, of which the message is remembered until it is collected."""
        if isinstance(decode, OwnDecoder):
            return OwnDecoder(decode.type, self._remember)

        def decoded(cdr: bytes) -> Any:
            self._last = decode(cdr)
            return self._last

        return decoded

    def leave_out(self) -> None:
        """Forget the message that was decoded last: it is not collected, but what is measured is."""
        self._last = None

    def _remember(self, message: Any) -> None:
        self._last = message

    def add(self, topic: str, names: Iterable[str], log_ns: int, measured: Iterable[Measured | Control]) -> None:
        """Collect a message: the one that was decoded last, of these inputs, and what became of it."""
        message, self._last = self._last, None
        heights: dict[str, float] = {}
        if type(message) is OdometryBytes:
            self._add_read(topic, [log_ns], message.alone())
        elif message is not None:
            self._add_message(topic, names, log_ns, message)
        for m in measured:
            if isinstance(m, Odometry):
                if m.source.partition("#")[0] == self._main and len(self._path_ns) < MOST:
                    self._path_ns.append(m.stamp_ns)
                    self._path.extend(m.T_odom_base)
            elif isinstance(m, AngularVelocity) and len(self._gyro_ns) < MOST:
                self._gyro_ns.append(m.stamp_ns)
                self._gyro.append(m.rate[-1])
                parts = (getattr(message, of, None) for of in ("angular_velocity", "linear_acceleration"))
                self._felt.extend(getattr(part, axis, np.nan) for part in parts for axis in "xyz")  # a node has none
            elif isinstance(m, Fix) and len(self._fixes[m.topic]) < MOST:
                self._fixes[m.topic].append(m)
            elif isinstance(m, Sightings) and m.topic in self._sightings:
                if message is not None and self._config.world.dimensions == 2:
                    heights = heights or _heights(message, self._sightings[m.topic].T_base_frame)
                self._sightings[m.topic].add(m, heights)

    def add_run(self, topic: str, log_ns: Sequence[int], run: Sequence[Odometry]) -> None:
        """Collect messages that were converted at once: what was read of them, and the odometry of each."""
        read, self._last = self._last, None
        if type(read) is OdometryRun:
            self._add_read(topic, log_ns, read)
        if run[0].source == self._main:
            run = run[: MOST - len(self._path_ns)]
            self._path_ns.extend([m.stamp_ns for m in run])
            self._path.extend([x for m in run for x in m.T_odom_base])

    def _add_message(self, topic: str, names: Iterable[str], log_ns: int, message: Any) -> None:
        if topic in self._topics:
            self._topics[topic].add(log_ns, message)
        if topic == self._odometry_topic and hasattr(message, "twist"):
            self._add_odometry(message)
        for name in names:
            if name in (TF, TF_STATIC):
                self._add_transforms(message, fixed=name == TF_STATIC)
            elif name in self._sightings and not self._sightings[name].frame:
                self._place(self._sightings[name], message)
            elif name in self._fixes and name not in self._frames_of_fixes:
                self._frames_of_fixes[name] = self._frame_of[name] or _frame(message)
            elif name == self._config.gyro_input and not self._gyro_frame:
                self._gyro_frame = self._frame_of[name] or _frame(message)

    def _add_read(self, topic: str, log_ns: Sequence[int], read: OdometryRun) -> None:
        """Collect odometry that was not decoded."""
        if topic in self._topics:
            stamps_ns = (read.sec * 1_000_000_000 + read.nanosec).tolist()
            self._topics[topic].add_stamps(log_ns, stamps_ns, read.frame_id)
        if topic == self._odometry_topic and (room := MOST - len(self._odometry_ns)):
            self._note_frames(read.frame_id, read.child_frame_id)
            rows = np.empty((min(room, len(read.numbers)), _COLUMNS))
            rows[:, : -len(_TWIST)] = read.numbers[:room]
            rows[:, -len(_TWIST) :] = np.frombuffer(read.twist_covariance, "<f8")[list(_TWIST)]
            self._odometry_ns.extend(self._topics[topic].stamp_ns[-len(rows) :])
            self._numbers.frombytes(rows.tobytes())

    def _add_odometry(self, m: Any) -> None:
        p, q, v, w = m.pose.pose.position, m.pose.pose.orientation, m.twist.twist.linear, m.twist.twist.angular
        numbers, c = (p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z), m.twist.covariance
        if len(self._odometry_ns) < MOST:
            self._note_frames(m.header.frame_id, m.child_frame_id)
            self._odometry_ns.append(self._topics[self._odometry_topic].stamp_ns[-1])
            self._numbers.extend((*numbers, *(c[k] for k in _TWIST)))

    def _note_frames(self, frame: str, child: str) -> None:
        if not self._frame:
            self._frame, self._child = frame.lstrip("/"), child.lstrip("/")

    def _add_transforms(self, message: Any, *, fixed: bool) -> None:
        for t in message.transforms:
            parent, child = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            if fixed:
                r = t.transform.rotation
                self._transforms.add(parent, child, pose(t.transform.translation, (r.x, r.y, r.z, r.w)))
            self._links[parent, child, fixed] = Link(parent, child, fixed)

    def _place(self, found: SightingCollector, message: Any) -> None:
        """Find the place of an input's sensor on the robot, by its first message that names a frame."""
        own = self._frame_of[found.input] or _frame(message)
        if not own:
            return
        found.frame, found.T_base_frame = own, self._T_base(found.input, own) or se3.IDENTITY

    def _T_base(self, name: str, frame: str) -> se3.Pose | None:
        """The fixed pose of an input's frame on the robot, by TF, else as configured; None where neither has it."""
        known = self._transforms.lookup(self._config.frames.base, frame)
        of = next((one for one in self._config.sources if one.name == name), InputConfig(name))
        mounted = tuple(map(float, assumed_mount(frame).split())) if of.mount == ASSUMED else of.numbers("mount", 6)
        return se3.from_xyz_rpy(mounted) if known is None and mounted else known

    def columns(self, counters: Counters) -> Columns:
        """Everything that was collected, and what the converters have counted."""
        return Columns(
            self._config,
            {name: one.columns() for name, one in self._topics.items()},
            self._odometry(),
            index(self._path_ns),
            self._poses(self._path),
            tuple(one.columns() for one in self._sightings.values()),
            tuple(self._links.values()),
            counters,
            self._assumed,
            index(self._gyro_ns),
            np.array(self._gyro),
            np.array(self._felt).reshape(-1, 6),
            self._gyro_frame,
            self._T_base(self._config.gyro_input, self._gyro_frame),
            tuple(self._fixes_of(name, some) for name, some in self._fixes.items()),
        )

    def _fixes_of(self, name: str, some: Sequence[Fix]) -> FixColumns:
        topic = next((topic.name for topic in self._topics.values() if name in topic.inputs), name)
        n, frame = self._config.world.dimensions, self._frames_of_fixes.get(name, "")
        has_point = [m.kind in ("position", "pose") for m in some]
        points = [complex(*m.measured[:2]) if has else complex(np.nan) for m, has in zip(some, has_point, strict=True)]
        sigmas = [m.covariance[0] ** 0.5 for m, has in zip(some, has_point, strict=True) if has]
        kind = some[0].kind if some else ""
        headings = [np.nan if m.kind == "position" else _yaw(m.measured, n) for m in some]
        return FixColumns(
            name,
            topic,
            np.array([m.stamp_ns for m in some], dtype=np.int64),
            np.array(points),
            np.array(headings),
            float(np.median(sigmas)) if sigmas else 0.0,
            frame if kind in ("heading", "attitude") else "",
            self._T_base(name, frame) or se3.IDENTITY,
        )

    def _poses(self, numbers: "array[float]") -> Array:
        poses = np.array(numbers).reshape(-1, self._config.space.pose.size)
        return poses if poses.shape[1] == 7 else se3.in_space(poses).reshape(-1, 7)

    def _odometry(self) -> OdometryColumns:
        names = (self._main, self._odometry_topic)
        if len(self._odometry_ns):
            rows = np.array(self._numbers).reshape(-1, _COLUMNS)
            return OdometryColumns(
                *names, self._frame, self._child, index(self._odometry_ns), rows[:, :7], rows[:, 7:13], rows[:, 13:]
            )
        frames, poses = self._config.frames, self._poses(self._path)
        unknown = np.full((len(poses), 6), np.nan)
        return OdometryColumns(*names, frames.odom, frames.base, index(self._path_ns), poses, unknown, unknown)


def _heights(message: Any, T_base_frame: se3.Pose) -> dict[str, float]:
    """The heights of detections above the base, by id, which the plane does not have."""
    out: dict[str, float] = {}
    for one in getattr(message, "detections", ()):
        if getattr(one, "results", ()) and hasattr(one.results[0], "pose"):
            p = one.results[0].pose.pose.position
            out |= dict.fromkeys(names_of(one), float(se3.act(T_base_frame, (p.x, p.y, p.z))[2]))
    return out


def _yaw(measured: Sequence[float], dimensions: int) -> float:
    """The heading at the end of a pose, an attitude or a heading."""
    return float(measured[-1] if dimensions == 2 else so3.log(tuple(measured[-4:]))[2])


def _frame(message: Any) -> str:
    """The frame that a message names first."""
    several = getattr(message, "transforms", None) or getattr(message, "markers", None) or []
    headers = [getattr(message, "header", None), *(getattr(one, "header", None) for one in several[:1])]
    names = (one.frame_id.lstrip("/") for one in headers if one is not None)
    return next(filter(None, names), "")
