"""Place edges: what visits to a place measured of several points together, seen from one pose.

Each residual is that of a point landmark (``LANDMARK_POSITION``); the information is dense over all of them.
"""

from functools import cache

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import R2, R3, SE2, SE3, VertexKind
from graph_slam_ros.lie import so3
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Array, Index

POINTS_OF = {SE2: R2, SE3: R3}
MOST_MEMBERS = 999
LABEL = "places"
"""The class of these edges."""


@kernel
def _in_plane(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r_k = R' (l_k - t) - z_k`` of m points."""
    n, m = at.shape[0], at.shape[1] - 1
    residual, jacobian = np.zeros((n, 2 * m)), np.zeros((n, 2 * m, 3 + 2 * m))
    for e in range(n):
        i = at[e, 0]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        for k in range(m):
            j, u, v = at[e, k + 1], 2 * k, 2 * k + 1
            dx, dy = x[j] - x[i], x[j + 1] - x[i + 1]
            px, py = c * dx + s * dy, c * dy - s * dx
            residual[e, u], residual[e, v] = px - measured[e, u], py - measured[e, v]
            jacobian[e, u, 0], jacobian[e, u, 2] = -1.0, py
            jacobian[e, v, 1], jacobian[e, v, 2] = -1.0, -px
            jacobian[e, u, 3 + u], jacobian[e, u, 3 + v] = c, s
            jacobian[e, v, 3 + u], jacobian[e, v, 3 + v] = -s, c
    return residual, jacobian


@kernel
def _in_space(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r_k = R' (l_k - t) - z_k`` of m points."""
    n, m = at.shape[0], at.shape[1] - 1
    residual, jacobian = np.zeros((n, 3 * m)), np.zeros((n, 3 * m, 6 + 3 * m))
    for e in range(n):
        i = at[e, 0]
        turn = so3.matrix((x[i + 3], x[i + 4], x[i + 5], x[i + 6]))
        for k in range(m):
            j, row = at[e, k + 1], 3 * k
            dx, dy, dz = x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]
            px = turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz
            py = turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz
            pz = turn[0, 2] * dx + turn[1, 2] * dy + turn[2, 2] * dz
            residual[e, row] = px - measured[e, row]
            residual[e, row + 1] = py - measured[e, row + 1]
            residual[e, row + 2] = pz - measured[e, row + 2]
            jacobian[e, row, 4], jacobian[e, row, 5] = -pz, py
            jacobian[e, row + 1, 3], jacobian[e, row + 1, 5] = pz, -px
            jacobian[e, row + 2, 3], jacobian[e, row + 2, 4] = -py, px
            for a in range(3):
                jacobian[e, row + a, a] = -1.0
                for b in range(3):
                    jacobian[e, row + a, 6 + row + b] = turn[b, a]
    return residual, jacobian


_KERNELS = {SE2: _in_plane, SE3: _in_space}


@cache
def place_edge(pose: VertexKind, members: int) -> EdgeType:
    """Return the edge type of a place: a pose (SE2 or SE3), and so many points (R2 or R3) seen from it.

    ``measured`` are the points in the axes of the pose, one after another [m]; so are the residuals.

    Raises
    ------
    GraphSlamError
        There is no such edge type.
    """
    if pose not in _KERNELS or not 1 <= members <= MOST_MEMBERS:
        raise GraphSlamError(f"a place edge of a {pose.name} and {members} points: SE2 or SE3, and 1 to {MOST_MEMBERS}")
    point = POINTS_OF[pose]
    numbers = point.size * members
    return EdgeType(f"place of {members}", ((pose,), *((point,),) * members), numbers, numbers, _KERNELS[pose])


PLACE_OF_ONE = {pose: place_edge(pose, 1) for pose in _KERNELS}
