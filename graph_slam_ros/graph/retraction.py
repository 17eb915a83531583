"""Steps of vertices for compiled code that does not know their kinds."""

import numpy as np

from graph_slam_ros.graph.vertices import SE2, SE3, VertexKind
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Array

VECTOR, PLANAR, SPATIAL = range(3)
_POSES = {SE2: PLANAR, SE3: SPATIAL}


def code_of(kind: VertexKind) -> int:
    """Return how a vertex of a kind is moved: PLANAR and SPATIAL are poses, and to a VECTOR the step is added."""
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
        return se2.adjoint(se2.inverse((motion[0], motion[1], motion[2])))
    m = (motion[0], motion[1], motion[2], motion[3], motion[4], motion[5], motion[6])
    return se3.adjoint(se3.inverse(m))


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
