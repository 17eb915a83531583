"""Edge types in space. Conventions and the meaning of the arguments are those of ``edges``.

Derivatives used throughout:  R Exp(w) = R (I + [w]x),  Log(R Exp(w)) = Log(R) + Jr^-1(Log(R)) w.
"""

import numpy as np

from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import R3, SE3
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array, Index

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@jitable
def _pose(x: Array, i: int) -> se3.Pose:
    return x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5], x[i + 6]


@jitable
def _put(out: Array, row: int, column: int, v: so3.Vector) -> None:
    """Write a vector down a column of a Jacobian."""
    out[row, column], out[row + 1, column], out[row + 2, column] = v


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
        w = _residual(e, residual[k])
        from_z, from_d = so3.inverse(se3.rotation(z)), so3.inverse(se3.rotation(d))
        out = jacobian[k]
        for c in range(3):
            axis = AXES[c]
            back = so3.act(from_z, axis)
            turned = so3.right_jacobian_inverse(w, so3.act(from_d, axis))
            _put(out, 0, c, (-back[0], -back[1], -back[2]))
            _put(out, 0, 3 + c, so3.act(from_z, so3.cross(se3.position(d), axis)))
            _put(out, 3, 3 + c, (-turned[0], -turned[1], -turned[2]))
            _put(out, 0, 6 + c, so3.act(se3.rotation(e), axis))
            _put(out, 3, 9 + c, so3.right_jacobian_inverse(w, axis))
    return residual, jacobian


@kernel
def _pose_prior(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """``r = [t, rotation vector] of Z^-1 T``."""
    n = at.shape[0]
    residual, jacobian = np.zeros((n, 6)), np.zeros((n, 6, 6))
    for k in range(n):
        e = se3.between(_pose(measured[k], 0), _pose(x, at[k, 0]))
        w = _residual(e, residual[k])
        for c in range(3):
            _put(jacobian[k], 0, c, so3.act(se3.rotation(e), AXES[c]))
            _put(jacobian[k], 3, 3 + c, so3.right_jacobian_inverse(w, AXES[c]))
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
        for c in range(3):
            residual[k, c] = p[c] - measured[k, c]
            jacobian[k, c, c] = -1.0
            _put(jacobian[k], 0, 3 + c, so3.cross(p, AXES[c]))
            _put(jacobian[k], 0, 6 + c, so3.act(back, AXES[c]))
    return residual, jacobian


@kernel
def _tag_position(x: Array, at: Index, measured: Array) -> tuple[Array, Array]:
    """The same as a point landmark, for a landmark with an orientation that this sighting did not measure."""
    residual, of_point = _landmark_position(x, at, measured)
    n = at.shape[0]
    jacobian = np.zeros((n, 3, 12))
    for k in range(n):
        turn = so3.matrix(se3.rotation(_pose(x, at[k, 1])))
        for a in range(3):
            for i in range(6):
                jacobian[k, a, i] = of_point[k, a, i]
            for b in range(3):
                for c in range(3):
                    jacobian[k, a, 6 + b] += of_point[k, a, 6 + c] * turn[c, b]
    return residual, jacobian


_POSE, _POINT = (SE3,), (R3,)
RELATIVE_POSE_3D = EdgeType("relative pose 3D", (_POSE, _POSE), 7, 6, _relative_pose)
POSE_PRIOR_3D = EdgeType("pose prior 3D", (_POSE,), 7, 6, _pose_prior)
LANDMARK_POSITION_3D = EdgeType("landmark position 3D", (_POSE, _POINT), 3, 3, _landmark_position)
TAG_POSITION_3D = EdgeType("tag position 3D", (_POSE, _POSE), 3, 3, _tag_position)
