"""Observations from landmark messages: one rule for all types.

A converter of a type only reads: it yields one ``ObservedLandmark`` for each landmark of a message.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from graph_slam_ros.errors import FormatError
from graph_slam_ros.graph.geometry import SPATIAL
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.measurements.types import Sighting, Sightings
from graph_slam_ros.messages.inputs import checks
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.source import InputContext
from graph_slam_ros.typing import Numbers

_AGREE_SIGMA = 3.0
_LONGEST_ID = 128  # bytes
_UPRIGHT = 1e-6
_MOST = 1000  # landmarks that are used of one message: what has more is a scan
_LARGEST_M = 1e3  # no landmark is larger
_POLAR = {"range": (1,), "bearing": (1, 2), "range_bearing": (2, 3)}  # numbers of each kind, by SIGHTING_KINDS


@dataclass(frozen=True, slots=True)
class ObservedLandmark:
    """One landmark as a message describes it.

    Attributes
    ----------
    stamp, frame : of its header
    id : its identity; empty where unknown
    position : Point or Vector3 message in the frame, or None where ``polar`` is given
    orientation : Quaternion message, or None
    covariance : 36 numbers in the axes of the frame, or None where the message has none
    polar : (kind, measured) in the sensor's frame, kinds as of ``Sighting``
    sigmas : standard deviations of ``polar``, one for each number of it; None or zero where unknown
    T_frame_sensor : where the sensor is in the frame
    sort : its class, used where ``id`` is empty: sightings of two classes are never of one landmark
    size : of the landmark [m], used where ``id`` is empty; zero where unknown

    Raises
    ------
    FormatError
        ``polar`` is of no such kind, or has more or fewer numbers.
    """

    stamp: Any
    frame: str
    id: str
    position: Any = None
    orientation: Any = None
    covariance: Any = None
    polar: tuple[str, Numbers] | None = None
    sigmas: Sequence[float] | None = None
    T_frame_sensor: se3.Pose = se3.IDENTITY
    sort: str = ""
    size: float = 0.0

    def __post_init__(self) -> None:
        if self.polar is not None and len(self.polar[1]) not in _POLAR.get(self.polar[0], ()):
            kinds = ", ".join(f"{kind} has {' or '.join(map(str, sizes))}" for kind, sizes in _POLAR.items())
            raise FormatError(f"polar: {self.polar[0]!r} with {len(self.polar[1])} numbers; {kinds}")


def sightings(source: InputContext, found: Iterable[ObservedLandmark]) -> Iterator[Sightings]:
    """One measurement for each stamp of a message. What cannot be used is counted."""
    by_stamp: dict[tuple[int, int], list[ObservedLandmark]] = {}
    for one in _nearest(source, list(found)):
        by_stamp.setdefault((one.stamp.sec, one.stamp.nanosec), []).append(one)
    for stamp_ns, seen in source.each(by_stamp.values(), lambda same: (source.stamp_ns(same[0].stamp), same)):
        usable = _agreed(source, [*source.each(seen, partial(_sighting, source, stamp_ns))])
        if usable:
            yield Sightings(stamp_ns, source.name, tuple(usable))


def _size(source: InputContext, size: float) -> float:
    """The size of a landmark; zero where it is no length."""
    if 0.0 <= size <= _LARGEST_M:
        return float(size)
    source.count("size_unknown")
    return 0.0


def _nearest(source: InputContext, found: list[ObservedLandmark]) -> list[ObservedLandmark]:
    if len(found) <= _MOST:
        return found
    source.count("too_many", len(found) - _MOST)
    nearest = np.argsort([_reach(one) for one in found], kind="stable")[:_MOST]  # no number sorts last
    return [found[k] for k in sorted(nearest.tolist())]


def _reach(seen: ObservedLandmark) -> float:
    """The distance from the frame of the message; zero for a bearing alone."""
    if seen.polar is None:
        return math.hypot(seen.position.x, seen.position.y, seen.position.z)
    kind, measured = seen.polar
    return 0.0 if kind == "bearing" else abs(measured[0])


def _sighting(source: InputContext, stamp_ns: int, seen: ObservedLandmark) -> Sighting:
    out = _measured(source, stamp_ns, seen)
    return out if out.id else replace(out, sort=seen.sort, size=_size(source, seen.size))


def _measured(source: InputContext, stamp_ns: int, seen: ObservedLandmark) -> Sighting:
    name = _identity(source, seen.id)
    T_base_frame = source.T_base(source.frame(seen.frame), stamp_ns)
    if seen.polar is not None:
        kind, measured = seen.polar
        return _polar(source, name, kind, measured, seen.sigmas, se3.compose(T_base_frame, seen.T_frame_sensor))
    p = tuple(source.settings.range_factor * x for x in checks.point(seen.position))
    x, y, z = map(float, se3.act(T_base_frame, p))
    distance_m = math.hypot(x, y, z)
    covariance = SPATIAL.in_parent_axes(T_base_frame, source.pose_covariance(seen.covariance, distance_m))
    n, sensor = source.space.dimensions, _sensor(source, T_base_frame)
    if seen.orientation is not None and source.orientation_known(covariance):
        q = so3.compose(se3.rotation(T_base_frame), source.unit(seen.orientation))
        T_base_seen = (x, y, z, *q)
        if source.has_heading(T_base_seen):
            at = source.projected(T_base_seen)
            block = np.reshape(source.checked(source.block(covariance), n, distance_m), (source.space.dof, -1))
            return Sighting(name, "pose", at, tuple(source.space.in_tangent(at, block).ravel().tolist()), sensor)
    return Sighting(name, "position", (x, y, z)[:n], source.checked(covariance[:n, :n], n, distance_m), sensor)


def _sensor(source: InputContext, T_base_frame: se3.Pose) -> Numbers | None:
    """The pose of a sensor on the base, about whose origin a correction turns it; None at the base."""
    at, n = se3.position(T_base_frame), source.space.dimensions
    if not any(at[:n]):
        return None
    return (*map(float, at[:n]), *source.space.identity[n:])


def _identity(source: InputContext, name: str) -> str:
    name = (name or source.settings.id).strip()
    if not name or source.config.landmarks.id_from == "none":  # what becomes of it is the pipeline's to say
        return ""
    name = source.settings.id_prefix + name
    if len(name.encode()) > _LONGEST_ID:
        raise MessageError("id_too_long")
    return str(name)


# -- ranges and bearings ---------------------------------------------------------------------------------------------


def _polar(
    source: InputContext,
    name: str,
    kind: str,
    measured: Numbers,
    sigmas: Sequence[float] | None,
    T_base_sensor: se3.Pose,
) -> Sighting:
    if not all(map(math.isfinite, measured)):
        raise MessageError("nonfinite")
    has_range = kind != "bearing"
    if has_range and not 0.0 < measured[0] < 1e9:
        raise MessageError("range_not_positive")
    if kind != "range":
        angles, is_wrapped = checks.direction(*measured[int(has_range) :])
        if is_wrapped:
            source.count("bearing_wrapped")
        measured = (*measured[: int(has_range)], *angles[: len(measured) - int(has_range)])
    has_covariances = sigmas is not None and source.settings.noise == "message"
    out = [float(s) for s in sigmas] if has_covariances and sigmas is not None else [0.0] * len(measured)
    for k, sigma in enumerate(out):
        if not math.isfinite(sigma) or sigma < 0.0:
            raise MessageError("nonfinite_covariance")
        if sigma == 0.0:
            out[k] = source.sigma_m(measured[0]) if has_range and k == 0 else source.settings.sigma_rad
            if out[k] == 0.0:
                raise MessageError("noise_unknown")
            if has_covariances:
                source.count("covariance_unknown")
    if source.space.dimensions == 2 and kind != "range":
        measured, out = _levelled(kind, measured, out, T_base_sensor)
        T_base_sensor = (*se3.position(T_base_sensor), *so3.IDENTITY)
    elif source.space.dimensions == 3 and len(measured) == (2 if has_range else 1) and kind != "range":
        raise MessageError("no_elevation")
    covariance = source.checked(np.diag([sigma * sigma for sigma in out]), int(has_range))
    return Sighting(name, kind, tuple(map(float, measured)), covariance, source.projected(T_base_sensor))


def _levelled(
    kind: str, measured: Numbers, sigmas: list[float], T_base_sensor: se3.Pose
) -> tuple[Numbers, list[float]]:
    """The horizontal part, as a sensor at the same place with the base's axes would measure it."""
    angles = 1 if kind == "range_bearing" else 0
    azimuth, elevation = (*measured[angles:], 0.0)[:2]
    up = so3.act(se3.rotation(T_base_sensor), (0.0, 0.0, 1.0))
    if len(measured) == angles + 1 and abs(up[2]) < 1.0 - _UPRIGHT:
        raise MessageError("sensor_tilted")  # then an azimuth alone is no direction in the plane
    level = math.cos(elevation)
    towards = (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation))
    x, y, _ = map(float, so3.act(se3.rotation(T_base_sensor), towards))
    horizontal = math.hypot(x, y)
    if horizontal < 0.1:
        raise MessageError("overhead")
    bearing, sigma_rad = math.atan2(y, x), sigmas[angles] / horizontal
    if kind == "range_bearing":
        return (measured[0] * horizontal, bearing), [sigmas[0], sigma_rad]
    return (bearing,), [sigma_rad]


