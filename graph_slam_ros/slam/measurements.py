"""What can be handed to ``GraphSlam.process``: frozen values, checked at the border, exact in JSON.

Covariances are flat, row-major, in tangent order (x, y, theta).
"""

from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

from graph_slam_ros.errors import FormatError
from graph_slam_ros.lie import se2


@dataclass(frozen=True, slots=True)
class Odometry:
    """Absolute pose in the odometry frame; only the motion between two of them is ever used.

    Attributes
    ----------
    twist_covariance : 9 numbers, (m/s, m/s, rad/s) in the base frame, or None where unknown
    """

    stamp_ns: int
    T_odom_base: se2.Pose
    twist_covariance: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Sighting:
    """A landmark with identity, seen from the base frame.

    Attributes
    ----------
    measured : (x, y) of a point, or (x, y, theta) where the landmark's orientation was seen too
    covariance : 4 numbers in the axes of the base frame, or 9 in the tangent space of the measured pose
    """

    id: str
    measured: tuple[float, ...]
    covariance: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Sightings:
    """All landmarks of one message, at the stamp they were seen."""

    stamp_ns: int
    topic: str
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True)
class Control:
    """An event that is not a measurement.

    ``flush`` releases what waits for its turn, ``end`` also gives up what no odometry reached, ``optimize`` solves now.
    """

    event: str


Measurement: TypeAlias = Odometry | Sightings | Control

_TYPES = {"odometry": Odometry, "sightings": Sightings, "control": Control}
_NAMES = {cls: name for name, cls in _TYPES.items()}


def to_record(measurement: Measurement) -> dict[str, Any]:
    """Plain dictionary of a measurement; floats survive JSON exactly."""
    match measurement:
        case Odometry(stamp_ns, pose, covariance):  # by hand: thousands a second
            return {"type": "odometry", "stamp_ns": stamp_ns, "T_odom_base": pose, "twist_covariance": covariance}
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
        return cls(**_tuples(fields))
    except (KeyError, TypeError) as error:
        raise FormatError(f"{record['type']}: {error}") from None


def _tuples(fields: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
