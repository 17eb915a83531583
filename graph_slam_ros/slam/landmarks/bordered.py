"""Normal equations of a chain of poses with a border: landmarks, and parameters of the whole drive.

Odometry connects each pose with the next one only, so the part of the poses is a band. With its Cholesky factor the
border is reduced to a small dense matrix (the Schur complement).
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

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
    log_determinant : of the matrix
    """

    chain: Array
    solved: Array
    coupling: sparse.csr_matrix
    corner: tuple[Array, bool]
    log_determinant: float

    def solve(self, b: Array) -> Array:
        """Solve for a right-hand side."""
        count = self.chain.shape[1]
        chain = cho_solve_banded((self.chain, True), b[:count], check_finite=False)
        border = cho_solve(self.corner, b[count:] - self.coupling @ chain, check_finite=False)
        return np.concatenate([chain - self.solved @ border, border])

    def border_covariance(self) -> Array:
        """The covariance of the border's unknowns."""
        return np.asarray(cho_solve(self.corner, np.eye(len(self.corner[0])), check_finite=False))


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
        band = self._band.copy()
        band[0] += added[:count]
        chain = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)
        solved = cho_solve_banded((chain, True), self._coupling.toarray().T, check_finite=False)
        corner = self._corner + np.diag(added[count:]) - self._coupling @ solved
        reduced = cho_factor(0.5 * (corner + corner.T), lower=True, check_finite=False)
        diagonal = np.concatenate([chain[0], reduced[0].diagonal()])
        return Factor(chain, solved, self._coupling, reduced, 2.0 * float(np.log(diagonal).sum()))