# -- the same landmark twice -----------------------------------------------------------------------------------------


def _agreed(source: InputContext, seen: list[Sighting]) -> list[Sighting]:
    """One sighting per id: repeats that agree within 3 sigma are merged, all others of that id are dropped."""
    by_id: dict[str, list[Sighting]] = {}
    for k, one in enumerate(seen):
        by_id.setdefault(one.id or f"\n{k}", []).append(one)  # those without an id are each their own
    out = []
    for same in by_id.values():
        merged = same[0]
        for other in same[1:]:
            fused = _merge(source, merged, other)
            if fused is None:
                source.count("id_conflict", len(same))
                break
            merged = fused
        else:
            if len(same) > 1:
                source.count("id_merged", len(same) - 1)
            out.append(merged)
    return out


def _merge(source: InputContext, a: Sighting, b: Sighting) -> Sighting | None:
    """The information-weighted mean of two sightings that agree, else None."""
    if a.kind != b.kind:
        return None
    group, m = source.space.group, math.isqrt(len(a.covariance))
    if a.kind == "pose":
        difference = np.array(group.local(b.measured, a.measured))
    else:
        difference = np.subtract(b.measured, a.measured)
        if "bearing" in a.kind:
            angles = slice(1 if a.kind == "range_bearing" else 0, None)
            difference[angles] = se2.wrap(difference[angles])
    cov_a, cov_b = np.array(a.covariance).reshape(m, m), np.array(b.covariance).reshape(m, m)
    gain = cov_a @ np.linalg.inv(cov_a + cov_b)
    if difference @ np.linalg.solve(cov_a + cov_b, difference) > _AGREE_SIGMA**2:
        return None
    if a == b:
        return a
    step = (gain @ difference).tolist()
    at = group.retract(a.measured, tuple(step)) if a.kind == "pose" else np.add(a.measured, step).tolist()
    merged = cov_a - gain @ cov_a
    covariance = tuple((0.5 * (merged + merged.T)).ravel().tolist())
    return replace(a, measured=tuple(map(float, at)), covariance=covariance)
