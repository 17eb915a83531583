"""Edge types in space. Conventions and the meaning of the arguments are those of ``edges``.

Derivatives used throughout:  R Exp(w) = R (I + [w]x),  Log(R Exp(w)) = Log(R) + Jr^-1(Log(R)) w.
"""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import R3, SE3
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.lie.jit import jitable, kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@jitable
def _pose(x: Array, i: int) -> se3.Pose:
    return x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5], x[i + 6]


@jitable
def _residual(e: se3.Pose, out: Array) -> so3.Vector:
    """``[t, rotation vector]`` of an error pose; returns the rotation vector."""
    w = so3.log(se3.rotation(e))
    out[0], out[1], out[2] = e[0], e[1], e[2]
    out[3], out[4], out[5] = w
    return w


@kernel
def _relative_pose(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, rotation vector] of Z^-1 Ti^-1 Tj``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 6)), np.zeros((n, 6, 12))
    for k in range(n):
        z = _pose(measured[k], 0)
        d = se3.between(_pose(x, at[k, 0]), _pose(x, at[k, 1]))
        e = se3.between(z, d)
        by_angle = so3.right_jacobian_inverse(_residual(e, residual[k]))
        back = so3.matrix(so3.inverse(se3.rotation(z)))
        jacobian[k, :3, :3] = -back
        jacobian[k, :3, 3:6] = back @ so3.hat(se3.position(d))
        jacobian[k, 3:, 3:6] = -by_angle @ so3.matrix(so3.inverse(se3.rotation(d)))
        jacobian[k, :3, 6:9] = so3.matrix(se3.rotation(e))
        jacobian[k, 3:, 9:] = by_angle
    return residual, jacobian


@kernel
def _pose_prior(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, rotation vector] of Z^-1 T``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 6)), np.zeros((n, 6, 6))
    for k in range(n):
        e = se3.between(_pose(measured[k], 0), _pose(x, at[k, 0]))
        jacobian[k, 3:, 3:] = so3.right_jacobian_inverse(_residual(e, residual[k]))
        jacobian[k, :3, :3] = so3.matrix(se3.rotation(e))
    return residual, jacobian


@kernel
def _landmark_position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = Ri' (l - ti) - z``: a point landmark seen at z = (x, y, z) in the pose's frame."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 3)), np.zeros((n, 3, 9))
    for k in range(n):
        i, j = at[k]
        back = so3.inverse(se3.rotation(_pose(x, i)))
        p = so3.act(back, (x[j] - x[i], x[j + 1] - x[i + 1], x[j + 2] - x[i + 2]))
        jacobian[k, :, 3:6] = so3.hat(p)
        jacobian[k, :, 6:] = so3.matrix(back)
        for a in range(3):
            residual[k, a] = p[a] - measured[k, a]
            jacobian[k, a, a] = -1.0
    return residual, jacobian


_POSE, _POINT = (SE3,), (R3,)
RELATIVE_POSE_3D = EdgeType("relative pose 3D", (_POSE, _POSE), 7, 6, _relative_pose)
POSE_PRIOR_3D = EdgeType("pose prior 3D", (_POSE,), 7, 6, _pose_prior)
LANDMARK_POSITION_3D = EdgeType("landmark position 3D", (_POSE, _POINT), 3, 3, _landmark_position)
