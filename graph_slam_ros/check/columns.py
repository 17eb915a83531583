"""A recording as columns of numbers, collected in one pass over its messages.

A ``Collector`` gets each decoded message, and the measurements that the converters of a replay make of it. It returns
``Columns``. Each check is a function of ``Columns`` alone.
"""

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import ASSUMED, InputConfig
from graph_slam_ros.findings.finding import Finding, Severity
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import AngularVelocity, Control, Fix, Measured, Odometry, Sighting, Sightings
from graph_slam_ros.messages.from_msg import TF, TF_STATIC
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.messages.inputs.detections import names_of
from graph_slam_ros.messages.inputs.odometry_bytes import OdometryRun
from graph_slam_ros.messages.inputs.transforms import Transforms, assumed_mount
from graph_slam_ros.typing import Array, Index, Mask

MOST = 0.5  # part of all: more are most of them
_KEPT = 200_000  # messages of each topic that are collected
_TWIST = (0, 7, 14, 21, 28, 35)  # places in a covariance
_UNKNOWN_M = 30.0  # so large is the sigma of an axis that a detector does not know
SomeTopicData = TypeVar("SomeTopicData", bound="TopicData")


class TopicData:
    """Arrays with a row for each message or measurement of a topic; makes the findings on them."""

    __slots__ = ()
    topic: str
    stamp_ns: Index

    def some(self: SomeTopicData, which: Index | Mask) -> SomeTopicData:
        """The same of some of them."""
        rows = {one.name: getattr(self, one.name) for one in fields(self)}  # type: ignore[arg-type]
        arrays = {name: row[which] for name, row in rows.items() if isinstance(row, np.ndarray)}
        return replace(self, **arrays)  # type: ignore[type-var]

    def finding(
        self,
        code: str,
        severity: Severity,
        value: float,
        limit: float,
        unit: str,
        text: str,
        count: int | None = None,
        at: Index | None = None,
        settings: tuple[str, ...] = (),
    ) -> Finding:
        """A finding of the topic, or of so many of its messages, or those at some stamps."""
        stamps_ns = self.stamp_ns if at is None else at
        first_ns, number = int(next(iter(stamps_ns), 0)), len(stamps_ns) if count is None else int(count)
        whole = f"{self.topic or 'odometry'}: {text}"
        return Finding(code, severity, value, limit, unit, whole, self.topic, first_ns, number, settings)


@dataclass(frozen=True, slots=True, eq=False)
class TopicColumns(TopicData):
    """The messages of one topic.

    Attributes
    ----------
    use : of its first input: odometry, landmarks, fix, closure; empty of transforms
    log_ns, stamp_ns : (n,) when recorded, and the stamp of the header with the input's ``offset_s``
    frames : how many messages name each frame
    """

    topic: str
    inputs: tuple[str, ...]
    use: str
    log_ns: Index
    stamp_ns: Index
    frames: Mapping[str, int] = field(default_factory=dict)

    @property
    def lag_s(self) -> Array:
        """(n,) By how much they were recorded later than stamped [s]."""
        return np.asarray((self.log_ns - self.stamp_ns) * 1e-9)


@dataclass(frozen=True, slots=True, eq=False)
class OdometryColumns(TopicData):
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


