"""Steps of vertices for compiled code that does not know their kinds."""

import numpy as np

from graph_slam_ros.graph.vertices import SE2, SE3, VertexKind
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Array

VECTOR, PLANAR, SPATIAL = range(3)
_POSES = {SE2: PLANAR, SE3: SPATIAL}


def code_of(kind: VertexKind) -> int:
    """Return how compiled code moves a vertex of a kind: a pose in the plane or in space, or the sum of two vectors."""
    return _POSES.get(kind, VECTOR)


@kernel
def retract_at(x: Array, at: int, code: int, dof: int, step: Array, first: int) -> None:
    """Move the vertex whose stored numbers begin at ``at``, in place, by the numbers of a step from ``first`` on."""
    if code == PLANAR:
        d = (step[first], step[first + 1], step[first + 2])
        x[at], x[at + 1], x[at + 2] = se2.retract((x[at], x[at + 1], x[at + 2]), d)
    elif code == SPATIAL:
        pose = (x[at], x[at + 1], x[at + 2], x[at + 3], x[at + 4], x[at + 5], x[at + 6])
        e = (step[first], step[first + 1], step[first + 2], step[first + 3], step[first + 4], step[first + 5])
        x[at], x[at + 1], x[at + 2], x[at + 3], x[at + 4], x[at + 5], x[at + 6] = se3.retract(pose, e)
    else:
        for i in range(dof):
            x[at + i] += step[first + i]


@kernel
def right_jacobian_at(code: int, dof: int, step: Array, first: int) -> Array:
    """Return what steps (dof,) after a step are to a change of it (dof, dof)."""
    if code == PLANAR:
        return se2.right_jacobian((step[first], step[first + 1], step[first + 2]))
    if code == SPATIAL:
        return se3.right_jacobian(
            (step[first], step[first + 1], step[first + 2], step[first + 3], step[first + 4], step[first + 5])
        )
    return np.eye(dof)


@kernel
def append_motion(x: Array, code: int, motion: Array) -> None:
    """Move the pose with which ``x`` begins by a motion, in place; its angle is not wrapped."""
    if code == PLANAR:
        x[0], x[1], x[2] = se2.compose((x[0], x[1], x[2]), (motion[0], motion[1], motion[2]))
    else:
        m = (motion[0], motion[1], motion[2], motion[3], motion[4], motion[5], motion[6])
        x[0], x[1], x[2], x[3], x[4], x[5], x[6] = se3.compose((x[0], x[1], x[2], x[3], x[4], x[5], x[6]), m)


@kernel
def adjoint_of_inverse(code: int, motion: Array) -> Array:
    """Return the adjoint (dof, dof) of the inverse of a motion: ``Exp(d) T = T Exp(Ad d)``."""
    if code == PLANAR:
        back = se2.inverse((motion[0], motion[1], motion[2]))
        c, s = np.cos(back[2]), np.sin(back[2])
        return np.array([[c, -s, back[1]], [s, c, -back[0]], [0.0, 0.0, 1.0]])
    inverse = se3.inverse((motion[0], motion[1], motion[2], motion[3], motion[4], motion[5], motion[6]))
    turn, shift, out = so3.matrix(se3.rotation(inverse)), so3.hat(se3.position(inverse)), np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            out[i, j] = out[3 + i, 3 + j] = turn[i, j]
            for k in range(3):
                out[i, 3 + j] += shift[i, k] * turn[k, j]
    return out


@kernel
def adjoints_of_inverses(code: int, motions: Array) -> Array:
    """Return those (n, dof, dof) of motions (n, size)."""
    dof = 3 if code == PLANAR else 6
    out = np.empty((len(motions), dof, dof))
    for k in range(len(motions)):
        one = adjoint_of_inverse(code, motions[k])
        for i in range(dof):
            for j in range(dof):
                out[k, i, j] = one[i, j]
    return out
