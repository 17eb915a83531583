"""Place edges: what visits to a place measured of several landmarks together, seen from one pose.

A landmark is a point, or a pose: a tag whose orientation is known. The poses come last. Residuals are those of the
positions of all landmarks, as of ``LANDMARK_POSITION``, and then those of the rotations of the poses. The information
is dense over all of them.
"""

from functools import cache

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.edges import AXES
from graph_slam_ros.graph.vertices import R2, R3, SE2, SE3, VertexKind
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array, Index

POINTS_OF = {SE2: R2, SE3: R3}
MOST_MEMBERS = 999
LABEL = "places"
"""The class of these edges."""


@kernel
def _in_plane(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r_k = R' (l_k - t) - z_k`` of m landmarks, then the angle of ``R_z' R' R_k`` of those that are poses."""
    n, m = at.shape[0], at.shape[1] - 1
    turned = measured.shape[1] - 2 * m
    residual, jacobian = np.zeros((n, 2 * m + turned)), np.zeros((n, 2 * m + turned, 3 + 2 * m + turned))
    for e in range(n):
        i, column = at[e, 0], 3
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        for k in range(m):
            j, u, v, w = at[e, k + 1], 2 * k, 2 * k + 1, m + turned + k
            dx, dy = x[j] - x[i], x[j + 1] - x[i + 1]
            px, py = c * dx + s * dy, c * dy - s * dx
            residual[e, u], residual[e, v] = px - measured[e, u], py - measured[e, v]
            jacobian[e, u, 0], jacobian[e, u, 2] = -1.0, py
            jacobian[e, v, 1], jacobian[e, v, 2] = -1.0, -px
            if k < m - turned:
                jacobian[e, u, column], jacobian[e, u, column + 1] = c, s
                jacobian[e, v, column], jacobian[e, v, column + 1] = -s, c
                column += 2
            else:
                angle = x[j + 2] - x[i + 2]
                residual[e, w] = se2.wrap(angle - measured[e, w])
                cosine, sine = np.cos(angle), np.sin(angle)
                jacobian[e, u, column], jacobian[e, u, column + 1] = cosine, -sine
                jacobian[e, v, column], jacobian[e, v, column + 1] = sine, cosine
                jacobian[e, w, 2], jacobian[e, w, column + 2] = -1.0, 1.0
                column += 3
    return residual, jacobian


@kernel
def _in_space(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r_k = R' (l_k - t) - z_k`` of m landmarks, then the vector of ``R_z' R' R_k`` of those that are poses."""
    n, m = at.shape[0], at.shape[1] - 1
    turned = (measured.shape[1] - 3 * m) // 4
    residual, jacobian = np.zeros((n, 3 * (m + turned))), np.zeros((n, 3 * (m + turned), 6 + 3 * (m + turned)))
    for e in range(n):
        i, column = at[e, 0], 6
        rotation = _quaternion(x, i + 3)
        back = so3.inverse(rotation)
        turn = so3.matrix(rotation)
        for k in range(m):
            j, row = at[e, k + 1], 3 * k
            px, py, pz = so3.act(back, (x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]))
            residual[e, row] = px - measured[e, row]
            residual[e, row + 1] = py - measured[e, row + 1]
            residual[e, row + 2] = pz - measured[e, row + 2]
            jacobian[e, row, 4], jacobian[e, row, 5] = -pz, py
            jacobian[e, row + 1, 3], jacobian[e, row + 1, 5] = pz, -px
            jacobian[e, row + 2, 3], jacobian[e, row + 2, 4] = -py, px
            number = k - (m - turned)
            if number < 0:
                for a in range(3):
                    jacobian[e, row + a, a] = -1.0
                    for b in range(3):
                        jacobian[e, row + a, column + b] = turn[b, a]
                column += 3
                continue
            w, z = 3 * (m + number), 3 * m + 4 * number
            seen = so3.compose(back, _quaternion(x, j + 3))
            off = so3.log(so3.compose(so3.inverse(_quaternion(measured[e], z)), seen))
            residual[e, w], residual[e, w + 1], residual[e, w + 2] = off
            from_seen, moved = so3.inverse(seen), so3.matrix(seen)
            for a in range(3):
                jacobian[e, row + a, a] = -1.0
                mine = so3.right_jacobian_inverse(off, so3.act(from_seen, AXES[a]))
                theirs = so3.right_jacobian_inverse(off, AXES[a])
                for b in range(3):
                    jacobian[e, row + a, column + b] = moved[a, b]
                    jacobian[e, w + b, 3 + a], jacobian[e, w + b, column + 3 + a] = -mine[b], theirs[b]
            column += 6
    return residual, jacobian


@jitable
def _quaternion(x: Array, i: int) -> so3.Quaternion:
    return x[i], x[i + 1], x[i + 2], x[i + 3]


_KERNELS = {SE2: _in_plane, SE3: _in_space}


def place_edge(pose: VertexKind, points: int, poses: int = 0) -> EdgeType:
    """Return the edge type of a place: a pose (SE2 or SE3), and so many landmarks seen from it.

    Parameters
    ----------
    points, poses : how many of the landmarks are points (R2 or R3), and how many, after those, poses like the first
        vertex. ``measured`` are the positions of all landmarks in the axes of the pose, one after another [m], then the
        rotations of the poses: angles [rad] or quaternions. Residuals are in the same order, of a rotation in space
        its rotation vector [rad]

    Raises
    ------
    GraphSlamError
        There is no such edge type.
    """
    members = points + poses
    if pose not in _KERNELS or min(points, poses) < 0 or not 1 <= members <= MOST_MEMBERS:
        raise GraphSlamError(
            f"a place edge of a {pose.name} and {points} points and {poses} poses:"
            f" SE2 or SE3, and 1 to {MOST_MEMBERS} in all"
        )
    return _place_edge(pose, points, poses)


@cache
def _place_edge(pose: VertexKind, points: int, poses: int) -> EdgeType:
    point, members = POINTS_OF[pose], points + poses
    numbers = point.size * members
    measured, residual = (pose.size - point.size) * poses, (pose.dof - point.dof) * poses
    name = f"place of {points}" + (f" and {poses}" if poses else "")
    kinds = ((pose,), *((point,),) * points, *((pose,),) * poses)
    return EdgeType(name, kinds, numbers + measured, numbers + residual, _KERNELS[pose])


def members_of(edge: EdgeType) -> tuple[int, int] | None:
    """Return how many points and poses are on a place edge; None for other edge types."""
    pose, others = edge.accepts[0][0], edge.accepts[1:]
    if edge.linearize is not _KERNELS.get(pose):
        return None
    poses = sum(kinds[0] is pose for kinds in others)
    return len(others) - poses, poses


PLACE_OF_ONE = {pose: place_edge(pose, 1) for pose in _KERNELS}
