"""The place of a landmark that was seen by range or bearing alone: whether it is determined.

Ranges leave two places, one on each side of the path. Which one is right follows from how the path bends. Where a
straight path bends by the errors of odometry alone, it follows from nothing. So the other places must be unlikely even
where the path is as uncertain as it is.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from graph_slam_ros.config.pipeline import LandmarksConfig
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
    predict,
)
from graph_slam_ros.slam.landmarks.landmark import UndeterminedLandmark
from graph_slam_ros.slam.landmarks.triangulation import PartialObservation
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

_DETERMINED_BELOW = 0.2  # of its distance is the sigma of a place: with more, linearising there is wrong
_MIRROR_CHI2 = 12.0  # by which every other place, e.g. the mirror image, fits worse: likelier by e^6, 400 times
_Seen = Sequence[tuple[PoseAtStamp, Sighting]]


def why_undetermined(
    config: LandmarksConfig,
    space: Geometry,
    solver: Solver,
    candidate: UndeterminedLandmark,
    glances: Sequence[PartialObservation],
) -> str:
    """Return why a landmark is not determined; empty if it is.

    Parameters
    ----------
    candidate : with its possible places, the best first
    glances : its sightings, from sensor poses that are assumed known
    """
    kind, count = glances[0].kind, len(glances)
    if count <= space.dimensions - (kind != "range"):
        return f"{count} {'sightings' if count > 1 else 'sighting'} by {kind}: too few"
    if not candidate.places:
        return f"no place fits {count} sightings by {kind}"
    best, *others = candidate.places
    fitting = [one.position for one in others if one.chi2 < best.chi2 + _MIRROR_CHI2]
    if fitting:
        return _several([best.position, *fitting])
    n = space.dimensions
    distance = min(float(np.linalg.norm(best.position - np.array(g.T_map_sensor[:n]))) for g in glances)
    is_finite = np.isfinite(best.covariance).all()
    sigma = float(np.sqrt(np.linalg.eigvalsh(best.covariance)[-1])) if is_finite else np.inf
    if sigma > _DETERMINED_BELOW * distance:
        return f"sigma {sigma:.2f} m at {distance:.2f} m: more than {_DETERMINED_BELOW:g} of the distance"
    return _why_unsure(config, space, solver, candidate) if others else ""


def _why_unsure(config: LandmarksConfig, space: Geometry, solver: Solver, candidate: UndeterminedLandmark) -> str:
    """Return that another place fits if the path errs as much as it may; empty if none does."""
    places = [one.position for one in candidate.places]
    seen = [one for one in candidate.seen if solver.has(one[0].vertex)]  # all but what has just come
    if 2 * len(seen) < len(candidate.seen):
        return ""  # nothing is solved yet, so nobody knows how well the path is known
    try:
        first, *chi2 = least_chi2(space, solver, seen, places)
    except (GraphSlamError, np.linalg.LinAlgError) as error:
        return f"how well the path is known cannot be computed: {error}"
    fitting = [place for place, one in zip(places[1:], chi2, strict=True) if not one >= first + _MIRROR_CHI2]
    return f"{_several([places[0], *fitting])}, as far as the path is known" if fitting else ""


def _several(places: Sequence[Array]) -> str:
    some = " and ".join("(" + ", ".join(f"{x:.2f}" for x in place) + ")" for place in places[:3])
    return f"{len(places)} places fit: {some}"


def least_chi2(space: Geometry, solver: Solver, seen: _Seen, places: Sequence[Array]) -> list[float]:
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
    seen: _Seen,
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
