"""Measurements and events for ``GraphSlam.process``: frozen values, checked at the border, exact in JSON.

A pose is (x, y, theta) in the plane and (x, y, z, qx, qy, qz, qw) in space. Covariances are flat, row-major, in tangent
order: (x, y, theta), or (x, y, z, rotation vector). Nothing here tells which message it came from.
"""

from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias, get_args

from graph_slam_ros.errors import FormatError
from graph_slam_ros.typing import Numbers

SIGHTING_KINDS = ("position", "pose", "range_bearing", "bearing", "range")
FIX_KINDS = ("pose", "position", "heading", "attitude")
Event: TypeAlias = Literal[
    "flush", "end", "optimize", "clear_closures", "time_jump", "set", "remove", "memory", "restart"
]
EVENTS: tuple[Event, ...] = get_args(Event)
_VALUES: dict[Event, dict[str, type]] = {"memory": {"is_short": bool}, "remove": {"edge": int, "landmark": str}}


def _check_choice(cls: type, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise FormatError(f"{cls.__name__}: {value!r} is not one of {', '.join(choices)}")


@dataclass(frozen=True, slots=True)
class Odometry:
    """Absolute pose in the odometry frame; only the motion between two of them is ever used.

    Attributes
    ----------
    twist_covariance : 9 (36) numbers, (m/s, rad/s) in the base frame, or None where unknown
    source : which odometry it is, where there are several; their priority is in the configuration
    """

    stamp_ns: int
    T_odom_base: Numbers
    twist_covariance: Numbers | None = None
    source: str = "odometry"


@dataclass(frozen=True, slots=True)
class Sighting:
    """A landmark, seen by a sensor of the robot.

    Attributes
    ----------
    id : its identity; empty where the sensor does not know it
    kind : what was measured
    measured : by ``kind``: of ``position`` and ``pose``, the point or pose in the base frame; else in the sensor's:
        of ``range_bearing`` (range, bearing) or (range, azimuth, elevation), of ``bearing`` the same without the range,
        of ``range`` one number
    covariance : of ``measured``: of a position in the axes of the base frame, of a pose in its tangent space
    T_base_sensor : where the sensor is, for the kinds that are measured in its frame; None: at the base

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

    def __post_init__(self) -> None:
        _check_choice(Sighting, self.kind, SIGHTING_KINDS)


@dataclass(frozen=True, slots=True)
class Sightings:
    """All landmarks of one message, at the stamp they were seen."""

    stamp_ns: int
    topic: str
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True)
class Fix:
    """An absolute measurement in the map frame: a receiver's position, a compass, a pose from elsewhere.

    Attributes
    ----------
    measured : by ``kind``: of ``pose``, T_map_base; of ``position``, the coordinates of ``point`` in map; of
        ``heading``, one angle; of ``attitude``, the quaternion (x, y, z, w) of R_map_base, in space only
    covariance : of ``measured``: of a position in the axes of map, where a variance of 1e6 m^2 or more says that an
        axis is not known; of a pose or attitude in its tangent space
    point : of ``position``, the antenna in the base frame; empty: its origin
    datum : of a position on earth, latitude [deg], longitude [deg] and height [m] of the map's origin

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


@dataclass(frozen=True, slots=True)
class Closure:
    """A loop closure: where the robot at one stamp was, seen from where it was at an earlier one.

    Attributes
    ----------
    from_stamp_ns : the earlier (or later) stamp
    T_from_base : the base at ``stamp_ns`` in the base at ``from_stamp_ns``
    covariance : of that pose in its tangent space
    """

    stamp_ns: int
    from_stamp_ns: int
    topic: str
    T_from_base: Numbers
    covariance: Numbers


@dataclass(frozen=True, slots=True)
class InitialPose:
    """A pose that somebody gives; it holds from the next odometry on.

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
    event : ``flush`` processes the measurements that wait for their turn; ``end`` also drops those that no odometry
        reached; ``optimize`` solves now; ``clear_closures`` removes all loop closures; ``time_jump`` begins a segment
        whose stamps may be older; ``set`` changes parameters; ``remove`` removes an edge or a landmark; ``memory``
        begins or ends a shortage of memory; ``restart`` goes back to the last good estimate after a fault outside
    values : names and values; of ``set``, the parameters; of ``remove``, ``edge`` and its id or ``landmark`` and its
        name; of ``memory``, ``is_short``; else none

    Raises
    ------
    FormatError
        ``event`` is not one of ``EVENTS``, or ``values`` are not what it needs.
    """

    event: Event
    values: tuple[tuple[str, bool | int | float | str], ...] = ()

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


Observation: TypeAlias = Sightings | Fix | Closure
Measured: TypeAlias = Odometry | Sightings | Fix | Closure
Measurement: TypeAlias = Odometry | Observation | InitialPose | Control

_TYPES = {
    "odometry": Odometry,
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
        case _:
            return {"type": _NAMES[type(measurement)], **asdict(measurement)}


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
            fields["values"] = tuple((name, value) for name, value in fields.get("values", ()))
        return cls(**_tuples(fields))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{record['type']}: {error}") from None


def _tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
