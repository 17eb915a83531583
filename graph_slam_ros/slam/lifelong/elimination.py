"""Dense elimination by the solver's own kernels, and products that do not depend on the number of threads of BLAS."""

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.solver.clique_tree.numeric import pack, partial_cholesky, solve_upper
from graph_slam_ros.solver.clique_tree.storage import NOTHING, packed_size
from graph_slam_ros.typing import Array, Index


def product(a: Array, b: Array) -> Array:
    """Return the product of two matrices, or of a matrix and a vector."""
    return np.einsum("ij,j...->i...", a, b, optimize=False)


def quadratic(information: Array, residual: Array) -> float:
    """Return ``r' W r``."""
    return float(np.einsum("i,ij,j->", residual, information, residual, optimize=False))


def marginal_information(information: Array, kept: Index) -> Array:
    """Return the information (k, k) of some variables, in this order, after the others were marginalised out.

    Raises
    ------
    SingularError
        The others are not determined.
    """
    others = np.setdiff1d(np.arange(len(information)), kept)
    order = np.concatenate([others, kept])
    front = _eliminated(information[np.ix_(order, order)], len(others))
    return symmetric(front[len(others) :, len(others) : -1])


def without(information: Array, columns: Array) -> Array:
    """Return ``W - W J (J'W J)^-1 J'W``: the information (n, n) after steps along the columns of J (n, k) were freed.

    Raises
    ------
    SingularError
        The information does not resist one of these steps.
    """
    k = columns.shape[1]
    along = product(information, columns)
    whole = np.empty((k + len(information),) * 2)
    whole[:k, :k], whole[:k, k:] = product(columns.T, along), along.T
    whole[k:, :k], whole[k:, k:] = along, information
    return symmetric(_eliminated(whole, k)[k:, k:-1])


def square_root(information: Array) -> Array:
    """Return the upper triangle R with ``R'R = W``. Raises SingularError where W is not positive definite."""
    front = np.triu(_eliminated(information, len(information))[:, :-1])
    diagonal = np.diag_indices(len(front))
    front[diagonal] = 1.0 / front[diagonal]
    return front


def solution(information: Array, right_side: Array) -> Array:
    """Return ``W^-1 b``. Raises SingularError where W is not positive definite."""
    n = len(information)
    front = _eliminated(information, n, right_side)
    packed, x = np.empty(packed_size(n)), np.zeros(n)
    pack(front, packed)
    solve_upper(packed, n, n, x)
    return x


def symmetric(upper: Array) -> Array:
    """Return the symmetric matrix that has this upper triangle."""
    above = np.triu(upper)
    return above + np.triu(upper, 1).T


def _eliminated(information: Array, count: int, right_side: Array | None = None) -> Array:
    front = np.zeros((len(information), len(information) + 1))
    front[:, :-1] = information
    if right_side is not None:
        front[:, -1] = right_side
    failed = partial_cholesky(front, count, np.diag(information).copy())
    if failed != NOTHING:
        raise SingularError(f"row {failed} of {len(information)} is not determined")
    return front
