"""Measurements and events for ``GraphSlam.process``: immutable values that JSON represents exactly.

A pose is (x, y, theta) in the plane and (x, y, z, qx, qy, qz, qw) in space, in metres and radians. Covariances are flat
and row-major, in the order of the tangent space: (x, y, theta), or (x, y, z, rotation vector). The values do not depend
on the type of the message that they came from.
"""

import math
import operator
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass
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

SIGHTING_KINDS = ("position", "pose", "range_bearing", "bearing", "range")
FIX_KINDS = ("pose", "position", "heading", "attitude")
Sizes: TypeAlias = Mapping[str, tuple[int, ...]]
_POSE, _OF_POSE = (3, 7), (9, 36)  # numbers in the plane, in space; and of its covariance
_KINDS: dict[str, Sizes] = {
    "position": {"measured": (2, 3), "covariance": (4, 9)},
    "pose": {"measured": _POSE, "covariance": _OF_POSE},
    "range_bearing": {"measured": (2, 3), "covariance": (4, 9)},
    "bearing": {"measured": (1, 2), "covariance": (1, 4)},
    "range": {"measured": (1,), "covariance": (1,)},
    "heading": {"measured": (1,), "covariance": (1,)},
    "attitude": {"measured": (4,), "covariance": (9,)},
}
_UNIT = 1e-3  # so far from 1 the length of a quaternion may be


