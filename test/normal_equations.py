"""The normal equations H dx = -b, H = J' Omega J, b = J' Omega r, in compressed columns.

The pattern is found once per structure, by blocks (a block is a pair of vertices that share an edge); each
linearisation then only adds numbers into their places.
"""

import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import SuperLU, splu

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.graph import EdgeTable
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.linearization import Block

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LEAST_PIVOT = 1e-14  # of its diagonal entry: what elimination left of it is rounding
_SHIFT = 1e-13  # well above rounding, and below what edges of very different strength leave (1e-10 in real graphs)
# small panels and no relaxed supernodes: fronts of pose graphs are small
_SYMMETRIC = {"diag_pivot_thresh": 0.0, "relax": 1, "panel_size": 1, "options": {"SymmetricMode": True}}


@kernel
def _accumulate(
    residual: Array,
    jacobian: Array,
    column: Index,
    start: Index,
    stride: Index,
    first_dof: Index,
    data: Array,
    gradient: Array,
) -> None:
    """Add J'J of each edge into the data of the compressed columns, and J'r into the gradient.

    column (k + 1): where each slot's columns begin in the Jacobian; start, stride (n, k, k): where the block
    (row slot, column slot) begins in ``data`` and how far its columns lie apart, start -1 where a vertex is held.
    """
    n, m, _ = jacobian.shape
    slots = len(column) - 1
    for e in range(n):
        for q in range(slots):
            if first_dof[e, q] >= 0:
                for c in range(column[q], column[q + 1]):
                    total = 0.0
                    for k in range(m):
                        total += jacobian[e, k, c] * residual[e, k]
                    gradient[first_dof[e, q] + c - column[q]] += total
            for p in range(slots):
                if start[e, p, q] < 0:
                    continue
                for c in range(column[q], column[q + 1]):
                    place = start[e, p, q] + (c - column[q]) * stride[e, p, q]
                    for r in range(column[p], column[p + 1]):
                        total = 0.0
                        for k in range(m):
                            total += jacobian[e, k, r] * jacobian[e, k, c]
                        data[place] += total
                        place += 1


@kernel
def _fill_indices(
    block_row: Index, block_column: Index, dof: Index, first_dof: Index, indptr: Index, indices: NDArray[np.int32]
) -> tuple[Index, Index]:
    """Row indices of all columns, blocks sorted by column; returns start and stride of each block in the data."""
    count = len(block_row)
    start, stride = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    b = 0
    while b < count:
        column = block_column[b]
        end, height = b, 0
        while end < count and block_column[end] == column:
            height += dof[block_row[end]]
            end += 1
        base, above = indptr[first_dof[column]], 0
        for k in range(b, end):
            row = block_row[k]
            start[k], stride[k] = base + above, height
            for c in range(dof[column]):
                for r in range(dof[row]):
                    indices[base + above + c * height + r] = first_dof[row] + r
            above += dof[row]
        b = end
    return start, stride


