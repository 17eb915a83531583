"""Rigid alignment: the rotation and translation that move points onto their counterparts."""

import numpy as np

from graph_slam_ros.typing import Array

_LEAST_APART_M = 0.5  # two landmarks nearer to each other tell little of a heading


def are_spread(points: Array) -> bool:
    """Return whether points determine a rigid motion: apart from one another, and three not on a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[points.shape[1] - 2] >= 0.5 * _LEAST_APART_M)


def aligned(points: Array, places: Array, weights: Array) -> tuple[Array, Array]:
    """Rotation and translation that move points onto their counterparts with weighted least squares (Kabsch)."""
    w = weights / weights.sum()
    p, m = w @ points, w @ places
    u, _, vt = np.linalg.svd((points - p).T @ ((places - m) * w[:, None]))
    mirror = np.ones(points.shape[1])
    mirror[-1] = np.sign(np.linalg.det(vt.T @ u.T))
    turn = vt.T @ np.diag(mirror) @ u.T
    return turn, m - turn @ p
