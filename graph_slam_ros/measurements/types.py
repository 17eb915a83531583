"""Measurements and events for ``GraphSlam.process``: immutable values that JSON represents exactly.

A pose is (x, y, theta) in the plane and (x, y, z, qx, qy, qz, qw) in space, in metres and radians. Covariances are flat
and row-major, in the order of the tangent space: (x, y, theta), or (x, y, z, rotation vector). The values do not depend
on the type of the message that they came from.
"""

import math
import operator
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from graph_slam_ros.errors import FormatError
from graph_slam_ros.typing import Numbers

Value: TypeAlias = bool | int | float | str | tuple[int, ...] | tuple[float, ...]
Event: TypeAlias = Literal[
    "flush", "end", "optimize", "clear_closures", "time_jump", "clock_step", "set", "remove", "restart"
]
EVENTS: tuple[Event, ...] = get_args(Event)
_VALUES: dict[Event, dict[str, type]] = {"remove": {"edge": int, "landmark": str}}


_POSE, _OF_POSE = (3, 7), (9, 36)  # numbers in the plane, in space; and of its covariance
_KINDS: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {  # numbers that are measured, and of their covariance
    "position": ((2, 3), (4, 9)),
    "pose": (_POSE, _OF_POSE),
    "range_bearing": ((2, 3), (4, 9)),
    "bearing": ((1, 2), (1, 4)),
    "range": ((1,), (1,)),
    "heading": ((1,), (1,)),
    "attitude": ((4,), (9,)),
}
SIGHTING_KINDS = ("position", "pose", "range_bearing", "bearing", "range")
FIX_KINDS = ("pose", "position", "heading", "attitude")


