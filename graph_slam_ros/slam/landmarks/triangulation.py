"""Triangulation of a landmark from ranges and bearings: all places that fit, and whether one of them is determined.

One range leaves a circle, two ranges leave two points, and bearings from one place leave a ray. So the search starts at
many points of the circle, sphere or ray of the first sighting. Each start is refined to the nearest least squares.

Ranges leave two places, one on each side of the path. Which one is right follows from how the path bends. Where a
straight path bends by the errors of odometry alone, it follows from nothing. So the other places must be unlikely even
where the path is as uncertain as it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.edge_noise import LEAST_RAD2
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend.motion_compensation import (
    PoseAtStamp,
    as_matrix,
    gradient,
    point_jacobian,
    point_of,
    predict,
)
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

_DISTANCES_M = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)  # along a ray
_DIRECTIONS = {2: 16, 3: 64}
_ITERATIONS = 30
_ARRIVED_M = 1e-5
_ONE_PLACE_M = 1e-2
_LEAST_CURVATURE = 1e-12
_DETERMINED_BELOW = 0.2  # of its distance is the sigma of a place: with more, linearising there is wrong
_MIRROR_CHI2 = 12.0  # by which every other place, e.g. the mirror image, fits worse: likelier by e^6, 400 times

Field = tuple[str, Array, Array, Array, Array]
Sightings = Sequence[tuple[PoseAtStamp, Sighting]]


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


def possible_places(space: Geometry, glances: Sequence[PartialObservation]) -> list[PositionHypothesis]:
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


def why_undetermined(
    space: Geometry,
    solver: Solver,
    seen: Sightings,
    glances: Sequence[PartialObservation],
    found: Sequence[PositionHypothesis],
) -> str:
    """Return why a landmark is not determined; empty if it is.

    Parameters
    ----------
    seen, glances : its sightings; the same from sensor poses that are assumed known
    found : its possible places, the best first
    """
    kind, count = glances[0].kind, len(glances)
    if count <= space.dimensions - (kind != "range"):
        return f"{count} {'sightings' if count > 1 else 'sighting'} by {kind}: too few"
    if not found:
        return f"no place fits {count} sightings by {kind}"
    best, *others = found
    fitting = [one.position for one in others if one.chi2 < best.chi2 + _MIRROR_CHI2]
    if fitting:
        return _several([best.position, *fitting])
    n = space.dimensions
    distance = min(float(np.linalg.norm(best.position - np.array(g.T_map_sensor[:n]))) for g in glances)
    is_finite = np.isfinite(best.covariance).all()
    sigma = float(np.sqrt(np.linalg.eigvalsh(best.covariance)[-1])) if is_finite else np.inf
    if sigma > _DETERMINED_BELOW * distance:
        return f"sigma {sigma:.2f} m at {distance:.2f} m: more than {_DETERMINED_BELOW:g} of the distance"
    return _why_unsure(space, solver, seen, found) if others else ""


def _why_unsure(space: Geometry, solver: Solver, seen: Sightings, found: Sequence[PositionHypothesis]) -> str:
    """Return that another place fits if the path errs as much as it may; empty if none does."""
    places = [one.position for one in found]
    solved = [one for one in seen if solver.has(one[0].vertex)]  # all but what has just come
    if 2 * len(solved) < len(seen):
        return ""  # nothing is solved yet, so nobody knows how well the path is known
    try:
        first, *chi2 = _least_chi2_near(space, solver, solved, places)
    except (GraphSlamError, np.linalg.LinAlgError) as error:
        return f"how well the path is known cannot be computed: {error}"
    fitting = [place for place, one in zip(places[1:], chi2, strict=True) if not one >= first + _MIRROR_CHI2]
    return f"{_several([places[0], *fitting])}, as far as the path is known" if fitting else ""


def _several(places: Sequence[Array]) -> str:
    some = " and ".join("(" + ", ".join(f"{x:.2f}" for x in place) + ")" for place in places[:3])
    return f"{len(places)} places fit: {some}"


def _least_chi2_near(space: Geometry, solver: Solver, seen: Sightings, places: Sequence[Array]) -> list[float]:
    """Return the least chi2 near each place, over its position and over the path as the other edges leave it uncertain.

    It is ``min_x (r + A x)' S^-1 (r + A x)`` with ``S = R + J P J'``, residuals r, and their derivative A by the place.
    R is the noise of the sightings, P the joint covariance of the keyframes, J the derivative by them.

    Parameters
    ----------
    places : (n,) in map

    Raises
    ------
    GaugeError, SingularError
        As ``Solver.joint_marginal``.
    """
    vertices = list(dict.fromkeys(where.vertex for where, _ in seen))
    joint, poses = solver.joint_marginal(vertices), solver.estimate(vertices)
    row_of = {vertex: k for k, vertex in enumerate(vertices)}
    return [_least_chi2(space, joint, poses, row_of, seen, place) for place in places]


def _least_chi2(
    space: Geometry,
    joint: Array,
    poses: Array,
    row_of: dict[int, int],
    seen: Sightings,
    place: Array,
) -> float:
    residuals, by_place, by_path = list[Array](), list[Array](), list[Array]()
    noise, dof = list[Array](), space.dof
    for where, s in seen:
        k = row_of[where.vertex]
        pose = tuple(poses[k].tolist())
        p_keyframe = _from(space, pose, place)
        p_base = _from(space, where.T_keyframe_base, p_keyframe)
        T_base_sensor = s.T_base_sensor or space.identity
        p_sensor = _from(space, T_base_sensor, p_base)
        r = predict(space, s.kind, p_sensor) - s.measured
        first_angle = 0 if s.kind == "bearing" else 1
        r[first_angle:] = se2.wrap(r[first_angle:])
        by_base = gradient(space, s.kind, p_sensor) @ space.turn(T_base_sensor).T
        by_keyframe = by_base @ space.turn(where.T_keyframe_base).T
        moved = by_base @ point_jacobian(space, p_base)
        own = as_matrix(s.covariance) + LEAST_RAD2 * np.eye(len(r)) + moved @ where.covariance @ moved.T
        on_path = np.zeros((len(r), len(joint)))
        on_path[:, dof * k : dof * (k + 1)] = -by_keyframe @ point_jacobian(space, p_keyframe)
        residuals.append(r)
        by_place.append(by_keyframe @ space.turn(pose).T)
        by_path.append(on_path)
        noise.append(own)
    spread = block_diag(*noise) + np.vstack(by_path) @ joint @ np.vstack(by_path).T
    root = np.linalg.cholesky(spread)
    white = np.linalg.solve(root, np.column_stack([np.concatenate(residuals), np.vstack(by_place)]))
    step = np.linalg.lstsq(white[:, 1:], white[:, 0])[0]
    left = white[:, 0] - white[:, 1:] @ step
    return float(left @ left)


def _from(space: Geometry, pose: Numbers, point: Array) -> Array:
    return np.array(space.group.act(space.group.inverse(pose), tuple(point.tolist())))
