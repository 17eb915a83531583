"""Kinds of vertices: what is stored for an unknown and how a step changes it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2, se3
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.typing import Array

_UNIT = 1e-2  # a squared norm of a quaternion this near to 1 is that of few digits


@dataclass(frozen=True, slots=True)
class VertexKind:
    """A manifold: ``size`` numbers are stored, a step has ``dof``.

    Attributes
    ----------
    retract : (n, size), (n, dof) -> (n, size), the operator [+]
    local : (n, size), (n, size) -> (n, dof), the operator [-]: ``retract(b, local(a, b)) == a``
    holds : (n, size) -> (n,), whether finite numbers are one of its values; any are where it is left out
    """

    name: str
    size: int
    dof: int
    retract: Callable[[Array, Array], Array]
    local: Callable[[Array, Array], Array]
    holds: Callable[[Array], NDArray[np.bool_]] | None = None

    def fault(self, values: Array) -> tuple[int, str] | None:
        """The first row of (n, size) that is none of its values, and why."""
        finite = np.isfinite(values)
        if np.count_nonzero(finite) < finite.size:  # faster than ``all`` on a few numbers
            return int(finite.all(axis=1).argmin()), "is not finite"
        if self.holds is None or (fit := self.holds(values)).all():
            return None
        return int(fit.argmin()), f"is no {self.name}: its quaternion is not of unit length"


def _retract_se2(values: Array, steps: Array) -> Array:
    # columns of a wider array would be compiled for once more, while a robot drives
    return _retracted_se2(np.ascontiguousarray(values), np.ascontiguousarray(steps))


@kernel
def _retracted_se2(values: Array, steps: Array) -> Array:
    """Compiled: the last digit of NumPy's sine of an array may depend on where in memory the array is."""
    out = np.empty((len(values), 3))
    for i in range(len(values)):
        pose = se2.retract((values[i, 0], values[i, 1], values[i, 2]), (steps[i, 0], steps[i, 1], steps[i, 2]))
        out[i, 0], out[i, 1], out[i, 2] = pose
    return out


def _local_se2(a: Array, b: Array) -> Array:
    return np.stack(se2.local(tuple(a.T), tuple(b.T)), axis=-1)


def _retract_se3(values: Array, steps: Array) -> Array:
    return np.stack(se3.retract(tuple(values.T), tuple(steps.T)), axis=-1)


def _local_se3(a: Array, b: Array) -> Array:
    return np.stack(se3.local(tuple(a.T), tuple(b.T)), axis=-1)


def _has_unit_quaternion(values: Array) -> NDArray[np.bool_]:
    return np.asarray(np.abs((values[:, 3:] ** 2).sum(axis=1) - 1.0) < _UNIT)


def _vector_kind(dof: int) -> VertexKind:
    return VertexKind(f"R{dof}", dof, dof, np.add, np.subtract)


SE2 = VertexKind("SE2", 3, 3, _retract_se2, _local_se2)
SE3 = VertexKind("SE3", 7, 6, _retract_se3, _local_se3, _has_unit_quaternion)
GROUPS = {SE2: se2, SE3: se3}
"""The functions of their group, of kinds that are rigid motions."""
R1, R2, R3 = _vector_kind(1), _vector_kind(2), _vector_kind(3)


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
def adjoints_of_inverses(code: int, motions: Array) -> Array:
    """Return the adjoints (n, dof, dof) of the inverses of motions (n, size): ``Exp(d) T = T Exp(Ad d)``."""
    dof = 3 if code == PLANAR else 6
    out = np.empty((len(motions), dof, dof))
    for k in range(len(motions)):
        m = motions[k]
        if code == PLANAR:
            one = se2.adjoint(se2.inverse((m[0], m[1], m[2])))
        else:
            one = se3.adjoint(se3.inverse((m[0], m[1], m[2], m[3], m[4], m[5], m[6])))
        for i in range(dof):
            for j in range(dof):
                out[k, i, j] = one[i, j]
    return out
