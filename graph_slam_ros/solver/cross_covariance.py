"""Covariances of one vertex with all others: one sweep from the root of the clique tree to its leaves.

``covariance.joint`` goes to the root for each of the others anew, which takes a thousand times as long for a drive.
"""

from typing import Any

import numpy as np

from graph_slam_ros.solver.clique_tree.storage import (
    CLIQUE,
    DOF,
    FRONT,
    FRONT_DOF,
    FULL_DOF,
    MEMBERS,
    NOTHING,
    PARENT,
    SIZE,
    Tree,
    row_of,
)
from graph_slam_ros.typing import Array, Index


class CrossCovariances:
    """Covariances of all vertices with one of them.

    Parameters
    ----------
    tree : solved
    vertices : its unknowns; all others are held, and have covariance zero
    """

    def __init__(self, tree: Tree, vertices: Index) -> None:
        self._tree, count = tree, len(tree.vertex)
        self._clique = np.full(count, NOTHING)
        self._clique[vertices] = tree.vertex[vertices, CLIQUE]
        dof = np.zeros(count, dtype=np.int64)
        dof[vertices] = tree.vertex[vertices, DOF]
        self._first = np.cumsum(dof) - dof
        self._dof, self._total = dof, int(dof.sum())
        used = np.unique(self._clique[vertices])
        depth = _depths(tree.clique[:, PARENT], used)
        self._order: list[int] = used[np.argsort(depth[used], kind="stable")].tolist()
        self._factors = {c: self._factor(c) for c in self._order}
        self._columns: dict[int, Array] = {}

    def _rows(self, c: int) -> Index:
        """Return the rows of the numbers of a clique's members among all."""
        at, size = self._tree.clique[c, [MEMBERS, SIZE]]
        members = self._tree.members[at : at + size]
        dof = self._dof[members]
        within = np.arange(dof.sum()) - np.repeat(np.cumsum(dof) - dof, dof)
        return np.repeat(self._first[members], dof) + within

    def _factor(self, c: int) -> tuple[Index, Array, Array]:
        """The rows of a clique, the inverse of its triangle, and the gain by which it follows its separator."""
        t = self._tree
        n, wide, base = (int(number) for number in t.clique[c, [FRONT_DOF, FULL_DOF, FRONT]])
        front = np.zeros((n, wide))
        for row in range(n):
            at = base + row_of(row, wide)
            front[row, row:] = t.fronts[at + row : at + wide]
        upper = np.triu(front[:, :n], 1)
        upper[np.diag_indices(n)] = 1.0 / np.diagonal(front)
        inverse: Any = np.linalg.inv(upper)
        return self._rows(c), inverse, -inverse @ front[:, n:]

    def with_vertex(self, vertex: int, ends: Index) -> Array:
        """Covariances (n, d, D) of one vertex with the vertices (n, k) of edges; zero for held ones."""
        dofs = self._tree.vertex[ends[0], DOF].tolist() if len(ends) else []
        if vertex not in self._columns:
            self._columns[vertex] = self._column(vertex)
        column = self._columns[vertex]
        slots = []
        for slot, dof in enumerate(dofs):
            is_free = self._clique[ends[:, slot]] != NOTHING
            at = np.where(is_free[:, None], self._first[ends[:, slot]][:, None] + np.arange(dof), self._total)
            slots.append(column[at])
        return np.concatenate(slots, axis=1).transpose(0, 2, 1) if slots else np.zeros((0, column.shape[1], 0))

    def _column(self, vertex: int) -> Array:
        """The columns (total + 1, d) of the covariance of all that belong to a vertex; the last row is zero."""
        d = int(self._tree.vertex[vertex, DOF])
        out = np.zeros((self._total + 1, d))
        if self._clique[vertex] == NOTHING:
            return out
        out[self._first[vertex] : self._first[vertex] + d] = np.eye(d)
        c = int(self._clique[vertex])
        while c != NOTHING:
            rows, inverse, gain = self._factors[c]
            n = len(inverse)
            right = out[rows[:n]].copy()
            out[rows[:n]] = inverse.T @ right
            out[rows[n:]] += gain.T @ right
            c = int(self._tree.clique[c, PARENT])
        for c in self._order:
            rows, inverse, gain = self._factors[c]
            n = len(inverse)
            out[rows[:n]] = inverse @ out[rows[:n]] + gain @ out[rows[n:]]
        return out


def _depths(parent: Index, used: Index) -> Index:
    """The depth of each clique in use; 0 for a root."""
    out, at = np.zeros(len(parent), dtype=np.int64), parent[used]
    while (at != NOTHING).any():
        out[used] += at != NOTHING
        at = np.where(at == NOTHING, NOTHING, parent[np.maximum(at, 0)])
    return out
