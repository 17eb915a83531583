"""Motion compensation: the motion from the keyframe to a measurement, and its noise, are added.

Throughout, ``T_a_b`` is the base b seen from its keyframe a, with covariance M in right tangent coordinates: the true
motion is ``T_a_b Exp(m)``. A point p of b then moves by ``B m`` with ``B = [I, -hat(p)]``, in the axes of b.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import so3
from graph_slam_ros.measurements.types import Closure, Fix, Sighting, Sightings
from graph_slam_ros.slam import levels
from graph_slam_ros.typing import Array, Numbers

ROUNDING = 100.0 * float(np.finfo(float).eps)  # of the largest variance that was added up to a covariance
_STEEP = 0.2  # cosine of an elevation: at 78.5 degrees and above the azimuth is turned away from the pole
_UNKNOWN_M2 = 1e6  # a variance of this or more says that an axis was not measured


@dataclass(frozen=True, slots=True)
class PoseAtStamp:
    """The pose at a stamp: a keyframe, and the motion since with its covariance (dof, dof)."""

    keyframe: int
    vertex: int
    stamp_ns: int
    T_keyframe_base: Numbers
    covariance: Array


@dataclass(frozen=True, slots=True)
class KeyframeMeasurement:
    """A measurement as its edge needs it: expressed from the keyframe, and its covariance."""

    measured: Numbers
    covariance: Array


def point_jacobian(space: Geometry, point: Array) -> Array:
    """Return ``B`` (n, dof) of a point (n,) in the base frame."""
    n = space.dimensions
    if n == 2:
        return np.array([[1.0, 0.0, -point[1]], [0.0, 1.0, point[0]]])
    return np.hstack([np.eye(3), -so3.hat((point[0], point[1], point[2]))])


def position(space: Geometry, s: Sighting, where: PoseAtStamp) -> KeyframeMeasurement:
    """Return a landmark's position, seen as a position or a pose: ``p_a = T_a_b p_b``."""
    n = space.dimensions
    point = np.array(s.measured[:n])
    own = as_matrix(s.covariance)
    if s.kind == "pose":  # from the tangent space of the measured pose to the axes of b
        own = space.in_parent_axes(s.measured, own)[:n, :n]
    b, turn = point_jacobian(space, point), space.turn(where.T_keyframe_base)
    covariance = turn @ (own + b @ where.covariance @ b.T) @ turn.T
    return KeyframeMeasurement(_floats(space.group.act(where.T_keyframe_base, tuple(point.tolist()))), covariance)


def pose(space: Geometry, s: Sighting, where: PoseAtStamp) -> KeyframeMeasurement:
    """Return a landmark's pose: ``T_a_c = T_a_b T_b_c``."""
    measured = space.group.compose(where.T_keyframe_base, s.measured)
    return KeyframeMeasurement(
        _floats(measured), space.group.propagate(where.covariance, s.measured, as_matrix(s.covariance))
    )


def seen_from_sensor(space: Geometry, s: Sighting, where: PoseAtStamp, p_keyframe: Array) -> KeyframeMeasurement:
    """Return range, bearing or both, with the sensor's position relative to the keyframe.

    Parameters
    ----------
    p_keyframe : (n,) where the landmark is thought to be, from the keyframe; the motion's noise depends on it
    """
    T_base_sensor = s.T_base_sensor or space.identity
    p_base = np.array(space.group.act(space.group.inverse(where.T_keyframe_base), tuple(p_keyframe.tolist())))
    p_sensor = np.array(space.group.act(space.group.inverse(T_base_sensor), tuple(p_base.tolist())))
    j = gradient(space, s.kind, p_sensor) @ space.turn(T_base_sensor).T @ point_jacobian(space, p_base)
    covariance = as_matrix(s.covariance) + j @ where.covariance @ j.T
    return KeyframeMeasurement(
        (*s.measured, *_floats(space.group.compose(where.T_keyframe_base, T_base_sensor))), covariance
    )


def motion_noise_dominates(
    space: Geometry,
    m: Sightings | Fix | Closure,
    where: PoseAtStamp,
    most: float,
    added_sigma_m: float,
    sharpest: bool = False,
) -> bool:
    """Return whether the motion's noise, which is common to a whole message, is too large a part of the variance.

    Parameters
    ----------
    most : part of the variance
    added_sigma_m : what is added to sightings besides
    sharpest : the least variance of any direction of a sighting counts, not that of all directions
    """
    n, motion = space.dimensions, where.covariance
    moved, turned = float(np.trace(motion[:n, :n])), float(np.trace(motion[n:, n:]))
    if isinstance(m, Sightings):
        return any(_adds(space, s, moved, turned, most, added_sigma_m**2, sharpest) for s in m.sightings)
    own = float(np.trace(as_matrix(m.covariance)))
    if isinstance(m, Fix) and m.kind != "pose":
        return (moved if m.kind == "position" else turned) > most * own
    return moved + turned > most * own