class NormalEquations:
    """Pattern of H for a set of vertices and edges, and the numbers last put into it.

    Parameters
    ----------
    free : ids of the vertices to solve for
    rows : the edges, as rows of each table

    Attributes
    ----------
    free : the same ids in order of elimination
    position : of each vertex of the graph in ``free``, or -1
    first_dof : where each free vertex begins in the step and the gradient
    """

    def __init__(self, graph: Graph, free: Index, rows: Mapping[EdgeTable, Index]) -> None:
        self.free = free = _elimination_order(graph, free, rows)
        self.dof = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)[graph.kind.values[free]]
        ends = np.cumsum(self.dof)
        self.size = int(ends[-1]) if len(ends) else 0
        self.first_dof = ends - self.dof
        self.position = position = np.full(graph.vertex_count, -1, dtype=np.int64)
        position[free] = np.arange(len(free))

        pairs, shapes = [], []
        for table, chosen in rows.items():
            at = position[table.vertices.values[chosen]]
            row, column = np.broadcast_arrays(at[:, :, None], at[:, None, :])
            pairs.append(np.where((row >= 0) & (column >= 0), column * len(free) + row, -1).ravel())
            shapes.append(row.shape)
        diagonal = np.arange(len(free)) * (len(free) + 1)
        keys, block = np.unique(np.concatenate([*pairs, diagonal]), return_inverse=True)
        held_blocks = int(len(keys) > 0 and keys[0] < 0)
        block_column, block_row = np.divmod(keys[held_blocks:], max(len(free), 1))

        heights = np.zeros(len(free), dtype=np.int64)
        np.add.at(heights, block_column, self.dof[block_row])
        self._indptr = np.concatenate([[0], np.cumsum(np.repeat(heights, self.dof))])
        self._indices = np.empty(self._indptr[-1], dtype=np.int32)
        start, stride = _fill_indices(block_row, block_column, self.dof, self.first_dof, self._indptr, self._indices)
        start, stride = (np.concatenate([np.full(held_blocks, -1), a]) for a in (start, stride))
        self._places, taken = [], 0
        for (table, chosen), shape in zip(rows.items(), shapes, strict=True):
            mine = block[taken : taken + int(np.prod(shape))].reshape(shape)
            at = position[table.vertices.values[chosen]]
            first = np.append(self.first_dof, -1)[at]
            column = np.concatenate([[0], np.cumsum(table.type.dofs)])
            self._places.append((column, start[mine], stride[mine], first))
            taken += int(np.prod(shape))
        self.data = np.zeros(len(self._indices))
        self.gradient = np.zeros(self.size)

    def assemble(self, blocks: list[Block]) -> None:
        """Put in the numbers of linearised edges, the same tables in the same order as given at construction."""
        self.data[:] = 0.0
        self.gradient[:] = 0.0
        for block, (column, start, stride, first) in zip(blocks, self._places, strict=True):
            _accumulate(block.residual, block.jacobian, column, start, stride, first, self.data, self.gradient)

    def matrix(self, damping: float = 0.0) -> csc_array:
        """H, its diagonal enlarged by the factor 1 + damping (Marquardt)."""
        h = csc_array((self.data, self._indices, self._indptr), shape=(self.size, self.size))
        if damping:
            h = h.copy()
            h.setdiag(h.diagonal() * (1.0 + damping))
        return h

    def factor(self, damping: float = 0.0, *, check: bool = True) -> SuperLU:
        """Sparse LU in the order of elimination, with diagonal pivots.

        Raises SingularError naming a vertex; with ``check``, also where rounding hides that H is singular.
        """
        h = self.matrix(damping)
        diagonal = h.diagonal()
        scale = np.where(diagonal > 0.0, diagonal, 1.0)
        try:
            lu = splu(h, permc_spec="NATURAL", **_SYMMETRIC)
            if not check:
                return lu
            lost = _pivots(lu) <= _LEAST_PIVOT * scale
        except RuntimeError:  # SuperLU: "Factor is exactly singular"
            shifted = (h + _SHIFT * _diagonal(scale)).tocsc()
            pivot = _pivots(splu(shifted, permc_spec="NATURAL", **_SYMMETRIC)) / scale
            lost = pivot <= max(10.0 * _SHIFT, float(pivot.min()))
        if not lost.any():
            return lu
        first = int(np.flatnonzero(lost)[0])  # those after it are spoiled by it
        vertex = int(self.free[np.searchsorted(self.first_dof, first, side="right") - 1])
        raise SingularError(f"the edges do not determine vertex {vertex}")


def _elimination_order(graph: Graph, free: Index, rows: Mapping[EdgeTable, Index]) -> Index:
    """Order by minimum degree, found once on the vertices and not on their degrees of freedom at each step."""
    position = np.full(graph.vertex_count, -1, dtype=np.int64)
    position[free] = np.arange(len(free))
    i, j = [np.arange(len(free))], [np.arange(len(free))]
    for table, chosen in rows.items():
        at = position[table.vertices.values[chosen]]
        for p, q in itertools.permutations(range(at.shape[1]), 2):
            both = (at[:, p] >= 0) & (at[:, q] >= 0)
            i.append(at[both, p])
            j.append(at[both, q])
    if not len(free):
        return free
    row, column = np.concatenate(i), np.concatenate(j)
    pattern = csc_array((np.ones(len(row)), (row, column)), shape=(len(free), len(free)))
    pattern.setdiag(pattern.sum(axis=0) + 1.0)  # any numbers that need no pivoting
    return free[np.argsort(splu(pattern, permc_spec="MMD_AT_PLUS_A", **_SYMMETRIC).perm_c)]


def _pivots(lu: SuperLU) -> Array:
    """Size of the pivot of each column of the factored matrix."""
    pivot = np.empty(lu.shape[0])
    pivot[np.argsort(lu.perm_c)] = np.abs(lu.U.diagonal())
    return pivot


def _diagonal(values: Array) -> coo_array:
    k = np.arange(len(values))
    return coo_array((values, (k, k)), shape=(len(values), len(values)))
