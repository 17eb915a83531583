"""Gaussian noise that refuses what is not symmetric positive definite."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import NoiseError
from graph_slam_ros.typing import Array

_ASYMMETRY = 1e-6  # of the largest entry; text files carry 6 digits
_LEAST_EIGENVALUE = 16.0 * float(np.finfo(float).eps)  # of the correlations; that of a singular matrix is rounding
_ZERO = 1e-12  # eigenvalues of the correlations of what may be singular that are rounding
_SURELY_REGULAR = 1e-6  # root of the determinant of the correlations, which is at most e times their least eigenvalue
_LONG = 120  # characters of a matrix in a message


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Zero-mean noise of one residual, or of n residuals at once.

    Attributes
    ----------
    sqrt_information : (m, m) or (n, m, m), R with ``R'R = Omega``: ``R r`` has unit covariance.
    """

    sqrt_information: Array

    @classmethod
    def from_information(cls, information: ArrayLike) -> "Gaussian":
        """Make it from Omega, (m, m) or (n, m, m). Raises NoiseError naming the first matrix that is not SPD."""
        return cls(np.swapaxes(_cholesky(information, "information"), -1, -2))

    @classmethod
    def from_semidefinite(cls, information: Array) -> "Gaussian":
        """Make it from Omega, (m, m), which may be singular. Raises NoiseError if it is not positive semidefinite."""
        scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
        if not np.isfinite(information).all():
            raise NoiseError(_fault(information[None], "information"))
        size, axes = np.linalg.eigh(information / scale[:, None] / scale)
        if size[0] < -_ZERO or size[-1] < _ZERO:
            raise NoiseError(_fault(information[None], "information"))
        return cls(np.where(size > _ZERO, np.sqrt(np.maximum(size, 0.0)), 0.0)[:, None] * axes.T * scale)

    @classmethod
    def from_covariance(cls, covariance: ArrayLike) -> "Gaussian":
        """Make it from Sigma, (m, m) or (n, m, m). Raises NoiseError naming the first matrix that is not SPD."""
        return cls(np.asarray(np.linalg.inv(_cholesky(covariance, "covariance")), dtype=np.float64))

    @classmethod
    def from_sigmas(cls, *sigmas: ArrayLike) -> "Gaussian":
        """Make it from independent standard deviations, or from a list of them. Raises NoiseError if not positive."""
        each = np.concatenate([np.ravel(sigma) for sigma in sigmas] or [[]]).astype(np.float64)  # type: ignore[list-item]
        if not (each > 0.0).all():
            raise NoiseError(f"standard deviations {each.tolist()}: each must be > 0")
        return cls.from_covariance(np.diag(np.square(each)))

    @property
    def information(self) -> Array:
        """Omega, the shape of ``sqrt_information``."""
        return np.swapaxes(self.sqrt_information, -1, -2) @ self.sqrt_information


def _cholesky(matrices: ArrayLike, what: str) -> Array:
    a = np.asarray(matrices, dtype=float)
    if a.ndim not in (2, 3) or a.shape[-1] != a.shape[-2]:
        raise NoiseError(f"{what}: expected a square matrix or a stack of them, got shape {a.shape}")
    transposed = np.swapaxes(a, -1, -2)
    with np.errstate(invalid="ignore"):
        asymmetry = np.abs(a - transposed).max(axis=(-1, -2), initial=0.0)
        symmetric = asymmetry <= _ASYMMETRY * np.abs(a).max(axis=(-1, -2), initial=0.0)
    if symmetric.all():  # false for what is not finite, too
        root = _definite_root(0.5 * a + 0.5 * transposed)
        if root is not None:
            return root
    raise NoiseError(_fault(a.reshape(-1, *a.shape[-2:]), what))


def _fault(stack: Array, what: str) -> str:
    """The first matrix that is not symmetric positive definite, and why."""
    for row, matrix in enumerate(stack):
        if not np.isfinite(matrix).all():
            why = "not finite"
        elif np.abs(matrix - matrix.T).max() > _ASYMMETRY * np.abs(matrix).max():
            why = "not symmetric"
        elif _definite_root(0.5 * matrix + 0.5 * matrix.T) is None:
            why = "not positive definite"
        else:
            continue
        text = np.array2string(matrix, separator=", ").replace("\n", "")
        if len(text) > _LONG:
            text = f"{len(matrix)} x {len(matrix)} with diagonal {np.array2string(np.diag(matrix), precision=3)}"
        return f"{what} {row} is {why}: {text}"
    return f"{what}: not symmetric positive definite"


def _definite_root(matrices: Array) -> Array | None:
    """Cholesky factors; None where one is singular up to rounding or not definite."""
    try:
        root = np.asarray(np.linalg.cholesky(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    sigmas = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
    if (np.prod(np.diagonal(root, axis1=-2, axis2=-1) / sigmas, axis=-1) > _SURELY_REGULAR).all():
        return root
    least = np.linalg.eigvalsh(matrices / sigmas[..., :, None] / sigmas[..., None, :])[..., 0]
    return root if (least > _LEAST_EIGENVALUE).all() else None
