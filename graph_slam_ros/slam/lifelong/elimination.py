"""Dense elimination: what some variables of a Gaussian know without the others."""

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.solver.clique_tree.numeric import LEAST_PIVOT
from graph_slam_ros.typing import Array, Index


def marginal_information(information: Array, kept: Index) -> Array:
    """Return the information (k, k) of some variables, in this order, after the others were marginalised out.

    Raises
    ------
    SingularError
        The others are not determined.
    """
    others = np.setdiff1d(np.arange(len(information)), kept)
    between = information[np.ix_(others, kept)]
    return _left(information[np.ix_(kept, kept)], information[np.ix_(others, others)], between)


def without(information: Array, columns: Array) -> Array:
    """Return ``W - W J (J'W J)^-1 J'W``: the information (n, n) after steps along the columns of J (n, k) were freed.

    Raises
    ------
    SingularError
        The information does not resist one of these steps.
    """
    along = information @ columns
    return _left(information, columns.T @ along, along.T)


def square_root(information: Array) -> Array:
    """Return the upper triangle R with ``R'R = W``. Raises SingularError where W is not positive definite."""
    try:
        root = np.asarray(np.linalg.cholesky(information).T, dtype=np.float64)
    except np.linalg.LinAlgError:
        raise SingularError("what was measured does not determine all of it") from None
    if not (np.square(root.diagonal()) > LEAST_PIVOT * information.diagonal()).all():
        raise SingularError("what was measured determines all of it by rounding alone")
    return root


def solution(information: Array, right_side: Array) -> Array:
    """Return ``W^-1 b``. Raises SingularError where W is not positive definite."""
    root = square_root(information)
    return np.asarray(np.linalg.solve(root, np.linalg.solve(root.T, right_side)))


def symmetric(upper: Array) -> Array:
    """Return the symmetric matrix that has this upper triangle."""
    return np.triu(upper) + np.triu(upper, 1).T


def _left(information: Array, freed: Array, between: Array) -> Array:
    half = np.linalg.solve(square_root(freed).T, between)
    return symmetric(information - half.T @ half)