def _adds(space: Geometry, s: Sighting, moved: float, turned: float, most: float, added: float, sharpest: bool) -> bool:
    own = np.diag(as_matrix(s.covariance)).tolist()
    if s.kind == "bearing":
        return turned > most * sum(own)
    if s.kind == "range":
        return moved > most * (own[0] + added)
    if s.kind == "range_bearing":
        far = s.measured[0]
        along, across = own[0], far**2 * np.array(own[1:])
        variance = min(along, *across) if sharpest else along + sum(across)
        return bool(moved + far**2 * turned > most * (variance + added))
    n = space.dimensions
    far = float(np.linalg.norm(s.measured[:n]))
    if sharpest:
        least = float(np.linalg.eigvalsh(as_matrix(s.covariance)[:n, :n])[0])
        return moved + far**2 * turned > most * (least + added)
    return moved + far**2 * turned > most * (sum(own[:n]) + n * added)


def as_matrix(flat: Numbers) -> Array:
    """Return a covariance as a matrix."""
    size = round(len(flat) ** 0.5)
    return np.array(flat).reshape(size, size)


def gradient(space: Geometry, kind: str, p: Array) -> Array:
    """Return the derivative (..., m, n) of range, bearing or both at points p (..., n) in the sensor's frame."""
    flat = np.maximum(np.hypot(p[..., 0], p[..., 1]), levels.ROUNDING)
    far = np.maximum(np.linalg.norm(p, axis=-1), levels.ROUNDING)
    rows = []
    if kind in ("range", "range_bearing"):
        rows.append(p / far[..., None])
    if kind in ("bearing", "range_bearing"):
        across = np.zeros_like(p)
        across[..., 0], across[..., 1] = -p[..., 1] / flat**2, p[..., 0] / flat**2
        rows.append(across)
        if space.dimensions == 3:
            up = [-p[..., 0] * p[..., 2] / flat, -p[..., 1] * p[..., 2] / flat, flat]
            rows.append(np.stack(up, axis=-1) / far[..., None] ** 2)
    return np.stack(rows, axis=-2)


def predict(space: Geometry, kind: str, p: Array) -> Array:
    """Return the measurement (..., m) that a sensor makes of points p (..., n) in its frame."""
    predicted = []
    if kind in ("range", "range_bearing"):
        predicted.append(np.linalg.norm(p, axis=-1))
    if kind in ("bearing", "range_bearing"):
        predicted.append(np.arctan2(p[..., 1], p[..., 0]))
        if space.dimensions == 3:
            predicted.append(np.arctan2(p[..., 2], np.hypot(p[..., 0], p[..., 1])))
    return np.stack(predicted, axis=-1)


def point_of(space: Geometry, measured: Numbers) -> Array:
    """Return the point (n,) in the sensor's frame for a range and bearing."""
    far, azimuth = measured[0], measured[1]
    if space.dimensions == 2:
        return far * np.array([np.cos(azimuth), np.sin(azimuth)])
    flat = far * np.cos(measured[2])
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), far * np.sin(measured[2])])


def polar_derivative(space: Geometry, measured: Numbers) -> Array:
    """Return the derivative (n, n) of that point with respect to range and angles."""
    far, azimuth = measured[0], measured[1]
    c, s = np.cos(azimuth), np.sin(azimuth)
    if space.dimensions == 2:
        return np.array([[c, -far * s], [s, far * c]])
    level, up = np.cos(measured[2]), np.sin(measured[2])
    return np.array(
        [
            [level * c, -far * level * s, -far * up * c],
            [level * s, far * level * c, -far * up * s],
            [up, 0.0, far * level],
        ]
    )


