"""Rotations of many poses at once as arrays, in the plane and in space, and the motion of many points."""

import numpy as np
from scipy.spatial.transform import Rotation

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Numbers

_LEAST_APART_M = 0.5  # two landmarks nearer to each other tell little of a heading


def product(a: Array, b: Array) -> Array:
    """The products (..., i, k) of many small matrices (..., i, j) and (..., j, k), several times as fast as ``@``."""
    out = np.empty((*np.broadcast_shapes(a.shape[:-2], b.shape[:-2]), a.shape[-2], b.shape[-1]))
    for i in range(a.shape[-2]):
        for k in range(b.shape[-1]):
            out[..., i, k] = a[..., i, 0] * b[..., 0, k]
            for j in range(1, a.shape[-1]):
                out[..., i, k] += a[..., i, j] * b[..., j, k]
    return out


def applied(matrices: Array, vectors: Array) -> Array:
    """The products (..., i) of many small matrices (..., i, j) and vectors (..., j), as ``product``."""
    return product(matrices, vectors[..., None])[..., 0]


def rotation(vectors: Array) -> Array:
    """Rotation matrices (..., n, n) of rotation vectors (..., 1) or (..., 3)."""
    if vectors.shape[-1] == 3:
        flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
        return np.asarray(flat.reshape(*vectors.shape[:-1], 3, 3))
    c, s = np.cos(vectors[..., 0]), np.sin(vectors[..., 0])
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def rotation_vector(matrices: Array) -> Array:
    """Inverse of ``rotation``."""
    if matrices.shape[-1] == 3:
        flat = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec()
        return np.asarray(flat.reshape(*matrices.shape[:-2], 3))
    return np.arctan2(matrices[..., 1, 0], matrices[..., 0, 0])[..., None]


def yaw(angles: Array, n: int) -> Array:
    """Rotation matrices (k, n, n) about the vertical, of angles (k,)."""
    out = np.tile(np.eye(n), (len(angles), 1, 1))
    out[:, :2, :2] = rotation(angles[:, None])
    return out


def lever(points: Array) -> Array:
    """``X`` (..., n, r) of points (..., n): a small rotation ``phi`` moves a point by ``X phi``."""
    if points.shape[-1] == 2:
        return np.stack([-points[..., 1], points[..., 0]], axis=-1)[..., None]
    x, y, z = np.moveaxis(points, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, z, -y], [-z, zero, x], [y, -x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrices_of(space: Geometry, poses: Array) -> tuple[Array, Array]:
    """Positions (k, n) and rotation matrices (k, n, n) of poses (k, 3) or (k, 7)."""
    n = space.dimensions
    if n == 2:
        return poses[:, :2], rotation(poses[:, 2:])
    return poses[:, :3], np.asarray(Rotation.from_quat(poses[:, 3:]).as_matrix())


def poses_of(space: Geometry, positions: Array, turns: Array) -> Array:
    """Inverse of ``matrices_of``."""
    if space.dimensions == 2:
        return np.hstack([positions, rotation_vector(turns)])
    return np.hstack([positions, Rotation.from_matrix(turns).as_quat()])


def pose_of(space: Geometry, turn: Array, shift: Array) -> Numbers:
    """The pose with a rotation matrix (n, n) and a position (n,)."""
    return tuple(poses_of(space, shift[None], turn[None])[0].tolist())


def turn_of(space: Geometry, pose: Numbers) -> Array:
    """Rotation vector (1,) or (3,) of a pose."""
    return rotation_vector(space.turn(pose)[None])[0]


def are_spread(points: Array) -> bool:
    """Return whether points determine a rigid motion: apart from one another, and three not on a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[points.shape[1] - 2] >= 0.5 * _LEAST_APART_M)


def aligned(points: Array, places: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """Rotations (..., n, n) and translations (..., n) that lay points (..., k, n) on their places best (Kabsch)."""
    w = np.ones(points.shape[-2]) if weights is None else weights
    w = w / w.sum()
    p, m = w @ points, w @ places
    correlation = np.swapaxes(points - p[..., None, :], -1, -2) @ ((places - m[..., None, :]) * w[:, None])
    u, _, vt = np.linalg.svd(correlation)
    vt[..., -1, :] *= np.sign(np.linalg.det(u @ vt))[..., None]
    turn = np.swapaxes(u @ vt, -1, -2)
    return turn, m - applied(turn, p)
