"""Gaussian noise that refuses what is not symmetric positive definite."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.errors import NoiseError

Array = NDArray[np.float64]

_ASYMMETRY = 1e-6  # of the largest entry; text files carry 6 digits


@dataclass(frozen=True, slots=True)
class Gaussian:
    """Zero-mean noise of one residual, or of n residuals at once.

    Attributes
    ----------
    sqrt_information : (m, m) or (n, m, m), upper triangular R with ``R'R = Omega``: ``R r`` has unit covariance.
    """

    sqrt_information: Array

    @classmethod
    def from_information(cls, information: ArrayLike) -> "Gaussian":
        """From Omega, (m, m) or (n, m, m). Raises NoiseError naming the first matrix that is not SPD."""
        return cls(np.swapaxes(_cholesky(information, "information"), -1, -2))

    @classmethod
    def from_covariance(cls, covariance: ArrayLike) -> "Gaussian":
        """From Sigma, (m, m) or (n, m, m). Raises NoiseError naming the first matrix that is not SPD."""
        lower = _cholesky(covariance, "covariance")
        return cls.from_information(np.linalg.inv(lower @ np.swapaxes(lower, -1, -2)))

    @classmethod
    def from_sigmas(cls, *sigmas: float) -> "Gaussian":
        """From independent standard deviations."""
        return cls.from_covariance(np.diag(np.square(sigmas)))

    @property
    def information(self) -> Array:
        """Omega, the shape of ``sqrt_information``."""
        return np.swapaxes(self.sqrt_information, -1, -2) @ self.sqrt_information


def _cholesky(matrices: ArrayLike, what: str) -> Array:
    a = np.asarray(matrices, dtype=float)
    if a.ndim not in (2, 3) or a.shape[-1] != a.shape[-2]:
        raise NoiseError(f"{what}: expected a square matrix or a stack of them, got shape {a.shape}")
    stack = a.reshape(-1, *a.shape[-2:])

    def refuse(bad: NDArray[np.bool_], why: str) -> None:
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise NoiseError(f"{what} {row} is {why}: {np.array2string(stack[row], separator=', ')}".replace("\n", ""))

    refuse(~np.isfinite(stack).all(axis=(1, 2)), "not finite")
    transposed = np.swapaxes(stack, 1, 2)
    largest = np.abs(stack).max(axis=(1, 2))
    refuse(np.abs(stack - transposed).max(axis=(1, 2)) > _ASYMMETRY * largest, "not symmetric")
    symmetric = 0.5 * (stack + transposed)
    try:
        return np.linalg.cholesky(symmetric).reshape(a.shape)
    except np.linalg.LinAlgError:
        refuse(np.array([not _is_definite(m) for m in symmetric]), "not positive definite")
        raise


def _is_definite(matrix: Array) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
