"""SE(3): rigid motions of space.

A pose is a tuple (x, y, z, qx, qy, qz, qw), metres and a unit quaternion; a component may be a float or an array, as in
``se2``. Formulas follow J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.lie import se2, so3
from graph_slam_ros.lie.jit import jitable, kernel
from graph_slam_ros.typing import Array

Pose: TypeAlias = tuple[Any, Any, Any, Any, Any, Any, Any]
Tangent: TypeAlias = tuple[Any, Any, Any, Any, Any, Any]

IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def in_space(poses: ArrayLike) -> Array:
    """Poses (..., 7): those of the plane (..., 3) at height 0 and level, those of space as they are."""
    given = np.asarray(poses, dtype=np.float64)
    if given.shape[-1] == 7:
        return given
    out = np.zeros((*given.shape[:-1], 7))
    out[..., :2] = given[..., :2]
    out[..., 5], out[..., 6] = np.sin(0.5 * given[..., 2]), np.cos(0.5 * given[..., 2])
    return out


def in_plane(poses: ArrayLike) -> Array:
    """Poses (..., 3) of those of space (..., 7): x, y and the heading of their x axis; height, roll, pitch are lost."""
    x, y, _, qx, qy, qz, qw = np.moveaxis(np.asarray(poses, dtype=np.float64), -1, 0)
    return np.stack([x, y, np.arctan2(2.0 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)], axis=-1)


def from_xyz_rpy(numbers: Sequence[float]) -> Pose:
    """Pose of (x, y, z, roll, pitch, yaw) about fixed axes, as URDF writes it."""
    x, y, z, *angles = map(float, numbers)
    q = so3.IDENTITY
    for axis in (2, 1, 0):  # roll is applied first
        q = so3.compose(q, so3.exp((*(angles[k] if k == axis else 0.0 for k in range(3)),)))
    return x, y, z, float(q[0]), float(q[1]), float(q[2]), float(q[3])


def to_matrix(a: Pose) -> Array:
    """Homogeneous matrix (..., 4, 4) of a pose, or of a path of them."""
    numbers = np.stack(np.broadcast_arrays(*a), axis=-1)
    out = np.zeros((*numbers.shape[:-1], 4, 4))
    turns = np.asarray(so3.matrix(tuple(np.moveaxis(numbers[..., 3:], -1, 0))))  # (3, 3, ...)
    out[..., :3, :3] = np.moveaxis(turns, (0, 1), (-2, -1))
    out[..., :3, 3], out[..., 3, 3] = numbers[..., :3], 1.0
    return out


def from_matrix(matrix: ArrayLike) -> Pose:
    """Pose of a homogeneous matrix (..., 4, 4), the inverse of ``to_matrix``; qw is not negative.

    The quaternion comes from its largest component (Shepperd, Quaternion from rotation matrix, 1978).

    Raises
    ------
    GraphSlamError
        It is not a rigid motion.
    """
    m = se2.rigid(matrix, 4)
    r = np.moveaxis(m[..., :3, :3], (-2, -1), (0, 1))
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] + r[1, 2]
    squares = 1.0 + np.stack([r[0, 0] - r[1, 1] - r[2, 2], r[1, 1] - r[0, 0] - r[2, 2], r[2, 2] - r[0, 0] - r[1, 1]])
    w = 1.0 + r[0, 0] + r[1, 1] + r[2, 2]
    # each row is the quaternion times four times one of its components
    rows = np.array([[squares[0], xy, xz, x], [xy, squares[1], yz, y], [xz, yz, squares[2], z], [x, y, z, w]])
    largest = np.concatenate([squares, w[None]]).argmax(axis=0)
    q = np.take_along_axis(rows, largest[None, None], axis=0)[0]
    q = q / np.linalg.norm(q, axis=0) * np.where(q[3] < 0.0, -1.0, 1.0)
    return m[..., 0, 3], m[..., 1, 3], m[..., 2, 3], q[0], q[1], q[2], q[3]


@jitable
def position(a: Pose) -> so3.Vector:
    """The translation."""
    return a[0], a[1], a[2]


@jitable
def rotation(a: Pose) -> so3.Quaternion:
    """The quaternion."""
    return a[3], a[4], a[5], a[6]


@jitable
def act(a: Pose, p: so3.Vector) -> so3.Vector:
    """Point p of frame b in frame a."""
    r = so3.act(rotation(a), p)
    return a[0] + r[0], a[1] + r[1], a[2] + r[2]


@jitable
def compose(a: Pose, b: Pose) -> Pose:
    """``T_a_c = T_a_b T_b_c``."""
    t = act(a, position(b))
    q = so3.compose(rotation(a), rotation(b))
    return t[0], t[1], t[2], q[0], q[1], q[2], q[3]


@jitable
def inverse(a: Pose) -> Pose:
    """``T_b_a`` from ``T_a_b``."""
    q = so3.inverse(rotation(a))
    t = so3.act(q, position(a))
    return -t[0], -t[1], -t[2], q[0], q[1], q[2], q[3]


@jitable
def between(a: Pose, b: Pose) -> Pose:
    """``inverse(a) b``: pose b seen from pose a."""
    back = so3.inverse(rotation(a))
    t = so3.act(back, (b[0] - a[0], b[1] - a[1], b[2] - a[2]))
    q = so3.compose(back, rotation(b))
    return t[0], t[1], t[2], q[0], q[1], q[2], q[3]


@jitable
def exp(d: Tangent) -> Pose:
    """Tangent vector (v, omega) to pose, eq. (172): ``t = v + a (w x v) + b (w x (w x v))``."""
    w = (d[3], d[4], d[5])
    v = (d[0], d[1], d[2])
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    a = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2  # (1 - cos) / angle^2
    b = _cubic(angle)
    wv = so3.cross(w, v)
    wwv = so3.cross(w, wv)
    q = so3.exp(w)
    t = (v[0] + a * wv[0] + b * wwv[0], v[1] + a * wv[1] + b * wwv[1], v[2] + a * wv[2] + b * wwv[2])
    return t[0], t[1], t[2], q[0], q[1], q[2], q[3]


@jitable
def log(a: Pose) -> Tangent:
    """Pose to tangent vector, eq. (173): ``v = t - w x t / 2 + k (w x (w x t))``."""
    w = so3.log(rotation(a))
    t = position(a)
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    half = 0.5 * np.sqrt(square)
    exact = (1.0 - np.cos(half) / np.sinc(half / np.pi)) / np.where(square < 1e-8, 1.0, square)
    k = np.where(square < 1e-8, 1.0 / 12.0 + square / 720.0, exact)
    wt = so3.cross(w, t)
    wwt = so3.cross(w, wt)
    v = (t[0] - 0.5 * wt[0] + k * wwt[0], t[1] - 0.5 * wt[1] + k * wwt[1], t[2] - 0.5 * wt[2] + k * wwt[2])
    return v[0], v[1], v[2], w[0], w[1], w[2]


@jitable
def retract(a: Pose, d: Tangent) -> Pose:
    """``a [+] d = a Exp(d)``, the quaternion brought to unit length."""
    p = compose(a, exp(d))
    q = so3.normalize(rotation(p))
    return p[0], p[1], p[2], q[0], q[1], q[2], q[3]


@jitable
def local(a: Pose, b: Pose) -> Tangent:
    """``a [-] b = Log(b^-1 a)``."""
    return log(between(b, a))


def interpolate(a: Pose, b: Pose, fraction: Any) -> Pose:
    """Pose on the geodesic from a (fraction 0) to b (fraction 1)."""
    v = local(b, a)
    part = (fraction * v[0], fraction * v[1], fraction * v[2], fraction * v[3], fraction * v[4], fraction * v[5])
    return retract(a, part)


@jitable
def adjoint(a: Pose) -> Array:
    """Adjoint matrix (6, 6) of one pose, eq. (175): ``a Exp(d) = Exp(Ad d) a``."""
    turn, out = so3.matrix(rotation(a)), np.zeros((6, 6))
    swept = so3.hat(position(a)) @ turn
    for i in range(3):  # a part of an array that is assigned takes 2 s to compile, for its error message
        for j in range(3):
            out[i, j] = out[3 + i, 3 + j] = turn[i, j]
            out[i, 3 + j] = swept[i, j]
    return out


@jitable
def right_jacobian(d: Tangent) -> Array:
    """``Exp(d + e) = Exp(d) Exp(J e)`` to first order in e; (6, 6) of one vector.

    The series ``sum_k (-ad d)^k / (k + 1)!``, to the last digit: at most 30 terms for rotations up to pi.
    """
    lie, term, out = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    turn, shift = so3.hat((d[3], d[4], d[5])), so3.hat((d[0], d[1], d[2]))
    for i in range(3):
        for j in range(3):
            lie[i, j] = lie[3 + i, 3 + j] = turn[i, j]
            lie[i, 3 + j] = shift[i, j]
        term[i, i] = term[3 + i, 3 + i] = out[i, i] = out[3 + i, 3 + i] = 1.0
    for k in range(2, 40):
        term = _product(term, lie)
        largest = 0.0
        for i in range(6):
            for j in range(6):
                term[i, j] *= -1.0 / k
                out[i, j] += term[i, j]
                largest = max(largest, abs(term[i, j]))
        if largest < 1e-17:
            break
    return out


@kernel
def _product(a: Array, b: Array) -> Array:
    """The matrix product, without the checks of ``@``, which take seconds to compile."""
    out = np.zeros((len(a), b.shape[1]))
    for i in range(len(a)):
        for k in range(len(b)):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@kernel
def _turned(a: Array, covariance: Array) -> Array:
    """``A Sigma A'``, of matrices (6, 6)."""
    half, out = _product(a, covariance), np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(6):
                out[i, j] += half[i, k] * a[j, k]
    return out


