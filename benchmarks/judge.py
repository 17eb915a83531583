"""The judge: what an estimate costs, and how far it is off, computed in one place for all contenders.

Errors of relative poses are position and rotation vector of ``Z^-1 Ti^-1 Tj``, as ours are, and in the plane g2o's.
GTSAM and g2o minimise other error maps in space. The information matrices are those of the file. No one-half, no loss.
"""

import numpy as np

from benchmarks.problem import Array, Edges, Problem
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.slam.landmarks.rotations import aligned


def chi2(problem: Problem, poses: Array, landmarks: Array) -> float | None:
    """Sum of the squared whitened residuals; ``None`` where there is no finite estimate."""
    if len(poses) != len(problem.poses) or not np.isfinite(poses).all():
        return None
    total, seen = float(fits(problem.relative, poses).sum()), problem.sightings
    if len(seen):
        at, point = seen.ends.T
        here = se2.act(se2.inverse(tuple(poses[at].T)), tuple(landmarks[point].T))
        total += float(_squared(seen, np.stack(here, axis=1) - seen.measured).sum())
    return total


def fits(edges: Edges, poses: Array) -> Array:
    """Chi2 (n,) of each relative pose."""
    group = se2 if poses.shape[1] == 3 else se3
    i, j = (tuple(poses[ends].T) for ends in edges.ends.T)
    error = group.between(tuple(edges.measured.T), group.between(i, j))
    if group is se3:
        error = (*error[:3], *so3.log(se3.rotation(error)))
    return _squared(edges, np.stack(error, axis=1))


def _squared(edges: Edges, residuals: Array) -> Array:
    return np.asarray(np.square(np.einsum("nij,nj->ni", edges.root, residuals)).sum(axis=1))


def distances(estimated: Array, true: Array) -> Array:
    """Distances (n,) of positions from the true ones, after they were laid on these."""
    turn, shift = aligned(estimated, true)
    return np.asarray(np.linalg.norm(estimated @ turn.T + shift - true, axis=1))


def rms(estimated: Array, true: Array) -> float:
    """Root mean square of ``distances``."""
    return float(np.sqrt(np.square(distances(estimated, true)).mean()))


def position_error(poses: Array, truth: Array) -> float:
    """Root mean square of the distances of poses (n, 3) or (n, 7) from true ones."""
    n = 2 if poses.shape[1] == 3 else 3
    return rms(poses[:, :n], truth[:, :n])