def _check_choice(cls: type, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise FormatError(f"{cls.__name__}: {value!r} is not one of {', '.join(choices)}")


def _check(one: Any, **sizes: tuple[int, ...]) -> None:
    """Make plain tuples of arrays. Raises FormatError for wrong numbers, or so many as there may not be."""
    name, value = "stamp_ns", getattr(one, "stamp_ns", 0)
    try:
        if type(value) is not int:
            object.__setattr__(one, name, operator.index(value))
        for name in sizes:
            value = getattr(one, name)
            if value is not None and not (type(value) is tuple and {float}.issuperset(map(type, value))):
                value = tuple(map(float, np.ravel(value).tolist()))
                object.__setattr__(one, name, value)
            if value is not None and (len(value) not in sizes[name] or not all(map(math.isfinite, value))):
                raise ValueError
    except (TypeError, ValueError, OverflowError):
        right = f"{' or '.join(map(str, sizes[name]))} finite numbers" if name in sizes else "whole nanoseconds"
        raise FormatError(f"{type(one).__name__}: {name} {value!r}: it must be {right}") from None


def _check_pair(one: Any, measured: str, allowed: tuple[tuple[int, ...], tuple[int, ...]], **more: Any) -> None:
    """Check numbers that were measured, and that the covariance is of so many."""
    _check(one, **{measured: allowed[0], "covariance": allowed[1]}, **more)
    if allowed[0].index(len(getattr(one, measured))) != allowed[1].index(len(one.covariance)):
        raise FormatError(
            f"{type(one).__name__}: covariance of {len(one.covariance)} numbers is not that of {measured}"
        )


@dataclass(frozen=True, slots=True)
class Odometry:
    """Absolute pose in the odometry frame; only the motion between two poses is used.

    Attributes
    ----------
    twist_covariance : 9 numbers (36 in space), (m/s, rad/s) in the base frame, or None if unknown
    source : the name of the odometry, if there are several; the configuration has their priority
    """

    stamp_ns: int
    T_odom_base: Numbers
    twist_covariance: Numbers | None = None
    source: str = "odometry"

    def __post_init__(self) -> None:
        _check(self, T_odom_base=_POSE, twist_covariance=_OF_POSE)


@dataclass(frozen=True, slots=True)
class AngularVelocity:
    """The turn rate of the base, by a gyro.

    Attributes
    ----------
    rate : about z in the plane, about the axes of the base in space [rad/s]
    covariance : flat, of one message's ``rate``, whose errors are independent; None if unknown
    """

    stamp_ns: int
    topic: str
    rate: Numbers
    covariance: Numbers | None = None

    def __post_init__(self) -> None:
        _check(self, rate=(1, 3), covariance=(1, 9))


@dataclass(frozen=True, slots=True)
class Sighting:
    """One observation of a landmark by a sensor of the robot.

    Attributes
    ----------
    id : its identity; empty if the sensor does not know it
    kind : what was measured, one of ``SIGHTING_KINDS``
    measured : depends on ``kind``. ``position``, ``pose``: the point or pose in the base frame. ``range_bearing``:
        (range, bearing) or (range, azimuth, elevation) in the sensor frame. ``bearing``: the same without the range.
        ``range``: one number
    covariance : of ``measured``; of a position in the axes of the base frame, of a pose in its tangent space
    T_base_sensor : pose of the sensor, for kinds that are measured in the sensor frame; None: at the base. Of a
        position or pose it is the place about which ``mount_correction`` turns
    sort : what it is a landmark of (a tree, a red cone), where the sensor knows it; those of other sorts are others
    size : of the landmark [m]; zero where unknown

    Raises
    ------
    FormatError
        ``kind`` is not one of ``SIGHTING_KINDS``.
    """

    id: str
    kind: str
    measured: Numbers
    covariance: Numbers
    T_base_sensor: Numbers | None = None
    sort: str = ""
    size: float = 0.0

    def __post_init__(self) -> None:
        _check_choice(Sighting, self.kind, SIGHTING_KINDS)
        _check_pair(self, "measured", _KINDS[self.kind], T_base_sensor=_POSE)


@dataclass(frozen=True, slots=True)
class Sightings:
    """All observations of one message, at their common stamp."""

    stamp_ns: int
    topic: str
    sightings: tuple[Sighting, ...]

    def __post_init__(self) -> None:
        _check(self)


@dataclass(frozen=True, slots=True)
class Fix:
    """An absolute measurement in the map frame: a GNSS position, a compass heading, a pose from another system.

    Attributes
    ----------
    measured : depends on ``kind``. ``pose``: T_map_base. ``position``: the coordinates of ``point`` in map.
        ``heading``: one angle. ``attitude``: the quaternion (x, y, z, w) of R_map_base, in space only
    covariance : of ``measured``. Of a position in the axes of map; a variance of 1e6 m^2 or more means that the axis is
        unknown. Of a pose or attitude in its tangent space
    point : for ``position``, the antenna in the base frame; empty: the origin of the base
    datum : for a position on earth, latitude [deg], longitude [deg] and height [m] of the map's origin

    Raises
    ------
    FormatError
        ``kind`` is not one of ``FIX_KINDS``.
    """

    stamp_ns: int
    topic: str
    kind: str
    measured: Numbers
    covariance: Numbers
    point: Numbers = ()
    datum: Numbers = ()

    def __post_init__(self) -> None:
        _check_choice(Fix, self.kind, FIX_KINDS)
        _check_pair(self, "measured", _KINDS[self.kind], point=(0, 2, 3), datum=(0, 3))


@dataclass(frozen=True, slots=True)
class Closure:
    """A loop closure: the pose of the robot at one stamp, relative to its pose at another stamp.

    Attributes
    ----------
    from_stamp_ns : the other stamp, earlier or later
    T_from_base : pose of the base at ``stamp_ns`` in the frame of the base at ``from_stamp_ns``
    covariance : of that pose in its tangent space
    """

    stamp_ns: int
    from_stamp_ns: int
    topic: str
    T_from_base: Numbers
    covariance: Numbers

    def __post_init__(self) -> None:
        _check_pair(self, "T_from_base", (_POSE, _OF_POSE))


@dataclass(frozen=True, slots=True)
class InitialPose:
    """A pose given by a user or another system; it is used from the next odometry on.

    Attributes
    ----------
    covariance : of ``T_map_base`` in its tangent space
    """

    T_map_base: Numbers
    covariance: Numbers

    def __post_init__(self) -> None:
        _check_pair(self, "T_map_base", (_POSE, _OF_POSE))


@dataclass(frozen=True, slots=True)
class Control:
    """An event that is not a measurement.

    Attributes
    ----------
    event : ``flush`` processes the measurements that are held for sorting by stamp; ``end`` also drops those that no
        odometry reached; ``optimize`` solves everything; ``clear_closures`` removes all loop closures; ``time_jump``
        begins a segment whose stamps may be older; ``clock_step`` does so while the drive goes on; ``set`` changes
        parameters; ``remove`` removes an edge or landmark; ``restart`` goes back to the last good estimate after an
        outside fault
    values : names and values. ``set``: parameters. ``remove``: ``edge`` and its id, or ``landmark`` and its name.
        Others: none

    Raises
    ------
    FormatError
        ``event`` is not one of ``EVENTS``, or ``values`` are not what it needs.
    """

    event: Event
    values: tuple[tuple[str, Value], ...] = ()

    def __post_init__(self) -> None:
        _check_choice(Control, self.event, EVENTS)
        if self.event == "set":
            return
        known = _VALUES.get(self.event, {})
        if [known.get(name) for name, _ in self.values] != [type(value) for _, value in self.values] or (
            len(self.values) != bool(known)
        ):
            needed = " or ".join(f"{name} ({kind.__name__})" for name, kind in known.items()) or "no value"
            raise FormatError(f"Control: {self.event} has {dict(self.values)}; it needs {needed}")


END = Control("end"), Control("optimize")
"""The end of a run: what is held is processed, nothing more comes, and everything is solved."""


Observation: TypeAlias = Sightings | Fix | Closure
Measured: TypeAlias = Odometry | AngularVelocity | Observation
Measurement: TypeAlias = Measured | InitialPose | Control


def check_space(m: Measurement, dimensions: int) -> None:
    """Raise FormatError for a measurement in the plane (2 dimensions) of a robot in space (3), or the reverse."""
    several = m.sightings if isinstance(m, Sightings) else (m,) if isinstance(m, Fix) else ()
    sizes = [(len(one.measured), _KINDS[one.kind][0]) for one in several]
    of_type = [(one, *size) for one in (m, *several) for size in _SIZES.get(type(one), ())]
    sizes += [(len(numbers), of) for one, name, of in of_type if (numbers := getattr(one, name))]
    if any(size != of[min(dimensions - 2, len(of) - 1)] for size, of in sizes):
        raise FormatError(f"{type(m).__name__}: its numbers are not of {dimensions} dimensions (world.dimensions)")


_SIZES: dict[type, tuple[tuple[str, tuple[int, ...]], ...]] = {
    Odometry: (("T_odom_base", _POSE), ("twist_covariance", _OF_POSE)),
    AngularVelocity: (("rate", (1, 3)),),
    Sighting: (("T_base_sensor", _POSE),),
    Closure: (("T_from_base", _POSE),),
    InitialPose: (("T_map_base", _POSE),),
}
_TYPES = {
    "odometry": Odometry,
    "angular_velocity": AngularVelocity,
    "sightings": Sightings,
    "fix": Fix,
    "closure": Closure,
    "initial_pose": InitialPose,
    "control": Control,
}
_NAMES = {cls: name for name, cls in _TYPES.items()}


def to_record(measurement: Measurement) -> dict[str, Any]:
    """Plain dictionary of a measurement; floats survive JSON exactly."""
    match measurement:
        case Odometry(stamp_ns, pose, covariance, source):  # by hand: thousands a second
            out = {"type": "odometry", "stamp_ns": stamp_ns, "T_odom_base": pose, "twist_covariance": covariance}
            return out | {"source": source}
        case AngularVelocity(stamp_ns, topic, rate, covariance):
            out = {"type": "angular_velocity", "stamp_ns": stamp_ns, "topic": topic}
            return out | {"rate": rate, "covariance": covariance}
        case Sightings(stamp_ns, topic, sightings):
            out = {"type": "sightings", "stamp_ns": stamp_ns, "topic": topic}
            return out | {"sightings": tuple(map(sighting_record, sightings))}
        case _:
            return {"type": _NAMES[type(measurement)], **asdict(measurement)}


def sighting_record(one: Sighting) -> dict[str, Any]:
    """Plain dictionary of a sighting. It has a size only where that is known."""
    out = asdict(one)
    if not one.size:
        del out["size"]
    return out


def from_record(record: dict[str, Any]) -> Measurement:
    """Inverse of ``to_record``. Raises FormatError naming the field that is missing or unknown."""
    fields = dict(record)
    cls = _TYPES.get(fields.pop("type", ""))
    if cls is None:
        raise FormatError(f"unknown kind of measurement {record.get('type')!r}")
    try:
        if cls is Sightings:
            fields["sightings"] = tuple(Sighting(**_tuples(one)) for one in fields["sightings"])
        if cls is Control:
            fields["values"] = tuple(
                (name, tuple(value) if isinstance(value, list) else value) for name, value in fields.get("values", ())
            )
        return cls(**_tuples(fields))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{record['type']}: {error}") from None


def _tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
