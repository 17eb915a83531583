"""The tests' independent reference: dense or sparse normal equations of all edges, made anew for every step.

Nothing of the package's solver is used, only what edges and vertices are: ``EdgeType.linearize`` and
``VertexKind.retract``. Losses are applied by their formulas in the literature.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from graph_slam_ros.graph import CAUCHY, HUBER, Loss

_SYMMETRIC = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


def _slope(loss, s):
    """``rho'(s)`` of Huber 1964 and Cauchy."""
    if loss.kind == HUBER:
        return np.minimum(1.0, loss.scale / np.sqrt(np.maximum(s, 1e-300)))
    if loss.kind == CAUCHY:
        return 1.0 / (1.0 + s / loss.scale**2)
    return np.ones_like(s)


class Reference:
    """Some vertices and edges of a graph; those of a weight of zero do not count, held vertices are known."""

    def __init__(self, graph, vertices, edges, held=(), losses=None):
        self.graph, self.losses = graph, losses or {}
        self.free = np.setdiff1d(np.asarray(list(vertices), dtype=np.int64), list(held))
        dof = np.array([k.dof for k in graph.kinds], dtype=np.int64)[graph.kind.values]
        self.first = np.full(graph.vertex_count, -1, dtype=np.int64)
        self.first[self.free] = np.cumsum(dof[self.free]) - dof[self.free]
        self.size = int(dof[self.free].sum())
        chosen = np.zeros(graph.edge_count, dtype=bool)
        chosen[list(edges)] = True
        self.parts = []
        for table in graph.tables.values():
            rows = np.flatnonzero(chosen[table.ids] & (table.weight.values != 0.0))
            if not len(rows):
                continue
            at = table.vertices[rows]
            slots = np.concatenate([np.full(d, s) for s, d in enumerate(table.type.dofs)])
            within = np.concatenate([np.arange(d) for d in table.type.dofs])
            columns = np.where(self.first[at] >= 0, self.first[at], -self.size - 9)[:, slots] + within
            self.parts.append((table, rows, at, columns))

    def linearized(self, x):
        """Whitened residuals (n, m), Jacobians (n, m, D) and their columns (n, D; negative: held), by edge type."""
        for table, rows, at, columns in self.parts:
            r, j = table.type.linearize(x, self.graph.begins(at), table.measured.values[rows])
            root = table.sqrt_information.values[rows] * np.sqrt(table.weight.values[rows])[:, None, None]
            r, j = (root @ r[:, :, None])[:, :, 0], root @ j
            label = table.label.values[rows]
            for code in np.unique(label):
                loss = self.losses.get(self.graph.labels[code], Loss())
                mine = label == code
                factor = np.sqrt(_slope(loss, (r[mine] ** 2).sum(axis=1)))
                r[mine], j[mine] = r[mine] * factor[:, None], j[mine] * factor[:, None, None]
            yield r, j, columns

    def chi2(self, x):
        """Sum of the squared whitened residuals."""
        return sum(float((r**2).sum()) for r, _, _ in self.linearized(x))

    def system(self, x):
        """H, sparse, and the gradient."""
        data, row, column, gradient = [], [], [], np.zeros(self.size)
        for r, j, columns in self.linearized(x):
            known = columns < 0
            j = np.where(known[:, None, :], 0.0, j)
            to = np.where(known, 0, columns)
            transposed = np.swapaxes(j, 1, 2)
            np.add.at(gradient, to, (transposed @ r[:, :, None])[:, :, 0])
            h = transposed @ j
            p, q = np.broadcast_arrays(to[:, :, None], to[:, None, :])
            data.append(h.ravel())
            row.append(p.ravel())
            column.append(q.ravel())
        entries = [np.concatenate(a) if a else np.empty(0) for a in (data, row, column)]
        h = coo_array((entries[0], (entries[1].astype(int), entries[2].astype(int))), shape=(self.size, self.size))
        return h.tocsc(), gradient

    def dense(self, x):
        """H as a dense matrix, free vertices in order of id."""
        return self.system(x)[0].toarray()

    def covariance(self, x, vertex):
        """Block of the inverse of the dense H; zero for a held vertex."""
        dof, first = self.graph.kind_of(vertex).dof, self.first[vertex]
        if first < 0:
            return np.zeros((dof, dof))
        return np.linalg.inv(self.dense(x))[first : first + dof, first : first + dof]

    def moved(self, x, step):
        """All vertices after a step."""
        out = x.copy()
        graph = self.graph
        for code, kind in enumerate(graph.kinds):
            ids = self.free[graph.kind.values[self.free] == code]
            if len(ids):
                slots = graph.begins(ids)[:, None] + np.arange(kind.size)
                out[slots] = kind.retract(x[slots], step[self.first[ids][:, None] + np.arange(kind.dof)])
        return out

    def optimum(self, start, *, least=1e-10, most=100):
        """Gauss-Newton until no component of a step is larger than ``least``, or until rounding stops it."""
        x, previous = np.array(start, dtype=float), np.inf
        for _ in range(most if self.size else 0):
            h, gradient = self.system(x)
            step = splu(h, **_SYMMETRIC).solve(-gradient)
            x = self.moved(x, step)
            largest = np.abs(step).max()
            if largest <= least or (largest < 1e-8 and largest >= previous):
                return x
            previous = largest
        assert not self.size, f"the reference does not converge: steps of {largest:.1e}"
        return x

    def apart(self, x, y):
        """Largest difference of the free vertices in their tangent spaces [m or rad]."""
        graph, largest = self.graph, 0.0
        for code, kind in enumerate(graph.kinds):
            ids = self.free[graph.kind.values[self.free] == code]
            if len(ids):
                slots = graph.begins(ids)[:, None] + np.arange(kind.size)
                largest = max(largest, float(np.abs(kind.local(x[slots], y[slots])).max()))
        return largest


def all_values(solver):
    """The estimate of every vertex of the solver's graph, end to end as ``Graph.initial``."""
    graph = solver.graph
    out = graph.initial.values.copy()
    for code, kind in enumerate(graph.kinds):
        ids = np.flatnonzero(graph.kind.values == code)
        out[graph.begins(ids)[:, None] + np.arange(kind.size)] = solver.estimate(ids)
    return out
