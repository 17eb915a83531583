"""Normal equations of a chain of poses with a border: landmarks, and parameters of the whole drive.

Odometry connects each pose with the next one only, so the part of the poses is a band. The border is solved for after
it (Schur complement).
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_solve, cho_solve_banded, cholesky_banded

from graph_slam_ros.typing import Array, Index


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
    chain, border : Cholesky factors of the chain, as a lower band, and of what it leaves of the border
    coupling, solved : rows of the border by unknowns of the chain; their transpose, solved for
    """

    chain: Array
    border: Array
    coupling: sparse.csr_matrix
    solved: Array

    @property
    def log_determinant(self) -> float:
        """That of the matrix."""
        return 2.0 * float(np.log(self.chain[0]).sum() + np.log(self.border.diagonal()).sum())

    def solve(self, b: Array) -> Array:
        """Solve for a right-hand side (n,)."""
        count = len(self.solved)
        chain = cho_solve_banded((self.chain, True), b[:count], check_finite=False)
        border = cho_solve((self.border, True), b[count:] - self.coupling @ chain)
        return np.concatenate([chain - self.solved @ border, border])

    def border_covariance(self, some: Index) -> Array:
        """The covariance of some unknowns of the border."""
        return np.asarray(cho_solve((self.border, True), np.eye(len(self.border))[:, some])[some])


class BorderedEquations:
    """The sum of ``J' J`` over all rows, and ``-J' r``.

    Parameters
    ----------
    count, size : unknowns of the chain and of the border
    width : of the chain's longest row: so many unknowns that follow one another

    Attributes
    ----------
    b : (count + size,) right-hand side
    """

    def __init__(self, rows: list[Rows], count: int, size: int, width: int) -> None:
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
        count, band = self._band.shape[1], self._band.copy()
        band[0] += added[:count]
        chain = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        solved = cho_solve_banded((chain, True), self._coupling.T.toarray(), check_finite=False)
        left = self._corner + np.diag(added[count:]) - self._coupling @ solved
        return Factor(chain, np.linalg.cholesky(left), self._coupling, solved)
