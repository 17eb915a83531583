"""SO(3): rotations of space, as unit quaternions (x, y, z, w).

As in ``se2``, a component may be a float or an array. Formulas follow J. Sola, J. Deray, D. Atchuthan, "A micro Lie
theory for state estimation in robotics", 2018; equation numbers are theirs.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie.jit import jitable

Quaternion: TypeAlias = tuple[Any, Any, Any, Any]
Vector: TypeAlias = tuple[Any, Any, Any]

IDENTITY = (0.0, 0.0, 0.0, 1.0)
_SMALL = 1e-4  # below this angle [rad] series to the fourth order are exact to rounding


@jitable
def compose(a: Quaternion, b: Quaternion) -> Quaternion:
    """Rotation b, then a: the quaternion product."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@jitable
def inverse(a: Quaternion) -> Quaternion:
    """The conjugate."""
    return -a[0], -a[1], -a[2], a[3]


@jitable
def normalize(a: Quaternion) -> Quaternion:
    """A quaternion scaled to unit length: products drift by rounding."""
    n = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    return a[0] / n, a[1] / n, a[2] / n, a[3] / n


@jitable
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jitable
def act(a: Quaternion, p: Vector) -> Vector:
    """Rotate a point: ``p + 2 w (v x p) + 2 v x (v x p)``."""
    v = (a[0], a[1], a[2])
    t = cross(v, p)
    u = cross(v, t)
    return p[0] + 2.0 * (a[3] * t[0] + u[0]), p[1] + 2.0 * (a[3] * t[1] + u[1]), p[2] + 2.0 * (a[3] * t[2] + u[2])


@jitable
def exp(d: Vector) -> Quaternion:
    """Rotation vector to quaternion, eq. (101); exact at zero."""
    half = 0.5 * np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    k = 0.5 * np.sinc(half / np.pi)
    return k * d[0], k * d[1], k * d[2], np.cos(half)


@jitable
def log(a: Quaternion) -> Vector:
    """Quaternion to the shorter rotation vector, of length at most pi, eq. (105)."""
    sine = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    sign = np.where(a[3] < 0.0, -1.0, 1.0)
    half = np.arctan2(sine, np.abs(a[3]))
    k = sign * 2.0 / np.sinc(half / np.pi) / np.sqrt(sine * sine + a[3] * a[3])
    return k * a[0], k * a[1], k * a[2]


@jitable
def matrix(a: Quaternion) -> NDArray[np.float64]:
    """(3, 3) of one rotation; of many (3, 3, n)."""
    x, y, z, w = a
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


@jitable
def hat(v: Vector) -> NDArray[np.float64]:
    """The matrix (3, 3) of ``v x``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@jitable
def right_jacobian_inverse(d: Vector, v: Vector) -> Vector:
    """``J v`` with ``Log(Exp(d) Exp(e)) = d + J e`` to first order in e, eq. (144): v + d x v / 2 + k d x (d x v)."""
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    if square < _SMALL * _SMALL:
        k = 1.0 / 12.0 + square / 720.0
    else:
        half = 0.5 * np.sqrt(square)
        k = (1.0 - half * np.cos(half) / np.sin(half)) / square
    dv = cross(d, v)
    ddv = cross(d, dv)
    return v[0] + 0.5 * dv[0] + k * ddv[0], v[1] + 0.5 * dv[1] + k * ddv[1], v[2] + 0.5 * dv[2] + k * ddv[2]
