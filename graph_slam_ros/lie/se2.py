"""SE(2): rigid motions of the plane.

A pose is a tuple (x, y, theta) in metres and radians. Each component may be a float or an array: the same formula
serves one pose, a whole path (``compose(tuple(a.T), tuple(b.T))``) and the compiled kernels.

Formulas follow J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, section
on SE(2); equation numbers below are theirs.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie.jit import inner, jitable, kernel
from graph_slam_ros.typing import Array

Pose: TypeAlias = tuple[Any, Any, Any]

IDENTITY = (0.0, 0.0, 0.0)


@jitable
def wrap(angle: Any) -> Any:
    """Angle in [-pi, pi), radians."""
    return angle - 2.0 * np.pi * np.floor((angle + np.pi) / (2.0 * np.pi))


@jitable
def compose(a: Pose, b: Pose) -> Pose:
    """``T_a_c = T_a_b T_b_c``; the angle is not wrapped."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


@jitable
def inverse(a: Pose) -> Pose:
    """``T_b_a`` from ``T_a_b``."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


@jitable
def between(a: Pose, b: Pose) -> Pose:
    """``inverse(a) b``: pose b seen from pose a, angle wrapped."""
    c, s = np.cos(a[2]), np.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return c * dx + s * dy, c * dy - s * dx, wrap(b[2] - a[2])


@jitable
def act(a: Pose, p: Any) -> tuple[Any, Any]:
    """Point p = (x, y) of frame b in frame a."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return a[0] + c * p[0] - s * p[1], a[1] + s * p[0] + c * p[1]


@jitable
def exp(d: Pose) -> Pose:
    """Tangent vector (vx, vy, omega) to pose, eq. (156); exact at omega = 0 (sin(w/2)/(w/2) has no cancellation)."""
    half = 0.5 * d[2]
    sinc = np.sinc(half / np.pi)
    a, b = sinc * np.cos(half), sinc * np.sin(half)
    return a * d[0] - b * d[1], b * d[0] + a * d[1], d[2]


@jitable
def log(a: Pose) -> Pose:
    """Pose to tangent vector, eq. (157), with omega in [-pi, pi)."""
    omega = wrap(a[2])
    half = 0.5 * omega
    k = np.cos(half) / np.sinc(half / np.pi)
    return k * a[0] + half * a[1], k * a[1] - half * a[0], omega


@jitable
def retract(a: Pose, d: Pose) -> Pose:
    """``a [+] d = a Exp(d)``, angle wrapped."""
    x, y, theta = compose(a, exp(d))
    return x, y, wrap(theta)


@jitable
def local(a: Pose, b: Pose) -> Pose:
    """``a [-] b = Log(b^-1 a)``."""
    return log(between(b, a))


def to_matrix(a: Pose) -> Array:
    """Homogeneous matrix (..., 3, 3) of a pose, or of a path of them."""
    x, y, theta = np.broadcast_arrays(*a)
    out = np.zeros((*x.shape, 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(theta)
    out[..., 1, 0] = np.sin(theta)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 0, 2], out[..., 1, 2], out[..., 2, 2] = x, y, 1.0
    return out


def from_matrix(matrix: ArrayLike) -> Pose:
    """Pose of a homogeneous matrix (..., 3, 3), the inverse of ``to_matrix``.

    Raises
    ------
    GraphSlamError
        It is not a rigid motion of the plane.
    """
    m = rigid(matrix, 3)
    return m[..., 0, 2], m[..., 1, 2], np.arctan2(m[..., 1, 0], m[..., 0, 0])


def rigid(matrix: ArrayLike, size: int) -> Array:
    """The matrices (..., size, size), checked to be rigid motions.

    Raises
    ------
    GraphSlamError
        The shape is another, the rotation is none (to 1e-6), or the last row is not 0 .. 0 1.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if m.shape[-2:] != (size, size):
        raise GraphSlamError(f"a homogeneous matrix has the shape ({size}, {size}), not {m.shape}")
    rotation, last = m[..., :-1, :-1], np.eye(size)[-1]
    is_rotation = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - np.eye(size - 1)).max(initial=0.0) < 1e-6
    if not (is_rotation and (np.linalg.det(rotation) > 0.0).all() and (m[..., -1, :] == last).all()):
        raise GraphSlamError(f"not a rigid motion: {m.tolist() if m.ndim == 2 else f'one of {len(m)} matrices'}")
    return m


def interpolate(a: Pose, b: Pose, fraction: float) -> Pose:
    """Pose on the geodesic from a (fraction 0) to b (fraction 1)."""
    x, y, omega = local(b, a)
    return retract(a, (fraction * x, fraction * y, fraction * omega))


@jitable
def adjoint(a: Pose) -> NDArray[np.float64]:
    """Adjoint matrix (3, 3) of one pose, eq. (159): ``a Exp(d) = Exp(Ad d) a``."""
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([[c, -s, a[1]], [s, c, -a[0]], [0.0, 0.0, 1.0]])


@jitable
def right_jacobian(d: Pose) -> NDArray[np.float64]:
    """``Exp(d + e) = Exp(d) Exp(J e)`` to first order in e, eq. (163), exact at omega = 0; (3, 3) of one vector."""
    vx, vy, w = d
    a, q = np.sinc(w / np.pi), 0.5 * np.sinc(0.5 * w / np.pi) ** 2  # sin(w) / w and (1 - cos(w)) / w^2
    b = w * q
    p = (w - np.sin(w)) / w**2 if abs(w) > 1e-3 else w / 6.0 - w**3 / 120.0
    return np.array([[a, b, p * vx - q * vy], [-b, a, q * vx + p * vy], [0.0, 0.0, 1.0]])


@inner
def _turned(a: Array, covariance: Array) -> Array:
    """``A Sigma A'``, of matrices (3, 3)."""
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    out[i, j] += a[i, k] * covariance[k, m] * a[j, m]
    return out


@kernel
def noise_during(step: Pose, covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Noise (3, 3) of velocities that acted all through a step, in the tangent space at its end.

    With ``d = Log(step)`` and the covariance of d given, that of ``Exp(d)`` is ``J Sigma J'``.
    """
    return _turned(right_jacobian(log(step)), covariance)


@kernel
def propagate(covariance: NDArray[np.float64], step: Pose, added: NDArray[np.float64]) -> NDArray[np.float64]:
    """Covariance of a motion lengthened by one step.

    ``Sigma_ac = A Sigma_ab A' + Sigma_bc`` with ``A = Ad(T_b_c)^-1``: both in right tangent coordinates.

    Parameters
    ----------
    covariance : (3, 3) of ``T_a_b``
    step : the pose ``T_b_c``
    added : (3, 3) covariance of the step
    """
    out = _turned(adjoint(inverse(step)), covariance)
    for i in range(3):
        for j in range(3):
            out[i, j] += added[i, j]
    return out


@kernel
def propagate_during(covariance: NDArray[np.float64], step: Pose, of_twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same as ``propagate``, for noise that acted all through the step (``noise_during``)."""
    return propagate(covariance, step, noise_during(step, of_twist))


compose_one, between_one = kernel(compose), kernel(between)
"""``compose`` and ``between`` of single poses of floats, compiled: several times as fast."""
