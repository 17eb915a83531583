"""Normal equations of a chain of poses with a border: landmarks, and parameters of the whole drive.

Odometry connects each pose with the next one only, so the part of the poses is a band. A short border is solved for
after it (Schur complement). Of a long one the landmarks, each seen from some poses, are factorised with the poses as a
sparse matrix, and the parameters of the whole drive, which are coupled with everything, are solved for after it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse.linalg import SuperLU, splu

from graph_slam_ros.typing import Array, Index

_SHORT = 48  # unknowns of a border that is dense
_SYMMETRIC = {"SymmetricMode": True}


@dataclass(frozen=True, slots=True)
class Rows:
    """Linearised residuals, whitened.

    Attributes
    ----------
    of_chain, of_border : (k, m, c), (k, m, d) derivatives by unknowns of the chain and of the border
    residuals : (k, m)
    first : (k,) the first unknown of the chain; the other c - 1 follow
    border : (k, d) unknowns of the border
    """

    of_chain: Array
    of_border: Array
    residuals: Array
    first: Index
    border: Index


@dataclass(slots=True)
class Pattern:
    """The places of the entries of the sparse matrix: the same for equations whose rows differ in their numbers only.

    Attributes
    ----------
    is_ordered : whether the order is one with little fill, which the first factorisation finds
    order : (n,) of elimination
    corner : places of entries in the part of the border that is factorised
    source, indices, indptr : of the matrix in that order, by columns: places of its entries among all, and their rows
    diagonal : (n,) places of the diagonal among these entries
    """

    is_ordered: bool = False
    order: Index = field(init=False)
    corner: Index = field(init=False)
    source: Index = field(init=False)
    indices: Index = field(init=False)
    indptr: Index = field(init=False)
    diagonal: Index = field(init=False)

    def arrange(self, rows: Index, columns: Index, source: Index, order: Index) -> None:
        """Arrange entries, by their row, column and place among all, in an order."""
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        parts = source + 1.0, (place[rows], place[columns])  # no entry is zero
        matrix = sparse.coo_matrix(parts, (len(order), len(order))).tocsc()
        matrix.sort_indices()
        self.order, self.source = order, matrix.data.astype(np.int64) - 1
        self.indices, self.indptr = matrix.indices, matrix.indptr
        of_column = np.repeat(np.arange(len(order)), np.diff(matrix.indptr))
        self.diagonal = np.flatnonzero(matrix.indices == of_column)

    def factor(self, numbers: Array, added: Array, ordering: str) -> SuperLU:
        """Factorise the matrix with these entries, and with numbers (n,) added to its diagonal."""
        data = numbers[self.source]
        data[self.diagonal] += added[self.order]
        matrix = sparse.csc_matrix((data, self.indices, self.indptr), (len(added), len(added)))
        try:
            return splu(matrix, permc_spec=ordering, diag_pivot_thresh=0.0, options=_SYMMETRIC)
        except RuntimeError as error:  # it is singular
            raise np.linalg.LinAlgError(str(error)) from None


@dataclass(frozen=True, slots=True)
class Factor:
    """The factorised equations.

    Attributes
    ----------
    own : solves for the chain, with the landmarks of a long border
    coupling, solved : (last, n - last) rows of the unknowns that are solved for last, and these rows, solved for
    corner : (last, last) what is left
    border : unknowns of the border
    log_determinant : of the matrix
    """

    own: Callable[[Array], Array]
    coupling: Array
    solved: Array
    corner: Array
    border: int
    log_determinant: float

    def solve(self, b: Array) -> Array:
        """Solve for right-hand sides (n,) or (n, k)."""
        count = self.coupling.shape[1]
        own = self.own(b[:count])
        last = np.linalg.solve(self.corner, b[count:] - self.coupling @ own)
        return np.concatenate([own - self.solved @ last, last])

    def border_covariance(self, some: Index) -> Array:
        """The covariance of some unknowns of the border, each solved for by itself."""
        size = self.coupling.shape[1] + len(self.corner)
        at = size - self.border + some
        unit = np.zeros((size, len(at)))
        unit[at, np.arange(len(at))] = 1.0
        return self.solve(unit)[at]


class BorderedEquations:
    """The sum of ``J' J`` over all rows, and ``-J' r``.

    Parameters
    ----------
    count, size : unknowns of the chain and of the border
    width : of the chain's longest row: so many unknowns that follow one another
    parameters : the last so many unknowns of the border are of the whole drive
    pattern : of equations whose rows differ in their numbers only, or a new one; it is arranged when it is needed

    Attributes
    ----------
    b : (count + size,) right-hand side
    """

    def __init__(
        self, rows: list[Rows], count: int, size: int, width: int, parameters: int, pattern: Pattern | None = None
    ) -> None:
        self._rows, self._parameters, self._pattern = rows, parameters, pattern or Pattern()
        self._band, self._corner = np.zeros((width, count)), np.zeros((size, size))
        self.b = np.zeros(count + size)
        at, columns, values = [], [], []
        for one in rows:
            c, d = one.of_chain.shape[2], one.of_border.shape[2]
            every = np.concatenate([one.of_chain, one.of_border, one.residuals[..., None]], axis=2)
            every = np.ascontiguousarray(every.transpose(2, 1, 0))  # a long last axis is fast
            for i in range(c):  # the lower band has the entry (i, j) at [i - j, j]
                for j in range(i + 1):
                    both = (every[i] * every[j]).sum(axis=0)
                    self._band[i - j] += np.bincount(one.first + j, both, minlength=count)
                at.append(np.tile(one.first + i, d))
                values.append((every[i] * every[c:-1]).sum(axis=1).ravel())
                self.b[:count] -= np.bincount(one.first + i, (every[i] * every[-1]).sum(axis=0), minlength=count)
            border = np.ascontiguousarray(one.border.T)
            columns.append(np.tile(border.ravel(), c))
            where, both = size * border[:, None] + border, (every[c:-1, None] * every[c:-1]).sum(axis=2)
            corner = np.bincount(where.ravel(), both.ravel(), minlength=size * size)
            self._corner += corner.reshape(size, size)
            self.b[count:] -= np.bincount(border.ravel(), (every[c:-1] * every[-1]).sum(axis=1).ravel(), minlength=size)
        parts = np.concatenate(values), (np.concatenate(columns), np.concatenate(at))
        self._coupling = sparse.coo_matrix(parts, (size, count)).tocsr()

    @property
    def diagonal(self) -> Array:
        """The diagonal of the matrix."""
        return np.concatenate([self._band[0], self._corner.diagonal()])

    def factor(self, added: Array) -> Factor:
        """Factorise with numbers added to the diagonal.

        Raises
        ------
        numpy.linalg.LinAlgError
            if the matrix is not positive definite
        """
        count = self._band.shape[1]
        last = len(self._corner) if len(self._corner) <= _SHORT else self._parameters
        of_own = len(self._corner) - last
        coupling = np.hstack([self._coupling[of_own:].toarray(), self._corner[of_own:, :of_own]])
        own, pivots = self._sparse(added[: count + of_own]) if of_own else self._banded(added[:count])
        solved = own(coupling.T.copy())
        left = self._corner[of_own:, of_own:] + np.diag(added[count + of_own :]) - coupling @ solved
        pivots = np.concatenate([pivots, np.linalg.cholesky(left).diagonal() ** 2])
        if not (pivots > 0.0).all():
            raise np.linalg.LinAlgError("not positive definite")
        return Factor(own, coupling, solved, left, len(self._corner), float(np.log(pivots).sum()))

    def _banded(self, added: Array) -> tuple[Callable[[Array], Array], Array]:
        """Factorise the chain. Returns what solves for it, and the pivots."""
        band = self._band.copy()
        band[0] += added
        chain = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        return partial(cho_solve_banded, (chain, True), check_finite=False), chain[0] ** 2

    def _sparse(self, added: Array) -> tuple[Callable[[Array], Array], Array]:
        """Factorise the chain with the landmarks. Returns what solves for them, and the pivots."""
        pattern, size = self._pattern, len(added) - self._band.shape[1]
        is_new = not pattern.is_ordered or len(pattern.order) != len(added)
        if is_new:
            self._arrange(size, np.arange(len(added)))
        numbers = np.concatenate([self._band.ravel(), self._coupling.data, self._corner.ravel()[pattern.corner]])
        own, order = pattern.factor(numbers, added, "MMD_AT_PLUS_A" if is_new else "NATURAL"), pattern.order
        if is_new:
            self._arrange(size, np.argsort(own.perm_c))
            pattern.is_ordered = True

        def solved(b: Array) -> Array:
            out = np.empty_like(b)
            out[order] = own.solve(b[order])
            return out

        return solved, own.U.diagonal()

    def _arrange(self, size: int, order: Index) -> None:
        """Arrange the entries of the chain and of the first unknowns of the border, both triangles, in an order."""
        width, count = self._band.shape
        is_chain, is_corner = np.zeros((width, count), dtype=bool), np.eye(len(self._corner), dtype=bool)
        is_chain[0] = True
        for one in self._rows:
            c = one.of_chain.shape[2]
            for j in range(c):
                is_chain[: c - j, one.first + j] = True
            is_corner[one.border[:, :, None], one.border[:, None]] = True
        below, at = np.nonzero(is_chain)
        one_mark, other = np.nonzero(is_corner[:size, :size])
        self._pattern.corner = one_mark * len(is_corner) + other
        ends = self._coupling.indptr[: size + 1]
        entries = int(ends[-1])
        mark = np.repeat(count + np.arange(size), np.diff(ends))
        seen_from = self._coupling.indices[:entries]
        of_chain, of_seen = below * count + at, width * count + np.arange(entries)
        of_corner, is_below = width * count + self._coupling.nnz + np.arange(len(other)), below > 0
        rows = at + below, at[is_below], mark, seen_from, count + one_mark
        columns = at, (at + below)[is_below], seen_from, mark, count + other
        source = of_chain, of_chain[is_below], of_seen, of_seen, of_corner
        self._pattern.arrange(np.concatenate(rows), np.concatenate(columns), np.concatenate(source), order)
