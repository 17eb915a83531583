"""The judge: what an estimate costs, in the error map of each contender, computed in one place for all of them.

* ``relative`` : position and rotation vector of ``Z^-1 Ti^-1 Tj``; ours, and in the plane g2o's.
* ``logarithm`` : the full logarithm of it, and landmarks by bearing and range; GTSAM's.
* ``inverse`` : as ``relative``, of the inverse of it; python-graphslam's, in the plane.
* ``quaternion`` : position and the vector part of the quaternion, half the rotation vector; g2o's in space.

The information matrices are those of the file in all of them. No one-half, no loss.
"""

import numpy as np

from benchmarks.problem import Array, Edges, Problem, polar
from graph_slam_ros.lie import se2, se3, so3


def all_costs(problem: Problem, poses: Array, landmarks: Array) -> dict[str, float] | None:
    """The cost in each error map; ``None`` where there is no finite estimate."""
    if len(poses) != len(problem.poses) or not np.isfinite(poses).all():
        return None
    maps = ("relative", "logarithm", "inverse") if problem.planar else ("relative", "logarithm", "quaternion")
    return {error_map: chi2(problem, poses, landmarks, error_map) for error_map in maps}


def chi2(problem: Problem, poses: Array, landmarks: Array, error_map: str) -> float:
    """Sum of the squared whitened residuals."""
    group = se2 if problem.planar else se3
    i, j = (tuple(poses[ends].T) for ends in problem.relative.ends.T)
    error = group.between(tuple(problem.relative.measured.T), group.between(i, j))
    if error_map == "logarithm":
        error = group.log(error)
    elif error_map == "inverse":
        error = group.inverse(error)
    elif not problem.planar:
        sign = np.where(error[6] < 0.0, -1.0, 1.0)
        turned = sign * np.stack(error[3:6]) if error_map == "quaternion" else so3.log(se3.rotation(error))
        error = (*error[:3], *turned)
    total = _squared(problem.relative, np.stack(error, axis=1))
    if len(problem.sightings):
        total += _of_sightings(problem, poses, landmarks, error_map)
    return total


def _of_sightings(problem: Problem, poses: Array, landmarks: Array, error_map: str) -> float:
    seen = problem.sightings
    at, point = seen.ends.T
    here = se2.act(se2.inverse(tuple(poses[at].T)), tuple(landmarks[point].T))
    if error_map != "logarithm":
        return _squared(seen, np.stack(here, axis=1) - seen.measured)
    seen = polar(seen)
    bearing, distance = np.arctan2(here[1], here[0]), np.hypot(*here)
    error = np.stack([se2.wrap(bearing - seen.measured[:, 0]), distance - seen.measured[:, 1]], axis=1)
    return _squared(seen, error)


def _squared(edges: Edges, residuals: Array) -> float:
    return float(np.square(np.einsum("nij,nj->ni", edges.root, residuals)).sum())


def position_error(poses: Array, truth: Array) -> float:
    """Root mean square distance of positions after the rigid motion that fits best, without scale (Umeyama 1991)."""
    n = 2 if poses.shape[1] == 3 else 3
    here, there = (at[:, :n] - at[:, :n].mean(axis=0) for at in (poses, truth))
    u, _, vt = np.linalg.svd(here.T @ there)
    signs = np.ones(n)
    signs[-1] = np.sign(np.linalg.det(u @ vt))
    return float(np.sqrt(np.square(here @ (u * signs) @ vt - there).sum(axis=1).mean()))


def fits(edges: Edges, poses: Array) -> Array:
    """Chi2 (n,) of each relative pose, in our error map."""
    group = se2 if poses.shape[1] == 3 else se3
    i, j = (tuple(poses[ends].T) for ends in edges.ends.T)
    error = group.between(tuple(edges.measured.T), group.between(i, j))
    if group is se3:
        error = (*error[:3], *so3.log(se3.rotation(error)))
    whitened = np.einsum("nij,nj->ni", edges.root, np.stack(error, axis=1))
    return np.asarray(np.square(whitened).sum(axis=1))
