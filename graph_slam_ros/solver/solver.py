"""The seam between the problem and its solution: add, set_weight, hold, update, estimate, marginal."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.graph import EdgeTable
from graph_slam_ros.solver.descent import Problem, Settings, minimise
from graph_slam_ros.solver.linearization import by_class, total
from graph_slam_ros.solver.normal import NormalEquations, check_gauge
from graph_slam_ros.solver.report import Report

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Solver:
    """Batch maximum-likelihood estimate of the vertices it was given; it owns their estimates.

    Vertices and edges are records of a ``Graph``; the solver minimises over those that were added to it.
    """

    def __init__(self, graph: Graph, settings: Settings | None = None) -> None:
        self.graph = graph
        self.settings = settings or Settings()
        self._x = np.empty(0)
        self._inside = np.zeros(0, dtype=bool)
        self._held = np.zeros(0, dtype=bool)
        self._edges = np.zeros(0, dtype=bool)
        self._problem: Problem | None = None
        self._solved_with: Settings | None = None

    def add(self, vertices: ArrayLike, edges: ArrayLike) -> None:
        """Take vertices (at their initial values) and edges of the graph into the problem, by id, each once."""
        self._grow()
        new = _fresh(vertices, self._inside, "vertex")
        new_edges = _fresh(edges, self._edges, "edge")
        tables, rows = self.graph.table_of_edge.values[new_edges], self.graph.row_of_edge.values[new_edges]
        for code, table in enumerate(self.graph.tables.values()):
            ends = table.vertices.values[rows[tables == code]].ravel()
            outside = ends[~(self._inside[ends] | np.isin(ends, new))]
            if len(outside):
                raise GraphSlamError(f"an edge needs vertex {int(outside[0])}, which was not added")
        self._inside[new] = True
        self._edges[new_edges] = True
        self._structure_changed()

    def start_at(self, values: Array) -> None:
        """Begin from other values than the graph's initial ones: the stored numbers of all vertices, end to end."""
        self._grow()
        if values.shape != self._x.shape or not np.isfinite(values).all():
            raise GraphSlamError(f"start: expected {len(self._x)} finite numbers, got an array {values.shape}")
        self._x = values.copy()
        self._solved_with = None

    def set_weight(self, edge: int, weight: float) -> None:
        """Multiply the information of an edge; 0 takes it out of the structure, another value puts it back."""
        if not (np.isfinite(weight) and weight >= 0.0):
            raise GraphSlamError(f"edge {edge}: weight {weight} is not a finite number >= 0")
        self._grow()
        _known([edge], len(self._edges), "edge")
        table, row = self.graph.row(edge)
        was = table.weight.values[row]
        table.weight.values[row] = weight
        self._solved_with = None
        if (was == 0.0) != (weight == 0.0):
            self._structure_changed()

    def hold(self, vertex: int) -> None:
        """Keep a vertex at its present estimate."""
        self._grow()
        _known([vertex], len(self._inside), "vertex")
        self._held[vertex] = True
        self._structure_changed()

    def update(self, settings: Settings | None = None) -> Report:
        """Minimise the cost from the present estimate; nothing is left to do where that has converged before.

        Raises
        ------
        GaugeError, SingularError
            The estimate is left as it was.
        """
        settings = settings or self.settings
        self._grow()
        problem = self._structure()
        if self._solved_with == settings or not len(problem.normal.free):
            blocks = problem.linearize(self._x, settings.stages()[-1])
            chi2, cost = total(blocks)
            return Report("gn", "nothing_to_do", chi2, chi2, cost, cost, (), by_class(self.graph, blocks))
        self._check_gauge()
        self._x, report = minimise(problem, self._x, settings)
        self._solved_with = settings if report.converged else None
        return report

    def estimate(self, ids: ArrayLike) -> Array:
        """Values of vertices of one kind, (n, size)."""
        self._grow()
        at = _known(ids, len(self._inside), "vertex")
        if not len(at):
            return np.empty((0, 0))
        codes = self.graph.kind.values[at]
        if (codes != codes[0]).any():
            raise GraphSlamError("estimate: the vertices are not of one kind")
        size = self.graph.kinds[codes[0]].size
        return self._x[self.graph.offset.values[at][:, None] + np.arange(size)]

    def marginal(self, ids: ArrayLike) -> list[Array]:
        """Covariance (dof, dof) of each vertex in its tangent space; zero for a held one.

        Linearised at the present estimate with the last stage's losses.

        Raises
        ------
        GaugeError, SingularError
            A covariance that does not exist is refused.
        """
        self._grow()
        wanted = _known(ids, len(self._inside), "vertex")
        if not self._inside[wanted].all():
            raise GraphSlamError(f"vertex {int(wanted[~self._inside[wanted]][0])} is not in the problem")
        free = not self._held[wanted].all()
        if free:
            self._check_gauge()
            normal = self._linearized()
            lu = normal.factor()
        out = []
        for vertex in wanted.tolist():
            dof = self.graph.kind_of(vertex).dof
            if self._held[vertex]:
                out.append(np.zeros((dof, dof)))
                continue
            k = int(normal.position[vertex])
            first = int(normal.first_dof[k])
            unit = np.zeros((normal.size, dof))
            unit[first + np.arange(dof), np.arange(dof)] = 1.0
            block = lu.solve(unit)[first : first + dof]
            out.append(0.5 * (block + block.T))
        return out

    def information_matrix(self) -> Array:
        """H as a dense matrix at the present estimate, vertices in order of id: for tests and small examples."""
        normal = self._linearized()
        by_id = [
            int(normal.first_dof[k]) + d for k in np.argsort(normal.free).tolist() for d in range(int(normal.dof[k]))
        ]
        dense: Array = normal.matrix().toarray()[np.ix_(by_id, by_id)]
        return dense

    def _grow(self) -> None:
        """Follow the graph's growth: new vertices start at their initial values."""
        known = len(self._inside)
        more = self.graph.vertex_count - known
        if more:
            start = len(self._x)
            self._x = np.concatenate([self._x, self.graph.initial.values[start:]])
            self._inside = np.concatenate([self._inside, np.zeros(more, dtype=bool)])
            self._held = np.concatenate([self._held, np.zeros(more, dtype=bool)])
        more = self.graph.edge_count - len(self._edges)
        if more:
            self._edges = np.concatenate([self._edges, np.zeros(more, dtype=bool)])

    def _structure_changed(self) -> None:
        self._problem = None
        self._solved_with = None

    def _structure(self) -> Problem:
        if self._problem is None:
            rows: dict[EdgeTable, Index] = {}
            for table in self.graph.tables.values():
                mine = self._edges[table.id.values] & (table.weight.values != 0.0)
                if mine.any():
                    rows[table] = np.flatnonzero(mine)
            normal = NormalEquations(self.graph, np.flatnonzero(self._inside & ~self._held), rows)
            self._problem = Problem(self.graph, rows, normal)
        return self._problem

    def _check_gauge(self) -> None:
        problem = self._structure()
        check_gauge(self.graph, problem.normal.free, np.flatnonzero(self._inside & self._held), problem.rows)

    def _linearized(self) -> NormalEquations:
        self._grow()
        problem = self._structure()
        problem.normal.assemble(problem.linearize(self._x, self.settings.stages()[-1]))
        return problem.normal


def _known(ids: ArrayLike, count: int, what: str) -> Index:
    at = np.asarray(ids, dtype=np.int64).ravel()
    strange = (at < 0) | (at >= count)
    if strange.any():
        raise GraphSlamError(f"{what} {int(at[strange][0])} does not exist")
    return at


def _fresh(ids: ArrayLike, taken: NDArray[np.bool_], what: str) -> Index:
    """Ids that are there and not yet taken, each once."""
    at = _known(ids, len(taken), what)
    ordered = np.sort(at)
    again = np.concatenate([at[taken[at]], ordered[1:][ordered[1:] == ordered[:-1]]])
    if len(again):
        raise GraphSlamError(f"{what} {int(again[0])} was added before")
    return at
