"""Edge types in the plane and between vectors; the arguments of their kernels are explained in ``edge_type``.

Derivatives used throughout, with J = [[0, -1], [1, 0]]:  R(theta) Exp([w]) = R(theta) (I + w J).

Kernels write numbers, not slices: for a slice Numba compiles an error message about its shape, which takes two seconds.
"""

import numpy as np

from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import R1, R2, R3, SE2
from graph_slam_ros.lie import se2
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Array, Index


@kernel
def _relative_pose(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, angle] of Z^-1 Ti^-1 Tj``, g2o's EDGE_SE2."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i, j = at[e]
        z = (measured[e, 0], measured[e, 1], measured[e, 2])
        d = se2.between((x[i], x[i + 1], x[i + 2]), (x[j], x[j + 1], x[j + 2]))
        r = se2.between(z, d)
        residual[e, 0], residual[e, 1], residual[e, 2] = r
        c, s = np.cos(z[2]), np.sin(z[2])
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = -c, -s, c * d[1] - s * d[0]
        jacobian[e, 1, 0], jacobian[e, 1, 1], jacobian[e, 1, 2] = s, -c, -s * d[1] - c * d[0]
        jacobian[e, 2, 2] = -1.0
        c, s = np.cos(r[2]), np.sin(r[2])
        jacobian[e, 0, 3], jacobian[e, 0, 4] = c, -s
        jacobian[e, 1, 3], jacobian[e, 1, 4] = s, c
        jacobian[e, 2, 5] = 1.0
    return residual, jacobian


@kernel
def _inverse_relative_pose(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, angle] of (Z^-1 Ti^-1 Tj)^-1``: the error map of python-graphslam, kept to compare with it."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i, j = at[e]
        z = (measured[e, 0], measured[e, 1], measured[e, 2])
        b = se2.between((x[j], x[j + 1], x[j + 2]), (x[i], x[i + 1], x[i + 2]))
        x_r, y_r, theta = se2.compose(b, z)
        residual[e, 0], residual[e, 1], residual[e, 2] = x_r, y_r, se2.wrap(theta)
        c, s = np.cos(b[2]), np.sin(b[2])
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = c, -s, -s * z[0] - c * z[1]
        jacobian[e, 1, 0], jacobian[e, 1, 1], jacobian[e, 1, 2] = s, c, c * z[0] - s * z[1]
        jacobian[e, 2, 2] = 1.0
        jacobian[e, 0, 3], jacobian[e, 0, 5] = -1.0, y_r
        jacobian[e, 1, 4], jacobian[e, 1, 5] = -1.0, -x_r
        jacobian[e, 2, 5] = -1.0
    return residual, jacobian


@kernel
def _pose_prior(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, angle] of Z^-1 T``: an anchor, or an absolute pose."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for e in range(n):
        i = at[e, 0]
        r = se2.between((measured[e, 0], measured[e, 1], measured[e, 2]), (x[i], x[i + 1], x[i + 2]))
        residual[e, 0], residual[e, 1], residual[e, 2] = r
        c, s = np.cos(r[2]), np.sin(r[2])
        jacobian[e, 0, 0], jacobian[e, 0, 1] = c, -s
        jacobian[e, 1, 0], jacobian[e, 1, 1] = s, c
        jacobian[e, 2, 2] = 1.0
    return residual, jacobian


@kernel
def _landmark_position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = Ri' (l - ti) - z``: a point landmark seen at z = (x, y) in the pose's frame, g2o's EDGE_SE2_XY."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 2)), np.zeros((n, 2, 5))
    for e in range(n):
        i, j = at[e]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        dx, dy = x[j] - x[i], x[j + 1] - x[i + 1]
        px, py = c * dx + s * dy, c * dy - s * dx
        residual[e, 0], residual[e, 1] = px - measured[e, 0], py - measured[e, 1]
        jacobian[e, 0, 0], jacobian[e, 0, 2] = -1.0, py
        jacobian[e, 1, 1], jacobian[e, 1, 2] = -1.0, -px
        jacobian[e, 0, 3], jacobian[e, 0, 4] = c, s
        jacobian[e, 1, 3], jacobian[e, 1, 4] = -s, c
    return residual, jacobian


@kernel
def _tag_position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """The same as a point landmark, for a landmark with an orientation that this sighting did not measure."""
    residual, of_point = _landmark_position(x, at, measured)
    n = at.shape[0]
    jacobian = np.zeros((n, 2, 6))
    for e in range(n):
        j = at[e, 1]
        c, s = np.cos(x[j + 2]), np.sin(x[j + 2])
        for k in range(2):
            for i in range(3):
                jacobian[e, k, i] = of_point[e, k, i]
            jacobian[e, k, 3] = c * of_point[e, k, 3] + s * of_point[e, k, 4]
            jacobian[e, k, 4] = c * of_point[e, k, 4] - s * of_point[e, k, 3]
    return residual, jacobian


@kernel
def _difference(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = xj - xi - z`` between two vectors."""
    n, m = measured.shape
    residual, jacobian = np.zeros((n, m)), np.zeros((n, m, 2 * m))
    for e in range(n):
        for k in range(m):
            residual[e, k] = x[at[e, 1] + k] - x[at[e, 0] + k] - measured[e, k]
            jacobian[e, k, k], jacobian[e, k, m + k] = -1.0, 1.0
    return residual, jacobian


@kernel
def _point_prior(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = x - z`` of one vector."""
    n, m = measured.shape
    residual, jacobian = np.zeros((n, m)), np.zeros((n, m, m))
    for e in range(n):
        for k in range(m):
            residual[e, k] = x[at[e, 0] + k] - measured[e, k]
            jacobian[e, k, k] = 1.0
    return residual, jacobian


_POSE, _POINT = (SE2,), (R2,)
RELATIVE_POSE = EdgeType("relative pose", (_POSE, _POSE), 3, 3, _relative_pose)
INVERSE_RELATIVE_POSE = EdgeType("inverse relative pose", (_POSE, _POSE), 3, 3, _inverse_relative_pose)
POSE_PRIOR = EdgeType("pose prior", (_POSE,), 3, 3, _pose_prior)
LANDMARK_POSITION = EdgeType("landmark position", (_POSE, _POINT), 2, 2, _landmark_position)
TAG_POSITION = EdgeType("tag position", (_POSE, _POSE), 2, 2, _tag_position)
DIFFERENCE = {k: EdgeType(f"difference {k.name}", ((k,), (k,)), k.dof, k.dof, _difference) for k in (R1, R2, R3)}
POINT_PRIOR = {k: EdgeType(f"prior {k.name}", ((k,),), k.dof, k.dof, _point_prior) for k in (R1, R2, R3)}