def fix(space: Geometry, m: Fix, where: PoseAtStamp, T_map_keyframe: Numbers) -> KeyframeMeasurement:
    """Return an absolute measurement of the robot as one of its keyframe.

    Parameters
    ----------
    T_map_keyframe : where the keyframe is thought to be: what of the motion a position or heading sees depends on it
    """
    group, T_a_b = space.group, where.T_keyframe_base
    own = as_matrix(m.covariance)
    if m.kind == "pose":
        into = group.adjoint(T_a_b)
        return KeyframeMeasurement(
            _floats(group.compose(m.measured, group.inverse(T_a_b))), into @ (own + where.covariance) @ into.T
        )
    if m.kind == "position":
        point = np.array(m.point or (0.0,) * space.dimensions)
        turn = space.turn(group.compose(T_map_keyframe, T_a_b))
        j = turn @ point_jacobian(space, point)
        antenna = _floats(group.act(T_a_b, tuple(point.tolist())))
        return KeyframeMeasurement((*m.measured, *antenna), own + j @ where.covariance @ j.T)
    if m.kind == "attitude":
        turn = space.turn(T_a_b)
        back = so3.inverse((T_a_b[3], T_a_b[4], T_a_b[5], T_a_b[6]))
        q = so3.compose((m.measured[0], m.measured[1], m.measured[2], m.measured[3]), back)
        return KeyframeMeasurement(_floats(q), turn @ (own + where.covariance[3:, 3:]) @ turn.T)
    yaw = space.heading(T_map_keyframe) - space.heading(group.compose(T_map_keyframe, T_a_b))
    return KeyframeMeasurement((m.measured[0] + float(yaw),), own + where.covariance[-1:, -1:])


def axes_unknown(covariance: Array) -> NDArray[np.bool_]:
    """Return the axes (n,) along which a covariance (n, n) of a position states nothing."""
    unknown: NDArray[np.bool_] = np.diag(covariance) >= 0.5 * _UNKNOWN_M2
    return unknown


def axes_known(covariance: Array) -> list[tuple[Array, float]]:
    """Return the directions (n,) along which a position was measured and their variances; None if all axes were."""
    if np.diag(covariance).max() < _UNKNOWN_M2:
        return []
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, ROUNDING * values[-1])  # of what nearly nothing is known beside, the rest is rounding
    return [(v, float(value)) for value, v in zip(values, vectors.T, strict=True) if value < 0.5 * _UNKNOWN_M2]


def closure(space: Geometry, m: Closure, earlier: PoseAtStamp, later: PoseAtStamp) -> KeyframeMeasurement:
    """Return a closure of keyframes, ``T_a_d = T_a_b T_b_c T_d_c^-1``: base b at the earlier stamp, c at the later."""
    group = space.group
    to_c = group.propagate(earlier.covariance, m.T_from_base, as_matrix(m.covariance))
    into = group.adjoint(later.T_keyframe_base)
    back = group.inverse(later.T_keyframe_base)
    measured = group.compose(group.compose(earlier.T_keyframe_base, m.T_from_base), back)
    return KeyframeMeasurement(_floats(measured), into @ (to_c + later.covariance) @ into.T)


def _floats(numbers: tuple[float, ...]) -> Numbers:
    return tuple(map(float, numbers))


def off_the_pole(space: Geometry, s: Sighting) -> Sighting:
    """Return the same sighting; a steep direction in space is expressed in a sensor frame that looks along it.

    At the zenith and the nadir azimuth is undefined and its derivative infinite. So the sensor's frame is rotated until
    its x axis points along the measured direction: azimuth and elevation are both 0. The sigma across the direction is
    that of the elevation, or ``sigma_azimuth cos(elevation)`` if that is larger.
    """
    if space.dimensions == 2 or s.kind not in ("bearing", "range_bearing"):
        return s
    azimuth, elevation = s.measured[-2:]
    if math.cos(elevation) >= _STEEP:
        return s
    half_a, half_e = 0.5 * azimuth, -0.5 * elevation
    ca, sa, ce, se = math.cos(half_a), math.sin(half_a), math.cos(half_e), math.sin(half_e)
    turn = (-sa * se, ca * se, sa * ce, ca * ce)  # about z by the azimuth, then about y by minus the elevation
    sensor = space.group.compose(s.T_base_sensor or space.identity, (0.0, 0.0, 0.0, *turn))
    scale = np.ones(len(s.measured))
    scale[-2] = abs(math.cos(elevation))
    covariance = scale[:, None] * as_matrix(s.covariance) * scale
    covariance[-2, -2] = max(covariance[-2, -2], covariance[-1, -1])
    measured = (*s.measured[:-2], 0.0, 0.0)
    return replace(s, measured=measured, covariance=tuple(covariance.ravel().tolist()), T_base_sensor=sensor)