@dataclass(frozen=True, slots=True, eq=False)
class SightingColumns(TopicData):
    """The sightings of one input, as a replay uses them.

    Attributes
    ----------
    names, name : identities, and (k,) the number of each sighting's; the empty one is of those without
    points : (k, 3) in the base frame; NaN of a range or bearing alone
    ranges : (k,) of a range alone [m]; NaN of others
    bearings : (k,) of a bearing alone, in the plane or horizontal [rad]; NaN of others
    sigmas : (k,) of the position or range [m], or of a bearing alone [rad]
    frame, T_base_frame : the frame of the first message, and where it is on the robot
    """

    input: str
    topic: str
    stamp_ns: Index
    names: tuple[str, ...]
    name: Index
    points: Array
    ranges: Array
    bearings: Array
    sigmas: Array
    frame: str
    T_base_frame: se3.Pose

    def named(self, path_ns: Index) -> Mask:
        """Return which have an identity, and are within the time of odometry."""
        is_named = np.array([bool(name) for name in self.names], dtype=bool)[self.name]
        return np.asarray(is_named & (self.stamp_ns >= path_ns[0]) & (self.stamp_ns <= path_ns[-1]))

    def located(self, path_ns: Index) -> Mask:
        """Return which sightings have an identity, are within the time of odometry, and have a position."""
        return np.asarray(self.named(path_ns) & (np.abs(self.points) < 1e9).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class FixColumns(TopicData):
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
class Columns:
    """The whole recording.

    Attributes
    ----------
    assumed : parameters that were chosen for the recording, and that nobody has set
    links : the parent and child frame of each transform
    path_ns, path : (m,) and (m, 7) T_odom_base, as a replay uses odometry, its distances corrected, ``in_order``
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
    links: tuple[tuple[str, str], ...]
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


def in_order(path_ns: Index, path: Array) -> tuple[Index, Array]:
    """Usable poses of a path, in order of stamp, one for each."""
    usable = np.isfinite(path).all(axis=1) & (np.abs(path).max(axis=1, initial=0.0) < 1e9)
    stamp_ns, first = np.unique(path_ns[usable], return_index=True)
    return stamp_ns, path[usable][first]


class _Rows:
    """Rows of some whole numbers and some others, up to ``_KEPT``."""

    def __init__(self, whole: int, others: int) -> None:
        self._sizes, self._whole, self._others = (whole, others), array("q"), array("d")

    def __len__(self) -> int:
        return len(self._whole) // self._sizes[0]

    @property
    def room(self) -> int:
        """The number of rows that may still be added."""
        return _KEPT - len(self)

    def add(self, whole: Iterable[int], others: Iterable[float] = ()) -> None:
        """Add one or more rows, for which there is room."""
        self._whole.extend(whole)
        self._others.extend(others)

    def columns(self) -> tuple[Index, Array]:
        """The whole numbers (n, whole) and the others (n, others)."""
        whole, others = np.array(self._whole, dtype=np.int64), np.array(self._others, dtype=np.float64)
        return whole.reshape(-1, self._sizes[0]), others.reshape(len(self), self._sizes[1])


class _Topic:
    def __init__(self, name: str, inputs: tuple[str, ...], use: str, offset_ns: int) -> None:
        self._of, self._offset_ns = (name, inputs, use), offset_ns
        self.begin_anew()

    def begin_anew(self) -> None:
        self.rows, self.frames = _Rows(2, 0), dict[str, int]()

    def add(self, log_ns: Sequence[int], stamps_ns: Sequence[int], frame: str) -> None:
        if room := min(len(log_ns), self.rows.room):
            rows = zip(log_ns[:room], map(self.stamp, stamps_ns[:room]), strict=True)
            self.rows.add(number for row in rows for number in row)
            self.frames[frame] = self.frames.get(frame, 0) + room

    def stamp(self, stamp_ns: int) -> int:
        """A stamp with the input's offset; 0 is none."""
        return stamp_ns + self._offset_ns if stamp_ns else 0

    def columns(self) -> TopicColumns:
        log_ns, stamp_ns = self.rows.columns()[0].T
        return TopicColumns(*self._of, log_ns, stamp_ns, self.frames)


class _Input:
    """What one input measures, and the frame of its sensor: the configured one, or the first that a message names."""

    def __init__(self, of: InputConfig, topic: str, *sizes: int) -> None:
        self.of, self.topic, self.frame, self._sizes = of, topic, "", sizes
        self.begin_anew()

    def begin_anew(self) -> None:
        self.rows, self.names = _Rows(*self._sizes), dict[str, int]()

    def note_frame(self, message: Any) -> None:
        self.frame = self.frame or self.of.frame or _frame(message)

    def add_sightings(self, m: Sightings, heights: Mapping[str, float]) -> None:
        """Collect a message, with the heights of landmarks above the base [m], by id, which the plane does not have."""
        for one in m.sightings if self.rows.room > 0 else ():
            (x, y, z), sigma = _located(one)
            alone = (one.measured[0] if one.kind == kind else np.nan for kind in ("range", "bearing"))
            name = self.names.setdefault(one.id, len(self.names))
            self.rows.add((m.stamp_ns, name), (x, y, heights.get(one.id, z), *alone, sigma))


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
            self._topics[topic] = _Topic(topic, names, used[names[0]], round(by_name[names[0]].offset_s * 1e9))
        sizes = {"landmarks": (2, 6), "fix": (1, 4)}
        self._inputs = {n: _Input(by_name[n], topics[n], *sizes[use]) for n, use in used.items() if use in sizes}
        self._sightings, self._fixes = ([n for n in self._inputs if used[n] == use] for use in sizes)
        gyro = config.gyro_input
        self._gyro = self._inputs[gyro] = _Input(by_name.get(gyro, InputConfig(gyro)), topics.get(gyro, ""), 1, 7)
        self._odometry_topic = topics.get(self._main, "")
        self._frame, self._child = "", ""
        self.begin_anew()
        self._links: dict[tuple[str, str], None] = {}
        self._transforms = Transforms()

    def begin_anew(self) -> None:
        """Drop all numbers; frames, and the places of sensors, stay."""
        for topic in self._topics.values():
            topic.begin_anew()
        for one in self._inputs.values():
            one.begin_anew()
        self._read, self._path = _Rows(1, 7 + 6 + 6), _Rows(1, self._config.space.pose.size)

    def add(
        self,
        topic: str,
        names: Iterable[str],
        log_ns: int,
        measured: Iterable[Measured | Control],
        message: Any = None,
    ) -> None:
        """Collect a message of these inputs, if it was decoded and is not left out, and what became of it."""
        heights: dict[str, float] = {}
        if message is not None:
            self._add_message(topic, names, log_ns, message)
        for m in measured:
            if isinstance(m, Odometry):
                if m.source.partition("#")[0] == self._main and self._path.room:
                    self._path.add((m.stamp_ns,), m.T_odom_base)
            elif isinstance(m, AngularVelocity) and self._gyro.rows.room:
                parts = (getattr(message, of, None) for of in ("angular_velocity", "linear_acceleration"))
                felt = (getattr(part, axis, np.nan) for part in parts for axis in "xyz")  # a node has none
                self._gyro.rows.add((m.stamp_ns,), (m.rate[-1], *felt))
            elif isinstance(m, Fix) and self._inputs[m.topic].rows.room:
                self._inputs[m.topic].rows.add((m.stamp_ns,), _fixed(m, self._config.world.dimensions))
            elif isinstance(m, Sightings) and m.topic in self._inputs:
                if message is not None and self._config.world.dimensions == 2:
                    heights = heights or _heights(message, self._T_base(self._inputs[m.topic]) or se3.IDENTITY)
                self._inputs[m.topic].add_sightings(m, heights)

    def add_run(self, topic: str, log_ns: Sequence[int], run: Sequence[Odometry], read: OdometryRun) -> None:
        """Collect messages that were converted at once: what was read of them, and the odometry of each."""
        self._add_read(topic, log_ns, read)
        if run[0].source == self._main:
            run = run[: self._path.room]
            self._path.add([m.stamp_ns for m in run], [x for m in run for x in m.T_odom_base])

    def _add_message(self, topic: str, names: Iterable[str], log_ns: int, message: Any) -> None:
        header = getattr(message, "header", None)
        stamp_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec if header is not None else 0
        if topic in self._topics and header is not None:
            self._topics[topic].add([log_ns], [stamp_ns], header.frame_id)
        if topic == self._odometry_topic and hasattr(message, "twist") and self._read.room:
            self._add_odometry(message, self._topics[topic].stamp(stamp_ns))
        for name in names:
            if name in (TF, TF_STATIC):
                self._add_transforms(message, fixed=name == TF_STATIC)
            elif name in self._inputs:
                self._inputs[name].note_frame(message)

    def _add_read(self, topic: str, log_ns: Sequence[int], read: OdometryRun) -> None:
        """Collect odometry that was not decoded."""
        stamps_ns = (read.sec * 1_000_000_000 + read.nanosec).tolist()
        if topic in self._topics:
            self._topics[topic].add(log_ns, stamps_ns, read.frame_id)
        if topic == self._odometry_topic and (room := self._read.room):
            self._note_frames(read.frame_id, read.child_frame_id)
            numbers = read.numbers[:room]
            variances = np.frombuffer(read.twist_covariance, "<f8")[list(_TWIST)]
            rows = np.hstack((numbers, np.tile(variances, (len(numbers), 1))))
            self._read.add(map(self._topics[topic].stamp, stamps_ns[:room]), array("d", rows.tobytes()))

    def _add_odometry(self, m: Any, stamp_ns: int) -> None:
        p, q, v, w = m.pose.pose.position, m.pose.pose.orientation, m.twist.twist.linear, m.twist.twist.angular
        numbers, c = (p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z), m.twist.covariance
        self._note_frames(m.header.frame_id, m.child_frame_id)
        self._read.add((stamp_ns,), (*numbers, *(c[k] for k in _TWIST)))

    def _note_frames(self, frame: str, child: str) -> None:
        if not self._frame:
            self._frame, self._child = frame.lstrip("/"), child.lstrip("/")

    def _add_transforms(self, message: Any, *, fixed: bool) -> None:
        for t in message.transforms:
            parent, child = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            if fixed:
                v, r = t.transform.translation, t.transform.rotation
                self._transforms.add(parent, child, (v.x, v.y, v.z, r.x, r.y, r.z, r.w))
            self._links[parent, child] = None

    def _T_base(self, one: _Input) -> se3.Pose | None:
        """The fixed pose of an input's frame on the robot, by TF, else as configured; None where neither has it."""
        known = self._transforms.lookup(self._config.frames.base, one.frame)
        is_assumed = one.of.mount == ASSUMED
        mounted = tuple(map(float, assumed_mount(one.frame).split())) if is_assumed else one.of.numbers("mount", 6)
        return se3.from_xyz_rpy(mounted) if known is None and mounted else known

    def columns(self, counters: Counters) -> Columns:
        """Everything that was collected, and what the converters have counted."""
        path_ns, path = self._path.columns()
        path = path if path.shape[1] == len(se3.IDENTITY) else se3.in_space(path).reshape(-1, 7)
        scale = [self._config.odometry.distance_factor] * 3 + [1.0] * 4
        gyro_ns, turned = self._gyro.rows.columns()
        return Columns(
            self._config,
            {name: one.columns() for name, one in self._topics.items()},
            self._odometry(path_ns[:, 0], path),
            *in_order(path_ns[:, 0], path * scale),
            tuple(map(self._sightings_of, self._sightings)),
            tuple(self._links),
            counters,
            self._assumed,
            gyro_ns[:, 0],
            turned[:, 0],
            turned[:, 1:],
            self._gyro.frame,
            self._T_base(self._gyro),
            tuple(map(self._fixes_of, self._fixes)),
        )

    def _sightings_of(self, name: str) -> SightingColumns:
        one = self._inputs[name]
        (stamp_ns, number), columns = (rows.T for rows in one.rows.columns())
        points: Array = np.ascontiguousarray(columns[:3].T)
        T_base_frame = self._T_base(one) or se3.IDENTITY
        mount = one.of.numbers("mount_correction", 6) or (0.0,) * 6
        if self._config.world.dimensions == 2:
            mount = (*mount[:2], 0.0, 0.0, 0.0, mount[5])
        if any(mount):
            origin = np.array(T_base_frame[:3])
            turned = so3.act(so3.exp(tuple(mount[3:])), tuple((points - origin).T))
            points = np.stack(turned, axis=1) + origin + mount[:3]
        ranges, bearings, sigmas = columns[3:]
        measured, place = (points, ranges, bearings, sigmas), (one.frame, T_base_frame)
        return SightingColumns(name, one.topic, stamp_ns, tuple(one.names), number, *measured, *place)

    def _fixes_of(self, name: str) -> FixColumns:
        one = self._inputs[name]
        (stamp_ns,), (x, y, sigmas, headings) = (columns.T for columns in one.rows.columns())
        has_point = np.isfinite(x)
        sigma_m = float(np.median(sigmas[has_point])) if has_point.any() else 0.0
        place = "" if has_point[:1].any() else one.frame, self._T_base(one) or se3.IDENTITY
        return FixColumns(name, one.topic, stamp_ns, x + 1j * y, headings, sigma_m, *place)

    def _odometry(self, path_ns: Index, path: Array) -> OdometryColumns:
        names = (self._main, self._odometry_topic)
        stamp_ns, read = self._read.columns()
        if len(read):
            parts = read[:, :7], read[:, 7:13], read[:, 13:]
            return OdometryColumns(*names, self._frame, self._child, stamp_ns[:, 0], *parts)
        unknown, frames = np.full((len(path), 6), np.nan), self._config.frames
        return OdometryColumns(*names, frames.odom, frames.base, path_ns, path, unknown, unknown)


def _located(one: Sighting) -> tuple[tuple[float, float, float], float]:
    """The point of a sighting in the base frame, NaN where it has none, and the standard deviation of it."""
    m, c = one.measured, one.covariance
    size = round(len(c) ** 0.5)
    if one.kind in ("position", "pose"):
        n = len(m) if one.kind == "position" else 2 if len(m) == 3 else 3
        known = [c[i * (size + 1)] for i in range(n) if c[i * (size + 1)] < _UNKNOWN_M**2] or [_UNKNOWN_M**2]
        sigma = (sum(known) / len(known)) ** 0.5
        return (m[0], m[1], m[2] if n == 3 else 0.0), sigma
    if one.kind != "range_bearing":
        return (np.nan, np.nan, np.nan), c[0] ** 0.5
    elevation = m[2] if len(m) == 3 else 0.0
    level = m[0] * np.cos(elevation)
    seen = (level * np.cos(m[1]), level * np.sin(m[1]), m[0] * np.sin(elevation))
    at = one.T_base_sensor
    if at is not None:
        T = tuple(at) if len(at) == 7 else tuple(se3.in_space(np.array([at]))[0])
        seen = se3.act(T, seen)
    sigma = ((c[0] + m[0] ** 2 * sum(c[i * (size + 1)] for i in range(1, size))) / size) ** 0.5
    return (float(seen[0]), float(seen[1]), float(seen[2])), float(sigma)


def _fixed(m: Fix, dimensions: int) -> tuple[float, float, float, float]:
    """x, y and their sigma, and the heading of a fix; NaN where it has none."""
    place = (*m.measured[:2], m.covariance[0] ** 0.5) if m.kind in ("position", "pose") else (np.nan,) * 3
    if m.kind == "position":
        return (*place, np.nan)
    return (*place, float(m.measured[-1] if dimensions == 2 else so3.log(tuple(m.measured[-4:]))[2]))


def _heights(message: Any, T_base_frame: se3.Pose) -> dict[str, float]:
    """The heights of detections above the base, by id, which the plane does not have."""
    out: dict[str, float] = {}
    for one in getattr(message, "detections", ()):
        if getattr(one, "results", ()) and hasattr(one.results[0], "pose"):
            p = one.results[0].pose.pose.position
            out |= dict.fromkeys(names_of(one), float(se3.act(T_base_frame, (p.x, p.y, p.z))[2]))
    return out


def _frame(message: Any) -> str:
    """The frame that a message names first."""
    several = getattr(message, "transforms", None) or getattr(message, "markers", None) or []
    headers = [getattr(message, "header", None), *(getattr(one, "header", None) for one in several[:1])]
    names = (one.frame_id.lstrip("/") for one in headers if one is not None)
    return next(filter(None, names), "")
