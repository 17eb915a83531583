"""Edge types on one pose alone: what a receiver, a compass or an inertial sensor measures of it in the map's axes.

A fix that knows some axes only, or some better than others in correlated ways, is said by coordinates along the
principal axes of its covariance: each of them is one number. A position may be that of a point of the robot, an
antenna: its coordinates in the pose's frame follow what was measured, or are left out where it is the pose's own.
"""

import numpy as np

from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import SE2, SE3
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Array, Index


@kernel
def _position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = t + R p - z`` with measured = (z, p)."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 2)), np.zeros((n, 2, 3))
    for e in range(n):
        i = at[e, 0]
        px, py = measured[e, 2], measured[e, 3]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        residual[e, 0] = x[i] + c * px - s * py - measured[e, 0]
        residual[e, 1] = x[i + 1] + s * px + c * py - measured[e, 1]
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = c, -s, -s * px - c * py
        jacobian[e, 1, 0], jacobian[e, 1, 1], jacobian[e, 1, 2] = s, c, c * px - s * py
    return residual, jacobian


@kernel
def _coordinate(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = u'(t + R p) - z`` with measured = (u, z, p): one coordinate, along a direction u of unit length."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 3))
    for e in range(n):
        i = at[e, 0]
        u, v, px, py = measured[e, 0], measured[e, 1], measured[e, 3], measured[e, 4]
        c, s = np.cos(x[i + 2]), np.sin(x[i + 2])
        residual[e, 0] = u * (x[i] + c * px - s * py) + v * (x[i + 1] + s * px + c * py) - measured[e, 2]
        jacobian[e, 0, 0], jacobian[e, 0, 1] = c * u + s * v, c * v - s * u
        jacobian[e, 0, 2] = u * (-s * px - c * py) + v * (c * px - s * py)
    return residual, jacobian


@kernel
def _heading(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = theta - z``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 3))
    for e in range(n):
        residual[e, 0] = se2.wrap(x[at[e, 0] + 2] - measured[e, 0])
        jacobian[e, 0, 2] = 1.0
    return residual, jacobian


@kernel
def _position_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = t + R p - z`` with measured = (z, p)."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i = at[e, 0]
        q = (x[i + 3], x[i + 4], x[i + 5], x[i + 6])
        p = (measured[e, 3], measured[e, 4], measured[e, 5])
        turn, reach = so3.matrix(q), so3.act(q, p)
        for k in range(3):
            residual[e, k] = x[i + k] + reach[k] - measured[e, k]
            row = (turn[k, 0], turn[k, 1], turn[k, 2])
            jacobian[e, k, 0], jacobian[e, k, 1], jacobian[e, k, 2] = row
            jacobian[e, k, 3], jacobian[e, k, 4], jacobian[e, k, 5] = so3.cross(p, row)
    return residual, jacobian


@kernel
def _coordinate_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = u'(t + R p) - z`` with measured = (u, z, p): one coordinate, along a direction u of unit length."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 6))
    for e in range(n):
        i = at[e, 0]
        u = (measured[e, 0], measured[e, 1], measured[e, 2])
        p = (measured[e, 4], measured[e, 5], measured[e, 6])
        back = so3.act(so3.inverse((x[i + 3], x[i + 4], x[i + 5], x[i + 6])), u)
        along = back[0] * p[0] + back[1] * p[1] + back[2] * p[2]
        residual[e, 0] = u[0] * x[i] + u[1] * x[i + 1] + u[2] * x[i + 2] + along - measured[e, 3]
        jacobian[e, 0, 0], jacobian[e, 0, 1], jacobian[e, 0, 2] = back
        jacobian[e, 0, 3], jacobian[e, 0, 4], jacobian[e, 0, 5] = so3.cross(p, back)
    return residual, jacobian


@kernel
def _attitude_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = Log(Z^-1 R)``: the rotation vector from the measured orientation to the pose's, in the body's axes."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 6))
    for e in range(n):
        i = at[e, 0]
        z = (measured[e, 0], measured[e, 1], measured[e, 2], measured[e, 3])
        w = so3.log(so3.compose(so3.inverse(z), (x[i + 3], x[i + 4], x[i + 5], x[i + 6])))
        residual[e, 0], residual[e, 1], residual[e, 2] = w
        for c in range(3):
            axis = (1.0 if c == 0 else 0.0, 1.0 if c == 1 else 0.0, 1.0 if c == 2 else 0.0)
            d = so3.right_jacobian_inverse(w, axis)
            jacobian[e, 0, 3 + c], jacobian[e, 1, 3 + c], jacobian[e, 2, 3 + c] = d
    return residual, jacobian


@kernel
def _heading_3d(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = yaw - z``: the angle from the map's x to the body's x, both seen from above."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 1)), np.zeros((n, 1, 6))
    for e in range(n):
        i = at[e, 0]
        turn = so3.matrix((x[i + 3], x[i + 4], x[i + 5], x[i + 6]))
        a, b = turn[0, 0], turn[1, 0]
        residual[e, 0] = se2.wrap(np.arctan2(b, a) - measured[e, 0])
        square = max(a * a + b * b, 1e-18)  # 0 where the body points straight up: then there is no heading
        for k in range(2):  # turning about the body's y moves its x along -z, about its z along y
            da, db = (-turn[0, 2], -turn[1, 2]) if k == 0 else (turn[0, 1], turn[1, 1])
            jacobian[e, 0, 4 + k] = (a * db - b * da) / square
    return residual, jacobian


POSITION_PRIOR = EdgeType("position prior", ((SE2,),), 4, 2, _position, (0.0, 0.0))
COORDINATE_PRIOR = EdgeType("coordinate prior", ((SE2,),), 5, 1, _coordinate, (0.0, 0.0))
HEADING_PRIOR = EdgeType("heading prior", ((SE2,),), 1, 1, _heading)
POSITION_PRIOR_3D = EdgeType("position prior 3D", ((SE3,),), 6, 3, _position_3d, (0.0, 0.0, 0.0))
COORDINATE_PRIOR_3D = EdgeType("coordinate prior 3D", ((SE3,),), 7, 1, _coordinate_3d, (0.0, 0.0, 0.0))
ATTITUDE_PRIOR_3D = EdgeType("attitude prior 3D", ((SE3,),), 4, 3, _attitude_3d)
HEADING_PRIOR_3D = EdgeType("heading prior 3D", ((SE3,),), 1, 1, _heading_3d)
