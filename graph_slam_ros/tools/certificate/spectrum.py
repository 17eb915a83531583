"""From an estimate to a critical point of SE-Sync's problem, and the smallest eigenvalue of the certificate there."""

from collections.abc import Callable
from dataclasses import dataclass
from math import nan

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, splu

from graph_slam_ros.tools.certificate.synchronization import Poses, Synchronization
from graph_slam_ros.typing import Array

_MOST_STEPS = 100
_DAMPING_FIRST, _DAMPING_MOST, _FACTOR = 1e-4, 1e8, 10.0
_ROUNDING = 1e-13  # of a cost
_SMALLEST_STEP = 1e-10  # m, rad


@dataclass(frozen=True, slots=True)
class Polished:
    """A critical point and its cost; ``converged``: whether it is one."""

    poses: Poses
    cost: float
    converged: bool


def polish(problem: Synchronization, x: Poses, root: int) -> Polished:
    """Minimise the chordal cost from x, with the root's pose as it is.

    Newton's method converges quadratically, as Gauss-Newton does not where residuals are large, so that the gradient
    comes down to rounding: the certificate is exact at a critical point only. Where the Hessian is not positive
    definite or the cost would rise, the scaled diagonal is added (Levenberg-Marquardt); so it ends in a minimum, which
    may be a local one.
    """
    cost, damping = problem.cost(x), 0.0
    for _ in range(_MOST_STEPS):
        hessian, gradient, scale = problem.newton(x, root)
        while True:
            solve = factorize((hessian + damping * diags_array(scale)).tocsc())
            if solve is not None:
                step = -solve(gradient)
                there = problem.retract(x, step, root)
                reached = problem.cost(there)
                if reached <= cost * (1.0 + _ROUNDING):
                    break
                if np.abs(step).max() < _SMALLEST_STEP:  # noise alone keeps a cost of next to nothing from falling
                    return Polished(x, cost, True)
            damping = max(_DAMPING_FIRST, _FACTOR * damping)
            if damping > _DAMPING_MOST:
                return Polished(x, cost, False)
        x, cost = there, reached
        model_decrease = -float(gradient @ step)
        if damping <= 1.0 and np.abs(step).max() < _SMALLEST_STEP:  # also at a saddle, which is critical, too
            return Polished(x, cost, True)
        if not damping and model_decrease <= 0.1 * _ROUNDING * cost:
            return Polished(x, cost, True)
        damping = damping / _FACTOR if damping > _DAMPING_FIRST else 0.0
    return Polished(x, cost, False)


def factorize(matrix: csc_array) -> Callable[[Array], Array] | None:
    """A function that solves with a symmetric sparse matrix; None where it is not positive definite.

    Pivots come from the diagonal, so the triangular factors are those of ``L D L'`` and the pivots have the signs
    of the eigenvalues (Sylvester).
    """
    try:
        lu = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # exactly singular
        return None
    if (lu.perm_r != lu.perm_c).any() or not (lu.U.diagonal() > 0.0).all():
        return None
    solve: Callable[[Array], Array] = lu.solve
    return solve


def least_eigenvalue(matrix: csc_array, eliminated: int, tolerance: float) -> float:
    """Smallest eigenvalue of the Schur complement S of a matrix, where its first unknowns are eliminated.

    Returns the eigenvalue; where the iteration does not converge, the shift, which is below it; NaN where no shift is
    enough, since the block of the first unknowns is not positive definite or cannot be told from rounding.

    Lanczos' method on ``(S - s)^-1``, which needs no more than a factorisation of the sparse matrix itself. The shift s
    is below the whole spectrum (or the factorisation fails, and a lower one is tried), so the eigenvalue sought
    is the largest of the inverse however many others are near to it: where a certificate holds, d of them are zero, and
    an iteration without the inverse sees no difference between these and the next ones.

    Parameters
    ----------
    matrix : symmetric; its block of the first ``eliminated`` unknowns is positive definite
    tolerance : the first shift is minus this, > 0
    """
    size = matrix.shape[0] - eliminated
    ones = np.concatenate([np.zeros(eliminated), np.ones(size)])
    shift, lowest = -tolerance, -_FACTOR * float(abs(matrix).sum(axis=0).max())
    solve = factorize((matrix - shift * diags_array(ones)).tocsc())
    while solve is None:
        if shift < lowest:
            return nan
        shift *= _FACTOR
        solve = factorize((matrix - shift * diags_array(ones)).tocsc())
    whole = solve

    def inverse(x: Array) -> Array:
        return whole(np.concatenate([np.zeros(eliminated), x.ravel()]))[eliminated:]

    start = np.cos(np.arange(size))  # like a random one, and the same every time
    operator = LinearOperator((size, size), matvec=inverse, dtype=np.float64)
    try:
        (largest,) = eigsh(operator, k=1, which="LA", v0=start, return_eigenvectors=False)
    except ArpackNoConvergence:
        return shift
    return float(shift + 1.0 / largest)