def _check_choice(one: Any, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise FormatError(f"{type(one).__name__}: {value!r} is not one of {', '.join(choices)}")


class _Checked:
    """The base of all measurements: numbers become tuples of floats, and are what and as many as the table says."""

    __slots__ = ()

    def __post_init__(self) -> None:
        sizes, spaces = _sizes_of(self), set[int]()
        try:
            for name in ("stamp_ns", "from_stamp_ns"):
                value: Any = getattr(self, name, 0)
                if type(value) is not int or value.bit_length() > 63:
                    object.__setattr__(self, name, int(np.int64(operator.index(value))))
            for name, allowed in sizes.items():
                value = getattr(self, name)
                if value is not None and not (type(value) is tuple and {float}.issuperset(map(type, value))):
                    value = tuple(map(float, np.ravel(value).tolist()))
                    object.__setattr__(self, name, value)
                if not value and self.__dataclass_fields__[name].default is not MISSING:  # type: ignore[attr-defined]
                    continue
                space = allowed.index(len(value))
                spaces.update([space] * (len(allowed) > 1))
                if "covariance" in name:
                    is_right = min(value[:: math.isqrt(len(value)) + 1]) >= 0.0
                else:
                    is_right = len(value) not in (4, 7) or abs(math.hypot(*value[-4:]) - 1.0) < _UNIT
                if not (is_right and all(map(math.isfinite, value))):
                    raise ValueError
        except (TypeError, ValueError, OverflowError):
            right = f"{' or '.join(map(str, sizes[name]))} finite numbers" if name in sizes else "whole nanoseconds"
            right += ", no variance negative" if "covariance" in name else ""
            right += ", in space with a quaternion (x, y, z, w) of length 1" if 7 in sizes.get(name, ()) else ""
            raise FormatError(f"{type(self).__name__}: {name} {value!r}: it must be {right}") from None
        if len(spaces) > 1:
            counts = " and ".join(f"{len(getattr(self, name) or ())} of {name}" for name in sizes)
            raise FormatError(f"{type(self).__name__}: its numbers are of the plane and of space: {counts}")


@dataclass(frozen=True, slots=True)
class Odometry(_Checked):
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


@dataclass(frozen=True, slots=True)
class AngularVelocity(_Checked):
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


@dataclass(frozen=True, slots=True)
class Sighting(_Checked):
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
        _Checked.__post_init__(self)
        object.__setattr__(self, "id", "" if self.id is None else str(self.id))  # of AprilTags it is a number


@dataclass(frozen=True, slots=True)
class Sightings(_Checked):
    """All observations of one message, at their common stamp."""

    stamp_ns: int
    topic: str
    sightings: tuple[Sighting, ...]

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        several = self.sightings if isinstance(self.sightings, Iterable) else (self.sightings,)
        object.__setattr__(self, "sightings", tuple(several))
        if wrong := {type(one) for one in self.sightings} - {Sighting}:
            raise FormatError(f"Sightings: one of its sightings is a {wrong.pop().__name__}, not a Sighting")


@dataclass(frozen=True, slots=True)
class Fix(_Checked):
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


@dataclass(frozen=True, slots=True)
class Closure(_Checked):
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


@dataclass(frozen=True, slots=True)
class InitialPose(_Checked):
    """A pose given by a user or another system; it is used from the next odometry on.

    Attributes
    ----------
    covariance : of ``T_map_base`` in its tangent space
    """

    T_map_base: Numbers
    covariance: Numbers


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
        _check_choice(self, self.event, EVENTS)
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


_SIZES: dict[type, Sizes] = {
    Odometry: {"T_odom_base": _POSE, "twist_covariance": _OF_POSE},
    AngularVelocity: {"rate": (1, 3), "covariance": (1, 9)},
    Sighting: {"T_base_sensor": _POSE},
    Sightings: {},
    Fix: {"point": (2, 3), "datum": (3,)},
    Closure: {"T_from_base": _POSE, "covariance": _OF_POSE},
    InitialPose: {"T_map_base": _POSE, "covariance": _OF_POSE},
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


def _sizes_of(one: Any) -> Sizes:
    kinds = {Sighting: SIGHTING_KINDS, Fix: FIX_KINDS}.get(type(one))
    if kinds is None:
        return _SIZES[type(one)]
    _check_choice(one, one.kind, kinds)
    return {**_KINDS[one.kind], **_SIZES[type(one)]}


def check_space(m: Measurement, dimensions: int) -> None:
    """Raise FormatError for what is no measurement, or is in the plane (2 dimensions) of a robot in space (3)."""
    if type(m) not in _NAMES:
        raise FormatError(f"{type(m).__name__} is not one of {', '.join(cls.__name__ for cls in _NAMES)}")
    for one in m.sightings if isinstance(m, Sightings) else () if isinstance(m, Control) else (m,):
        for name, allowed in _sizes_of(one).items():
            value, expected = getattr(one, name), allowed[min(dimensions - 2, len(allowed) - 1)]
            if value and len(value) != expected:
                raise FormatError(f"{type(m).__name__}: {name} is not of {dimensions} dimensions (world.dimensions)")


def to_record(measurement: Measurement) -> dict[str, Any]:
    """Plain dictionary of a measurement; floats survive JSON exactly."""
    out = {name: getattr(measurement, name) for name in measurement.__slots__}
    if isinstance(measurement, Sightings):
        out["sightings"] = tuple(map(sighting_record, measurement.sightings))
    return {"type": _NAMES[type(measurement)], **out}


def sighting_record(one: Sighting) -> dict[str, Any]:
    """Plain dictionary of a sighting. It has a size only where that is known."""
    return {name: getattr(one, name) for name in one.__slots__ if name != "size" or one.size}


def from_record(record: dict[str, Any]) -> Measurement:
    """Inverse of ``to_record``. Raises FormatError naming the field that is missing or unknown."""
    fields = dict(record)
    cls = _TYPES.get(fields.pop("type", ""))
    if cls is None:
        raise FormatError(f"unknown kind of measurement {record.get('type')!r}")
    try:
        if cls is Sightings:
            fields["sightings"] = tuple(Sighting(**one) for one in fields["sightings"])
        if cls is Control:
            fields["values"] = tuple(
                (name, tuple(value) if isinstance(value, list) else value) for name, value in fields.get("values", ())
            )
        return cls(**fields)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{record['type']}: {error}") from None