@kernel
def noise_during(step: Pose, covariance: Array) -> Array:
    """Noise (6, 6) of velocities that acted all through a step, in the tangent space at its end; see ``se2``."""
    return _turned(right_jacobian(log(step)), covariance)


@kernel
def propagate(covariance: Array, step: Pose, added: Array) -> Array:
    """Covariance (6, 6) of a motion lengthened by one step; see ``se2``."""
    back = inverse(step)
    turn, shift = so3.matrix(rotation(back)), so3.hat(position(back))
    moved, a = _product(shift, turn), np.zeros((6, 6))  # a is the adjoint
    for i in range(3):
        for j in range(3):
            a[i, j] = a[3 + i, 3 + j] = turn[i, j]
            a[i, 3 + j] = moved[i, j]
    out = _turned(a, covariance)
    for i in range(6):
        for j in range(6):
            out[i, j] += added[i, j]
    return out


@kernel
def propagate_during(covariance: Array, step: Pose, of_twist: Array) -> Array:
    """The same as ``propagate``, for noise that acted all through the step (``noise_during``)."""
    return propagate(covariance, step, noise_during(step, of_twist))


compose_one, between_one = kernel(compose), kernel(between)
"""``compose`` and ``between`` of single poses of floats, compiled: several times as fast."""


@jitable
def _cubic(angle: Any) -> Any:
    """(angle - sin(angle)) / angle^3, by its series where the difference cancels."""
    square = angle * angle
    series = 1.0 / 6.0 - square / 120.0 + square * square / 5040.0
    exact = (angle - np.sin(angle)) / np.where(square < 1e-2, 1.0, angle * square)
    return np.where(square < 1e-2, series - square**3 / 362880.0, exact)
