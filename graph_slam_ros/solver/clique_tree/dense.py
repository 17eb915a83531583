"""Dense kernels of the fronts: partial Cholesky and the triangular solution. Sums may be reordered, nothing more."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import overload
from numba.np.linalg import _BLAS, ensure_blas

from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.clique_tree.storage import NOTHING, row_of
from graph_slam_ros.typing import Array

LEAST_PIVOT = 1e-14  # of its diagonal entry: what elimination left of it is rounding
WIDE = 12  # pivots that are applied to the rows below by matrix products
PANEL = 48  # pivots that are applied to the rows below all of them at once: each pass over a large front takes time
FEWEST, SHORTEST = 3, 24  # pivots, and rows below them, for which that pays
STRIP = 24  # rows of one product: half of what it makes on the diagonal is not needed

dense = partial(kernel, fastmath={"reassoc", "contract", "nsz"})


def _subtract_product(front: Array, low: int, high: int, first: int, last: int) -> None:
    """Subtract the product of the pivot rows [low, high) from the rows [first, last)."""
    front[first:last, first:] -= front[low:high, first:last].T @ front[low:high, first:]


# Compiled, it is one call of BLAS in place, by the way that Numba itself takes for np.dot: that would copy the rows and
# their product.
ensure_blas()  # type: ignore[no-untyped-call]
_gemm = _BLAS().numba_xxgemm(types.float64)  # type: ignore[no-untyped-call]
_DOUBLE, _PLAIN, _TRANSPOSED = (np.int8(ord(letter)) for letter in "dnt")


@overload(_subtract_product, jit_options={"error_model": "numpy"})
def _subtract_product_in_place(front: Any, low: Any, high: Any, first: Any, last: Any) -> Callable[..., None]:
    def compiled(front: Any, low: Any, high: Any, first: Any, last: Any) -> None:
        stride = front.shape[1]
        panel, rows = front[low:, first:].ctypes, front[first:, first:].ctypes
        minus, plus = np.full(1, -1.0).ctypes, np.full(1, 1.0).ctypes
        _gemm(
            _DOUBLE, _PLAIN, _TRANSPOSED, stride - first, last - first, high - low,
            minus, panel, stride, panel, stride, plus, rows, stride,
        )  # fmt: skip

    return compiled


@dense
def partial_cholesky(front: Array, frontal: int, diagonal: Array) -> int:
    """Eliminate the first ``frontal`` rows of a symmetric matrix with right sides; returns a row without a pivot.

    ``front`` (n, n + m) holds an upper triangle and m right sides. It becomes [U11 U12 y; . C d]: the factor, its
    diagonal inverted, and what is left for the other rows. NOTHING is returned where all pivots are safely above
    rounding, which is judged by the ``diagonal`` of the whole problem. What is below the diagonal is not used.
    """
    n = front.shape[0]
    for low in range(0, frontal, PANEL):
        high = min(low + PANEL, frontal)
        tall = high - low >= FEWEST and n - high >= SHORTEST
        below = high if tall else n  # rows that get each few pivots at once
        for done in range(low, high, WIDE):
            end = min(done + WIDE, high)
            wide = end - done >= FEWEST and below - end >= SHORTEST
            failed = _eliminate_panel(front, done, end, end if wide else below, diagonal)
            if failed != NOTHING:
                return failed
            if wide:
                _subtract_strips(front, done, end, end, below)
        if tall:
            _subtract_strips(front, low, high, high, n)
    return NOTHING


@dense
def _subtract_strips(front: Array, low: int, high: int, first: int, last: int) -> None:
    """Subtract the product of the pivot rows [low, high) from the rows [first, last), strip by strip."""
    for row in range(first, last, STRIP):
        _subtract_product(front, low, high, row, min(row + STRIP, last))


@dense
def _eliminate_panel(front: Array, low: int, high: int, below: int, diagonal: Array) -> int:
    """Eliminate some rows and subtract their product from those before ``below``; return a row without a pivot."""
    for a in range(low, high, 4):
        last = min(a + 4, high)
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
        elif last - a == 3:
            _subtract_three(front, last, below, a)
        elif last - a == 2:
            _subtract_two(front, last, below, a)
        else:
            for i in range(last, below):
                _subtract(front, i, i, a)
    return NOTHING


@dense
def _subtract(front: Array, row: int, column: int, pivot: int) -> None:
    """Subtract a multiple of a pivot row from a row, from a column on."""
    share = front[pivot, row]
    for j in range(column, front.shape[1]):
        front[row, j] -= share * front[pivot, j]


@dense
def _subtract_four(front: Array, low: int, high: int, pivot: int) -> None:
    """Subtract multiples of four pivot rows from rows: each number is loaded and stored once for four."""
    one, two, three, four = front[pivot], front[pivot + 1], front[pivot + 2], front[pivot + 3]
    for i in range(low, high):
        row = front[i]
        a, b, c, d = one[i], two[i], three[i], four[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j] + c * three[j] + d * four[j]


@dense
def _subtract_three(front: Array, low: int, high: int, pivot: int) -> None:
    """The same of three pivot rows, which is what a pose in the plane has."""
    one, two, three = front[pivot], front[pivot + 1], front[pivot + 2]
    for i in range(low, high):
        row = front[i]
        a, b, c = one[i], two[i], three[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j] + c * three[j]


@dense
def _subtract_two(front: Array, low: int, high: int, pivot: int) -> None:
    """The same of two pivot rows: what is left of a pose in space."""
    one, two = front[pivot], front[pivot + 1]
    for i in range(low, high):
        row = front[i]
        a, b = one[i], two[i]
        for j in range(i, front.shape[1]):
            row[j] -= a * one[j] + b * two[j]


@kernel
def pack(front: Array, packed: Array) -> None:
    """Pack the upper triangle of a front (n, n + 1) with its right side, row after row."""
    rows = front.shape[0]
    for i in range(rows):
        at = row_of(i, rows)
        source, target = front[i, i:], packed[at + i : at + rows + 1]
        for j in range(len(source)):
            target[j] = source[j]


@dense
def solve_upper(packed: Array, rows: int, frontal: int, x: Array) -> None:
    """``x_F = U11^-1 (y - U12 x_S)``: x holds x_S behind the first ``frontal`` numbers, and gets x_F there."""
    for a in range(frontal - 1, -1, -1):
        at, count = row_of(a, rows), rows - a
        row, behind = packed[at + a : at + rows + 1], x[a:rows]
        s = row[count]
        for i in range(1, count):
            s -= row[i] * behind[i]
        x[a] = s * row[0]
