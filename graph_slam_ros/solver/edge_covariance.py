"""Covariances of all edges at once: one sweep from the root of the clique tree to its leaves.

An edge is within a clique. ``covariance.joint`` goes to the root for each edge anew, which takes a thousand times as
long for all edges of a drive.
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
)
from graph_slam_ros.typing import Array, Index


class EdgeCovariances:
    """Joint covariances of vertices that share an edge, and of all vertices with one.

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
        self._depth = _depths(tree.clique[:, PARENT], used)
        self._order: list[int] = used[np.argsort(self._depth[used], kind="stable")].tolist()
        self._columns: dict[int, Array] = {}
        self._fill()

    def _rows(self, c: int) -> tuple[Index, Index]:
        """Return the members of a clique, and the rows of their numbers among all."""
        at, size = self._tree.clique[c, [MEMBERS, SIZE]]
        members = self._tree.members[at : at + size]
        dof = self._dof[members]
        within = np.arange(dof.sum()) - np.repeat(np.cumsum(dof) - dof, dof)
        return members, np.repeat(self._first[members], dof) + within

    def _fill(self) -> None:
        """Compute the covariance of each clique from that of its parent."""
        t, where = self._tree, np.empty(self._total, dtype=np.int64)
        self._factors: dict[int, tuple[Index, Array, Array]] = {}
        full = t.clique[self._order, FULL_DOF]
        self._start, self._full = np.zeros(len(t.clique), dtype=np.int64), np.zeros(len(t.clique), dtype=np.int64)
        self._start[self._order], self._full[self._order] = np.cumsum(full**2) - full**2, full
        self._pool = np.empty(int((full**2).sum()))
        keys, places = [], []
        for c in self._order:
            members, rows = self._rows(c)
            n, wide, base = (int(number) for number in t.clique[c, [FRONT_DOF, FULL_DOF, FRONT]])
            front = t.fronts[base : base + wide * (wide + 1)].reshape(wide, wide + 1)[:n, :wide]
            upper = np.triu(front[:, :n], 1)
            upper[np.diag_indices(n)] = 1.0 / np.diagonal(front)
            inverse: Any = np.linalg.inv(upper)
            gain = -inverse @ front[:, n:]
            covariance = self._of(c)
            covariance[:n, :n] = inverse @ inverse.T
            if wide > n:
                parent = int(t.clique[c, PARENT])
                where[self._factors[parent][0]] = np.arange(self._full[parent])
                above = where[rows[n:]]
                separator = self._of(parent)[above[:, None], above]
                cross = gain @ separator
                covariance[:n, :n] += cross @ gain.T
                covariance[:n, n:], covariance[n:, :n], covariance[n:, n:] = cross, cross.T, separator
            self._factors[c] = rows, inverse, gain
            keys.append(c * len(self._dof) + members)
            places.append(np.cumsum(self._dof[members]) - self._dof[members])
        if keys:
            order = np.argsort(key := np.concatenate(keys))
            self._keys, self._places = key[order], np.concatenate(places)[order]

    def _of(self, c: int) -> Array:
        wide = int(self._full[c])
        return self._pool[self._start[c] : self._start[c] + wide**2].reshape(wide, wide)

    def among(self, ends: Index) -> Array:
        """Return joint covariances (n, D, D) of the vertices (n, k) of edges; zero for held vertices.

        All edges have the same kinds of vertices, and are in the problem.
        """
        dofs = self._tree.vertex[ends[0], DOF].tolist() if len(ends) else []
        if not self._order or not dofs:  # all are held
            return np.zeros((len(ends), sum(dofs), sum(dofs)))
        clique = self._clique[ends]
        depth = np.where(clique == NOTHING, NOTHING, self._depth[clique])
        lowest = clique[np.arange(len(ends)), depth.argmax(axis=1)]
        place = np.searchsorted(self._keys, lowest[:, None] * len(self._dof) + ends)
        place = self._places[np.minimum(place, len(self._places) - 1)]
        at = np.concatenate([place[:, slot, None] + np.arange(dof) for slot, dof in enumerate(dofs)], axis=1)
        held = np.repeat(clique == NOTHING, dofs, axis=1)
        hidden = held[:, :, None] | held[:, None, :]
        flat = self._start[lowest][:, None, None] + at[:, :, None] * self._full[lowest][:, None, None] + at[:, None, :]
        out: Array = np.where(hidden, 0.0, self._pool[np.where(hidden, 0, flat)])
        return out

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
