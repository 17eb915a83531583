"""Where a landmark can be, from ranges and bearings taken at known places: all places that fit, and how well.

A range from one place leaves a circle, from two places two points; bearings from one place leave a ray. So the search
begins at many points of the circle, sphere or ray that the first sighting leaves, each followed to the least squares
next to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.slam.carry import gradient, point_of, seen_as
from graph_slam_ros.slam.space import Numbers, Space

Array = NDArray[np.float64]

_DISTANCES_M = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # along a ray
_DIRECTIONS = {2: 16, 3: 64}
_ITERATIONS = 30
_ARRIVED_M = 1e-5
_ONE_PLACE_M = 1e-2
_LEAST_CURVATURE = 1e-12
_NO_OFFSET_M = 1e-6


Field = tuple[str, Array, Array, Array, Array]


@dataclass(frozen=True, slots=True)
class Glance:
    """One sighting from a place that is taken for known.

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
class Place:
    """Where a landmark may be, its covariance (n, n), infinite where it is loose, and the chi2 of the sightings."""

    position: Array
    covariance: Array
    chi2: float


def places(space: Space, glances: Sequence[Glance], offset_sigma_m: float = 0.0) -> list[Place]:
    """Every place that fits the sightings best among those next to it, the best first.

    Parameters
    ----------
    offset_sigma_m : standard deviation of an unknown offset that all ranges have in common
    """
    fields = _fields(space, glances)
    known = 1.0 / max(offset_sigma_m, _NO_OFFSET_M) ** 2
    found: list[Place] = []
    for start in _starts(space, glances[0]):
        place = _descend(space, fields, np.append(start, 0.0), known)
        if place and all(np.linalg.norm(place.position - other.position) > _ONE_PLACE_M for other in found):
            found.append(place)
    return sorted(found, key=lambda place: place.chi2)


def _fields(space: Space, glances: Sequence[Glance]) -> list[Field]:
    """By kind: rotations (k, n, n) and positions (k, n) of the sensors, what they said (k, m), whitening (k, m, m)."""
    out = []
    n = space.dimensions
    for kind in dict.fromkeys(glance.kind for glance in glances):
        members = [glance for glance in glances if glance.kind == kind]
        turns = np.array([space.turn(g.T_map_sensor) for g in members])
        at = np.array([g.T_map_sensor[:n] for g in members])
        whiten = np.linalg.inv(np.linalg.cholesky(np.array([g.covariance for g in members])))
        out.append((kind, turns, at, np.array([g.measured for g in members]), whiten))
    return out


def _starts(space: Space, glance: Glance) -> list[Array]:
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


def _descend(space: Space, fields: list[Field], start: Array, known: float) -> Place | None:
    """Levenberg-Marquardt to the nearest minimum; None where it does not arrive.

    Parameters
    ----------
    start : (n + 1,) a point and the ranges' offset
    known : information on the offset
    """
    n, at, damping = space.dimensions, start, 1e-3
    chi2, b, h = _normal(space, fields, at, known)
    for _ in range(_ITERATIONS):
        step = -np.linalg.solve(h + np.diag(damping * np.diag(h) + _LEAST_CURVATURE), b)
        tried = _normal(space, fields, at + step, known)
        if tried[0] > chi2:
            damping *= 10.0
            continue
        at, (chi2, b, h), damping = at + step, tried, 0.1 * damping
        if np.linalg.norm(step) < _ARRIVED_M * (1.0 + np.linalg.norm(at)):
            return Place(at[:n], _covariance(h[:n, :n] - np.outer(h[:n, n], h[n, :n]) / h[n, n]), chi2)
    return None


def _covariance(information: Array) -> Array:
    values = np.linalg.eigvalsh(information)
    if values[0] <= max(_LEAST_CURVATURE, 1e-9 * values[-1]):
        return np.full_like(information, np.inf)
    inverse: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return inverse


def _normal(space: Space, fields: list[Field], at: Array, known: float) -> tuple[float, Array, Array]:
    """chi2, gradient (n + 1,) and Gauss-Newton matrix (n + 1, n + 1) at a point and an offset."""
    n = space.dimensions
    b, h = np.zeros(n + 1), np.zeros((n + 1, n + 1))
    chi2, b[n], h[n, n] = known * at[n] ** 2, known * at[n], known
    for kind, turns, sensors, said, whiten in fields:
        p = np.einsum("kij,ki->kj", turns, at[:n] - sensors)
        r = seen_as(space, kind, p) - said
        first_angle = 0 if kind == "bearing" else 1
        r[:, first_angle:] = se2.wrap(r[:, first_angle:])
        j = np.zeros((*r.shape, n + 1))
        j[..., :n] = gradient(space, kind, p) @ np.swapaxes(turns, 1, 2)
        if kind == "range":
            r[:, 0] += at[n]
            j[:, 0, n] = 1.0
        j, r = whiten @ j, np.einsum("kij,kj->ki", whiten, r)
        chi2 += float(np.sum(r * r))
        b += np.einsum("kij,ki->j", j, r)
        h += np.einsum("kij,kil->jl", j, j)
    return chi2, b, h
