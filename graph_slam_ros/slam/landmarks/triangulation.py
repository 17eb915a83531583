"""Triangulation of a landmark from ranges and bearings at known places: all places that fit, and how well.

One range leaves a circle, two ranges leave two points, and bearings from one place leave a ray. So the search starts at
many points of the circle, sphere or ray of the first sighting. Each start is refined to the nearest least squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.frontend.motion_compensation import gradient, point_of, predict
from graph_slam_ros.typing import Array, Numbers

_DISTANCES_M = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # along a ray
_DIRECTIONS = {2: 16, 3: 64}
_ITERATIONS = 30
_ARRIVED_M = 1e-5
_ONE_PLACE_M = 1e-2
_LEAST_CURVATURE = 1e-12


Field = tuple[str, Array, Array, Array, Array]


@dataclass(frozen=True, slots=True)
class PartialObservation:
    """One sighting from a sensor pose that is assumed known.

    Attributes
    ----------
    T_map_sensor : where the sensor was
    kind, measured : as in ``Sighting``
    covariance : (m, m)
    """

    T_map_sensor: Numbers
    kind: str
    measured: Numbers
    covariance: Array


@dataclass(frozen=True, slots=True)
class PositionHypothesis:
    """A possible position of a landmark, its covariance (n, n), infinite if undetermined, and the sightings' chi2."""

    position: Array
    covariance: Array
    chi2: float


def places(space: Geometry, glances: Sequence[PartialObservation]) -> list[PositionHypothesis]:
    """All local minima of the misfit to the sightings, the best first."""
    found: list[PositionHypothesis] = []
    for place in _descend(space, _fields(space, glances), np.array(_starts(space, glances[0]))):
        if all(np.linalg.norm(place.position - other.position) > _ONE_PLACE_M for other in found):
            found.append(place)
    return sorted(found, key=lambda place: place.chi2)


def _fields(space: Geometry, glances: Sequence[PartialObservation]) -> list[Field]:
    """The observations by kind: rotations (k, n, n), positions (k, n), measurements (k, m), whitening (k, m, m)."""
    out = []
    n = space.dimensions
    for kind in dict.fromkeys(glance.kind for glance in glances):
        members = [glance for glance in glances if glance.kind == kind]
        turns = np.array([space.turn(g.T_map_sensor) for g in members])
        at = np.array([g.T_map_sensor[:n] for g in members])
        whiten = np.linalg.inv(np.linalg.cholesky(np.array([g.covariance for g in members])))
        out.append((kind, turns, at, np.array([g.measured for g in members]), whiten))
    return out


def _starts(space: Geometry, glance: PartialObservation) -> list[Array]:
    if glance.kind == "range":
        points = glance.measured[0] * _directions(space.dimensions)
    else:
        far = (glance.measured[0],) if glance.kind == "range_bearing" else _DISTANCES_M
        angles = glance.measured[-(space.dimensions - 1) :]
        points = np.array([point_of(space, (distance, *angles)) for distance in far])
    return [np.array(space.group.act(glance.T_map_sensor, tuple(p))) for p in points.tolist()]


def _directions(n: int) -> Array:
    """Unit vectors, evenly spread (in space along a spiral)."""
    k = np.arange(_DIRECTIONS[n]) + 0.5
    if n == 2:
        angle = 2.0 * np.pi * k / len(k)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z, angle = 1.0 - 2.0 * k / len(k), np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _descend(space: Geometry, fields: list[Field], starts: Array) -> list[PositionHypothesis]:
    """Levenberg-Marquardt from all starts at once, each to the nearest minimum. Returns those that converge, in order.

    Parameters
    ----------
    starts : (s, n)
    """
    n, at, damping = space.dimensions, starts.copy(), np.full(len(starts), 1e-3)
    chi2, b, h = _normal(space, fields, at)
    under_way, has_arrived = np.arange(len(starts)), np.zeros(len(starts), dtype=bool)
    for _ in range(_ITERATIONS):
        k = under_way
        lift = damping[k, None] * np.einsum("kii->ki", h[k]) + _LEAST_CURVATURE
        step = -np.linalg.solve(h[k] + lift[..., None] * np.eye(n), b[k, :, None])[..., 0]
        tried = at[k] + step
        chi2_there, b_there, h_there = _normal(space, fields, tried)
        goes = ~(chi2_there > chi2[k])
        gone = k[goes]
        at[gone], chi2[gone], b[gone], h[gone] = tried[goes], chi2_there[goes], b_there[goes], h_there[goes]
        damping[k] *= np.where(goes, 0.1, 10.0)
        is_short = np.linalg.norm(step, axis=1) < _ARRIVED_M * (1.0 + np.linalg.norm(tried, axis=1))
        has_arrived[k] = goes & is_short
        under_way = k[~has_arrived[k]]
        if not len(under_way):
            break
    arrived = np.flatnonzero(has_arrived).tolist()
    return [PositionHypothesis(at[k], _covariance(h[k]), float(chi2[k])) for k in arrived]


def _covariance(information: Array) -> Array:
    values = np.linalg.eigvalsh(information)
    if values[0] <= max(_LEAST_CURVATURE, 1e-9 * values[-1]):
        return np.full_like(information, np.inf)
    inverse: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return inverse


def _normal(space: Geometry, fields: list[Field], at: Array) -> tuple[Array, Array, Array]:
    """chi2 (s,), gradients (s, n) and Gauss-Newton matrices (s, n, n) at points (s, n)."""
    n = space.dimensions
    chi2, b, h = np.zeros(len(at)), np.zeros(at.shape), np.zeros((*at.shape, n))
    for kind, turns, sensors, measured, whiten in fields:
        p = np.einsum("kij,ski->skj", turns, at[:, None] - sensors)
        r = predict(space, kind, p) - measured
        first_angle = 0 if kind == "bearing" else 1
        r[..., first_angle:] = se2.wrap(r[..., first_angle:])
        j = gradient(space, kind, p) @ np.swapaxes(turns, 1, 2)
        j = (whiten @ j).reshape(len(at), -1, n)
        r = (whiten @ r[..., None]).reshape(len(at), -1, 1)
        transposed = np.swapaxes(j, 1, 2)
        chi2 += np.sum(r * r, axis=(1, 2))
        b += (transposed @ r)[..., 0]
        h += transposed @ j
    return chi2, b, h
