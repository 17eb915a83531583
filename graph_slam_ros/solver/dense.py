"""Dense kernels of the fronts: partial Cholesky and the triangular solution. Sums may be reordered, nothing more."""

import numba
import numpy as np

from graph_slam_ros.solver.tree import NOTHING, Array

LEAST_PIVOT = 1e-14  # of its diagonal entry: what elimination left of it is rounding
WIDE = 48  # pivots that are applied to the rows below by one matrix product

dense = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})


@dense
def partial_cholesky(front: Array, frontal: int, diagonal: Array) -> int:
    """Eliminate the first ``frontal`` rows of a symmetric matrix with right sides; returns a row without a pivot.

    ``front`` (n, n + m) holds an upper triangle and m right sides. It becomes [U11 U12 y; . C d]: the factor, its
    diagonal inverted, and what is left for the other rows. NOTHING is returned where all pivots are safely above
    rounding, which is judged by the ``diagonal`` of the whole problem.
    """
    n = front.shape[0]
    done = 0
    while done < frontal:
        wide = frontal - done >= WIDE and n - done >= 3 * WIDE
        end = done + WIDE if wide else frontal
        below = end if wide else n
        for a in range(done, end, 4):
            last = min(a + 4, end)
            for p in range(a, last):
                for q in range(a, p):
                    _subtract(front, p, p, q)
                if not front[p, p] > LEAST_PIVOT * diagonal[p]:
                    return p
                inverse = 1.0 / np.sqrt(front[p, p])
                front[p, p] = inverse
                for j in range(p + 1, front.shape[1]):
                    front[p, j] *= inverse
            if last - a == 4:
                _subtract_four(front, last, below, a)
            else:
                for i in range(last, below):
                    for q in range(a, last):
                        _subtract(front, i, i, q)
        if wide:
            _subtract_panel(front, done, end)
        done = end
    return NOTHING


@dense
def _subtract(front: Array, row: int, column: int, pivot: int) -> None:
    """Take a pivot row's share out of a row, from a column on."""
    share = front[pivot, row]
    for j in range(column, front.shape[1]):
        front[row, j] -= share * front[pivot, j]


@dense
def _subtract_four(front: Array, low: int, high: int, pivot: int) -> None:
    """Take four pivot rows' shares out of rows: each number is loaded and stored once for four."""
    one, two, three, four = front[pivot], front[pivot + 1], front[pivot + 2], front[pivot + 3]
    for i in range(low, high):
        row = front[i]
        a, b, c, d = one[i], two[i], three[i], four[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j] + c * three[j] + d * four[j]


@dense
def _subtract_panel(front: Array, low: int, high: int) -> None:
    """Take many pivot rows' shares out of all rows below, by matrix products."""
    for first in range(high, front.shape[0], WIDE):
        last = min(first + WIDE, front.shape[0])
        panel = front[low:high, first:].copy()
        own = panel[:, : last - first].copy()
        front[first:last, first:] -= np.dot(own.T, panel)


@dense
def solve_upper(front: Array, frontal: int, x: Array) -> None:
    """``x_F = U11^-1 (y - U12 x_S)``: x holds x_S behind the first ``frontal`` numbers, and gets x_F there."""
    n = front.shape[0]
    for a in range(frontal - 1, -1, -1):
        s = front[a, n]
        for i in range(a + 1, n):
            s -= front[a, i] * x[i]
        x[a] = s * front[a, a]
