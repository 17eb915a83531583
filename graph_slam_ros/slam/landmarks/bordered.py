"""Normal equations of a chain of poses with a border: landmarks, and parameters of the whole drive.

Odometry connects each pose with the next one only, so the part of the poses is a band. A short border is solved for
after it (Schur complement). Of a long one the landmarks, each seen from some poses, are factorised with the poses as a
sparse matrix, and the parameters of the whole drive, which are coupled with everything, are solved for after it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse.linalg import splu

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

    Attributes
    ----------
    b : (count + size,) right-hand side
    """

    def __init__(self, rows: list[Rows], count: int, size: int, width: int, parameters: int) -> None:
        self._parameters = parameters
        self._band, self._corner = np.zeros((width, count)), np.zeros((size, size))
        self.b = np.zeros(count + size)
        at, columns, values = [], [], []
        for one in rows:
            k, c, d = len(one.first), one.of_chain.shape[2], one.of_border.shape[2]
            transposed, by_border = one.of_chain.transpose(0, 2, 1), one.of_border.transpose(0, 2, 1)
            own = transposed @ one.of_chain
            for i in range(c):  # the lower band has the entry (i, j) at [i - j, j]
                for j in range(i + 1):
                    self._band[i - j] += np.bincount(one.first + j, own[:, i, j], minlength=count)
            of_chain = one.first[:, None] + np.arange(c)
            at.append(np.repeat(of_chain, d, axis=1).ravel())
            columns.append(np.tile(one.border, (1, c)).ravel())
            values.append((transposed @ one.of_border).ravel())
            where = (size * one.border[:, :, None] + one.border[:, None]).reshape(k * d * d)
            both = np.bincount(where, (by_border @ one.of_border).ravel(), minlength=size * size)
            self._corner += both.reshape(size, size)
            r = one.residuals[..., None]
            self.b[:count] -= np.bincount(of_chain.ravel(), (transposed @ r).ravel(), minlength=count)
            self.b[count:] -= np.bincount(one.border.ravel(), (by_border @ r).ravel(), minlength=size)
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
        width, count = self._band.shape
        size = len(added) - count
        below = [-i for i in range(1, width)]
        lower = sparse.diags([self._band[-i, : count + i] for i in below], below, shape=(count, count))
        chain = lower + lower.T + sparse.diags(self._band[0])
        seen, corner = self._coupling[:size], sparse.csc_matrix(self._corner[:size, :size])
        matrix = (sparse.bmat([[chain, seen.T], [seen, corner]]) + sparse.diags(added)).tocsc()
        try:
            own = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=_SYMMETRIC)
        except RuntimeError as error:  # it is singular
            raise np.linalg.LinAlgError(str(error)) from None
        return own.solve, own.U.diagonal()
