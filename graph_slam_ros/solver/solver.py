"""The seam between the problem and its solution: what it is made of, its estimate, its covariances."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.graph import SE2, SE3, Graph
from graph_slam_ros.graph.graph import EdgeTable
from graph_slam_ros.solver import incremental
from graph_slam_ros.solver.covariance import joint, marginals
from graph_slam_ros.solver.descent import Problem, Settings, minimise
from graph_slam_ros.solver.gauge import check_gauge
from graph_slam_ros.solver.linearization import Losses, costs, linearize, refuse_nonfinite, rows_of, store
from graph_slam_ros.solver.numeric import settle
from graph_slam_ros.solver.report import Change, Report
from graph_slam_ros.solver.symbolic import compact
from graph_slam_ros.solver.tree import (
    ACTIVE,
    AFFECTED,
    BLOCKS_TOP,
    DOF,
    FREE,
    KEY,
    LINKS,
    NOTHING,
    SE2_KIND,
    SE3_KIND,
    TAIL_END,
    TAIL_FIRST,
    TAIL_LEAST,
    VECTOR,
    empty_tree,
    longer,
    with_room,
)

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_BY_FAR = 10.0  # times the threshold: steps that are linearised anew at once
_NONE = np.empty(0, dtype=np.int64)
_KINDS = {SE2: SE2_KIND, SE3: SE3_KIND}


class Solver:
    """Maximum-likelihood estimate of the vertices it was given, online and in batch; it owns their estimates.

    Vertices and edges are records of a ``Graph``; the solver minimises over those that were added to it. ``update``
    costs what has changed, ``optimize`` what there is; both work on one clique tree.
    """

    def __init__(self, graph: Graph, settings: Settings | None = None) -> None:
        self.graph = graph
        self.settings = settings or Settings()
        self._tree = empty_tree()
        self._vertices = 0  # of the graph, that have a record in the tree
        self._inside = np.zeros(0, dtype=bool)  # vertices of the problem
        self._held = np.zeros(0, dtype=bool)
        self._taken = np.zeros(0, dtype=bool)  # edges of the problem
        self._new_vertices, self._new_edges = _NONE, _NONE  # since the last update
        self._touched = _NONE  # vertices that lost an edge or a neighbour since
        self._young = _NONE  # edges that have had but one update, with the first stage of their loss
        self._broken = False  # the tree must be made anew
        self._settled = True  # its numbers are those at its linearisation points
        self._loose = False  # something that held parts together may be gone
        self._moved_since: list[Index] = []  # large steps were last looked for
        self._updates_since = 0
        self._stages: list[Losses] = []
        self._losses_for = NOTHING, self.settings  # so many labels, and their settings
        self._solved_with: Settings | None = None

    # -- what the problem is -----------------------------------------------------------------------------------------

    def add(self, vertices: ArrayLike, edges: ArrayLike) -> None:
        """Take vertices (at their initial values) and edges of the graph into the problem, by id, each once."""
        self._grow()
        new, new_edges = np.asarray(vertices, dtype=np.int64).ravel(), np.asarray(edges, dtype=np.int64).ravel()
        _admit(new, self._inside, self._vertices, "vertex")
        try:
            _admit(new_edges, self._taken, self.graph.edge_count, "edge")
        except GraphSlamError:
            self._inside[new] = False
            raise
        rows = rows_of(self.graph, new_edges)
        for table, chosen in rows.items():
            missing = incremental.outside(chosen, table.vertices.values, self._inside)
            if missing != NOTHING:
                self._inside[new], self._taken[new_edges] = False, False
                raise GraphSlamError(f"an edge needs vertex {missing}, which was not added")
        for table, chosen in rows.items():
            self._record(table, chosen)
        self._broken |= bool((self._tree.vertex[new, KEY] != NOTHING).any())  # removed before: it is in the order still
        self._new_vertices = np.concatenate((self._new_vertices, new)) if len(self._new_vertices) else new
        self._new_edges = np.concatenate((self._new_edges, new_edges)) if len(self._new_edges) else new_edges

    def start_at(self, values: Array) -> None:
        """Begin from other values than the graph's initial ones: the stored numbers of all vertices, end to end."""
        self._grow()
        size = len(self.graph.initial)
        if values.shape != (size,) or not np.isfinite(values).all():
            raise GraphSlamError(f"start: expected {size} finite numbers, got an array {values.shape}")
        self._set_estimate(values)
        self._broken = True

    def place(self, vertex: int, value: ArrayLike) -> None:
        """Begin with another value than the graph's initial one for a vertex that is not in the problem yet."""
        self._grow()
        _known([vertex], self._vertices, "vertex")
        if self._inside[vertex]:
            raise GraphSlamError(f"vertex {vertex} is in the problem: it has an estimate")
        numbers, at = np.asarray(value, dtype=float), int(self.graph.offset.values[vertex])
        size = self.graph.kind_of(vertex).size
        if numbers.shape != (size,) or not np.isfinite(numbers).all():
            raise GraphSlamError(f"vertex {vertex}: expected {size} finite numbers, got {numbers.tolist()}")
        self._tree.value[at : at + size] = self._tree.estimate[at : at + size] = numbers

    def set_weight(self, edge: int, weight: float) -> None:
        """Multiply the information of an edge; 0 takes it out of the structure, another value puts it back."""
        if not (np.isfinite(weight) and weight >= 0.0):
            raise GraphSlamError(f"edge {edge}: weight {weight} is not a finite number >= 0")
        self._grow()
        one = _known([edge], self.graph.edge_count, "edge")
        table, row = self.graph.row(edge)
        ends = table.vertices.values[row]
        if weight and self._taken[edge] and not self._inside[ends].all():
            raise GraphSlamError(f"edge {edge} needs vertex {int(ends[~self._inside[ends]][0])}, which was removed")
        table.weight.values[row] = weight
        if not self._taken[edge]:
            return
        if weight:
            self._new_edges = np.union1d(self._new_edges, one)
        elif self._tree.edge[edge, ACTIVE]:
            incremental.deactivate(self._tree, one)
            self._touched = np.concatenate((self._touched, ends))
            self._loose = True

    def hold(self, vertex: int) -> None:
        """Keep a vertex at its present estimate."""
        self._grow()
        one = _known([vertex], self._vertices, "vertex")
        self._held[vertex] = True
        if self._tree.vertex[vertex, FREE]:
            settle(self._tree, one)
            for table, rows in self._active_rows().items():  # they are linearised where it is held
                on_it = (table.vertices.values[rows] == vertex).any(axis=1)
                self._new_edges = np.union1d(self._new_edges, table.id.values[rows[on_it]])
        self._take_out(one)

    def remove(self, vertex: int) -> None:
        """Take a vertex out of the problem again; all its edges must be out (weight 0) before."""
        self._grow()
        one = _known([vertex], self._vertices, "vertex")
        if not self._inside[vertex]:
            raise GraphSlamError(f"vertex {vertex} is not in the problem")
        for table in self.graph.tables.values():
            there = (table.weight.values != 0.0) & self._taken[table.id.values]
            there &= (table.vertices.values == vertex).any(axis=1)
            if there.any():
                raise GraphSlamError(f"vertex {vertex} is needed by edge {int(table.id.values[there][0])}")
        self._inside[vertex] = False
        self._new_vertices = self._new_vertices[self._new_vertices != vertex]
        self._take_out(one)

    # -- its solution ------------------------------------------------------------------------------------------------

    def update(self) -> Change:
        """Take in what was added and changed, and bring the estimate to the optimum of all of it.

        It costs what the change costs. Vertices whose step has become large are linearised anew (``Settings``).

        Raises
        ------
        GaugeError, SingularError
            The estimate stays; what was added since the last update is not in it, and waits for the next. Where all
            was taken in, and only linearising anew shows a vertex to be undetermined, the estimate is that of before
            this.
        """
        settings, eliminated = self.settings, int(self._tree.state[AFFECTED])
        moved, linearized = self._take_in()
        count = len(moved)
        self._moved_since.append(moved)
        self._updates_since += 1
        due = self._updates_since * (3 if count > TAIL_LEAST else 2) >= 2 * settings.relinearize_every
        if due:
            moved = np.unique(np.concatenate(self._moved_since))
            self._moved_since, self._updates_since = [], 0
        for _ in range(settings.relinearize_passes):
            far = 1.0 if due else _BY_FAR
            edges = incremental.relinearize(
                self._tree, moved, far * settings.relinearize_above, far**2 * settings.relinearize_error
            )
            if not len(edges):
                break
            self._linearize(edges)
            failed, moved = incremental.renumber(self._tree, edges, settings.tolerance, settings.tolerance_sigmas)
            if failed != NOTHING:
                self._broken = True
                raise _singular(failed)
            self._moved_since.append(moved)
            linearized += len(edges)
            count += len(moved)
            due = True
        return Change(int(self._tree.state[AFFECTED]) - eliminated, linearized, count)

    def optimize(self, settings: Settings | None = None) -> Report:
        """Minimise the cost over everything, from the present estimate, until converged.

        Raises
        ------
        GaugeError, SingularError
            As for ``update``.
        """
        settings = settings or self.settings
        self._grow()
        if self._solved_with == settings and not self._waiting():
            return self.evaluate(settings)
        before = self._tree.estimate[: len(self.graph.initial)].copy()
        vertices, edges, _ = self._activate()
        try:
            if not len(self._unknowns()):
                return self.evaluate(settings)
            self._refuse_loose()
            self._restructure(vertices, edges)
            report = minimise(Problem(self.graph, self._tree, self._active_rows(), self._unknowns()), settings)
        except GraphSlamError:
            self._set_estimate(before)
            self._put_off(vertices, edges)
            raise
        self._settled, self._young = False, _NONE
        self._solved_with = settings if report.converged else None
        return report

    def evaluate(self, settings: Settings | None = None) -> Report:
        """Chi2 and cost of the present estimate, with the last stage of the losses."""
        self._grow()
        losses = Losses(self.graph, (settings or self.settings).stages()[-1])
        now = costs(self.graph, linearize(self.graph, self._tree.estimate, self._active_rows(), losses))
        return Report("gn", "nothing_to_do", now.chi2, now.chi2, now.cost, now.cost, (), now.classes)

    def estimate(self, ids: ArrayLike) -> Array:
        """Values of vertices of one kind, (n, size)."""
        self._grow()
        at = np.asarray(ids, dtype=np.int64).ravel()
        if not len(at):
            return np.empty((0, 0))
        graph = self.graph
        size = graph.kind_of(_known(at[:1], self._vertices, "vertex")[0]).size
        unfit, out = incremental.gather(self._tree.estimate, graph.kind.values, graph.offset.values, at, size)
        if unfit != NOTHING:
            _known(at, self._vertices, "vertex")
            raise GraphSlamError("estimate: the vertices are not of one kind")
        return out

    def marginal(self, ids: ArrayLike) -> list[Array]:
        """Covariance (dof, dof) of each vertex in its tangent space; zero for a held one.

        What waits for an update is taken in first.

        Raises
        ------
        GaugeError, SingularError
            A covariance that does not exist is refused.
        """
        wanted = self._certain(ids)
        free = wanted[~self._held[wanted]]
        numbers = marginals(self._tree, free) if len(free) else np.empty(0)
        out, at = [], 0
        for vertex in wanted.tolist():
            dof = self.graph.kind_of(vertex).dof
            if self._held[vertex]:
                out.append(np.zeros((dof, dof)))
            else:
                out.append(numbers[at : at + dof**2].reshape(dof, dof))
                at += dof**2
        return out

    def joint_marginal(self, ids: ArrayLike) -> Array:
        """Covariance (D, D) of some vertices together, in the order given, each once; as ``marginal`` for each."""
        wanted = self._certain(ids)
        if len(np.unique(wanted)) < len(wanted):
            raise GraphSlamError("a joint covariance of a vertex with itself")
        dof = self._tree.vertex[wanted, DOF]
        free = ~self._held[wanted]
        out = np.zeros((int(dof.sum()), int(dof.sum())))
        if free.any():
            at = np.flatnonzero(np.repeat(free, dof))
            out[np.ix_(at, at)] = joint(self._tree, wanted[free])
        return out

    def information_matrix(self) -> Array:
        """H as a dense matrix at the present estimate, vertices in order of id: for tests and small examples."""
        self._grow()
        free = np.flatnonzero(self._inside & ~self._held)
        dof = np.array([self.graph.kind_of(v).dof for v in free.tolist()], dtype=np.int64)
        first = dict(zip(free.tolist(), (np.cumsum(dof) - dof).tolist(), strict=True))
        out = np.zeros((int(dof.sum()), int(dof.sum())))
        rows = rows_of(self.graph, np.union1d(self._active(), self._new_edges))
        for b in linearize(self.graph, self._tree.estimate, rows, self._losses()[-1]):
            slots = np.repeat(np.arange(len(b.table.type.dofs)), b.table.type.dofs)
            within = np.concatenate([np.arange(d) for d in b.table.type.dofs])
            for jacobian, ends in zip(b.jacobian, b.table.vertices.values[b.rows], strict=True):
                mine = np.isin(ends[slots], free)
                at = [first[v] + d for v, d in zip(ends[slots][mine].tolist(), within[mine].tolist(), strict=True)]
                out[np.ix_(at, at)] += jacobian[:, mine].T @ jacobian[:, mine]
        return out

    def compact(self) -> None:
        """Keep no more memory between what is in use than must be; done by itself before memory is asked for."""
        compact(self._tree)

    # -- inside ------------------------------------------------------------------------------------------------------

    def _grow(self) -> None:
        """Follow the graph's growth: new vertices start at their initial values."""
        graph, known = self.graph, self._vertices
        if graph.vertex_count > known:
            count, size = graph.vertex_count, len(graph.initial)
            self._tree = with_room(self._tree, vertex=count, region=2 * count, tail=2 * count)
            self._tree = with_room(self._tree, diagonal=size, step=size, value=size, estimate=size)
            self._inside, self._held = longer(self._inside, count), longer(self._held, count)
            shapes = np.array([(k.dof, k.size, _KINDS.get(k, VECTOR)) for k in graph.kinds])
            incremental.append_vertices(
                self._tree, known, graph.offset.values[known:], graph.initial.values, shapes[graph.kind.values[known:]]
            )
            self._vertices = graph.vertex_count
        if graph.edge_count > len(self._taken):
            self._tree = with_room(self._tree, edge=graph.edge_count)
            self._taken = longer(self._taken, graph.edge_count)

    def _record(self, table: EdgeTable, rows: Index) -> None:
        """Link edges to their vertices; they are not in the structure yet."""
        state, width = self._tree.state, sum(table.type.dofs)
        links = int(state[LINKS]) + len(rows) * len(table.type.accepts)
        blocks = int(state[BLOCKS_TOP]) + len(rows) * width * (width + 1)
        self._tree = with_room(self._tree, link=links, blocks=blocks)
        incremental.append_edges(self._tree, rows, table.id.values, table.vertices.values)

    def _certain(self, ids: ArrayLike) -> Index:
        """Vertices whose covariance can be told: what waits for an update is taken in."""
        self._grow()
        wanted = _known(ids, self._vertices, "vertex")
        if not self._inside[wanted].all():
            raise GraphSlamError(f"vertex {int(wanted[~self._inside[wanted]][0])} is not in the problem")
        if not self._held[wanted].all() and (self._waiting() or not self._settled):
            self._moved_since.append(self._take_in()[0])
        return wanted

    def _waiting(self) -> bool:
        return bool(len(self._new_vertices) or len(self._new_edges) or len(self._touched) or self._broken)

    def _unknowns(self) -> Index:
        return np.flatnonzero(self._tree.vertex[: self._vertices, FREE])

    def _active(self) -> Index:
        return np.flatnonzero(self._tree.edge[:, ACTIVE])

    def _active_rows(self) -> dict[EdgeTable, Index]:
        return rows_of(self.graph, self._active())

    def _take_in(self) -> tuple[Index, int]:
        """Put what waits into the tree and solve; the vertices that moved, and how many edges were linearised."""
        self._grow()
        if not self._settled:
            self._settle()
        if not self._waiting() and not len(self._young):
            return _NONE, 0
        grown_up = self._young
        vertices, edges, anchored = self._activate()
        self._young = edges if len(self._losses()) > 1 else _NONE
        try:
            if self._loose or self._broken or not anchored:
                self._refuse_loose()
            fresh = np.union1d(edges, grown_up) if len(grown_up) else edges
            if self._broken:
                fresh = self._active()
            self._linearize(fresh)
            cliques = self._restructure(vertices, fresh)
            settings = self.settings
            failed, moved = incremental.solve(self._tree, cliques, settings.tolerance, settings.tolerance_sigmas)
            if failed != NOTHING:
                self._refuse_loose()
                raise _singular(failed)
        except GraphSlamError:
            self._put_off(vertices, edges)
            raise
        self._solved_with = None
        return moved, len(fresh)

    def _restructure(self, vertices: Index, edges: Index) -> Index:
        """Order and group what new vertices and edges touch; returns the cliques whose numbers are to be made."""
        touched = incremental.ends_of(self._tree, edges)
        if len(self._touched):
            touched = np.concatenate((touched, self._touched))
        if self._broken:
            vertices = self._unknowns()
            incremental.reset(self._tree, vertices)
        self._touched, self._broken, self._loose = _NONE, False, False
        self._tree, cliques = incremental.restructure(self._tree, touched, vertices)
        return cliques

    def _settle(self) -> None:
        """After a batch: make the numbers of the tree at its result, which stays."""
        self._linearize(self._active())
        failed, _ = incremental.renumber(self._tree, self._active(), np.inf, 0.0)
        if failed != NOTHING:
            self._broken = True
        self._settled = True

    def _activate(self) -> tuple[Index, Index, bool]:
        """Make what was added part of the problem: new unknowns, edges with a weight, and the answer of ``enter``."""
        vertices, edges = self._new_vertices, self._new_edges
        wanted = self._inside[vertices] & ~self._held[vertices]
        if not wanted.all():
            vertices = vertices[wanted]
        for table, rows in rows_of(self.graph, edges).items():
            weight = table.weight.values[rows]
            if not weight.all():
                edges = np.setdiff1d(edges, table.id.values[rows[weight == 0.0]])
        self._new_vertices = self._new_edges = _NONE
        return vertices, edges, incremental.enter(self._tree, vertices, edges)

    def _losses(self) -> list[Losses]:
        """Of each stage."""
        count, settings = self._losses_for
        if count != len(self.graph.labels) or settings is not self.settings:
            self._losses_for = len(self.graph.labels), self.settings
            self._stages = [Losses(self.graph, by_label) for by_label in self.settings.stages()]
        return self._stages

    def _linearize(self, edges: Index) -> None:
        """Put the blocks of edges at the linearisation points into the tree."""
        stages = self._losses()
        parts = [(edges, stages[-1])]
        if len(self._young):
            young = np.isin(edges, self._young)
            parts = [(edges[young], stages[0]), (edges[~young], stages[-1])]
        for ids, losses in parts:
            for b in linearize(self.graph, self._tree.value, rows_of(self.graph, ids), losses):
                refuse_nonfinite(b)
                store(self._tree, b.rows, b.table.id.values, b.residual, b.jacobian)

    def _put_off(self, vertices: Index, edges: Index) -> None:
        """Take back an update that failed: what it added waits again, and the tree is made anew without it."""
        incremental.leave(self._tree, vertices, edges)
        self._new_vertices = np.concatenate((vertices, self._new_vertices))
        self._new_edges = np.union1d(edges, self._new_edges)
        self._young, self._broken, self._settled = _NONE, True, True
        self._tree.state[TAIL_FIRST] = self._tree.state[TAIL_END] = 0  # it is filled anew with the tree

    def _take_out(self, one: Index) -> None:
        """Make a vertex no unknown any more."""
        if self._tree.vertex[one[0], FREE]:
            self._touched = np.concatenate((self._touched, incremental.leave(self._tree, one, _NONE)))
        self._loose = True

    def _set_estimate(self, values: Array) -> None:
        self._tree.value[: len(values)] = self._tree.estimate[: len(values)] = values
        self._tree.step[:] = 0.0

    def _refuse_loose(self) -> None:
        held = np.flatnonzero(self._inside & self._held)
        check_gauge(self.graph, self._unknowns(), held, self._active_rows())


def _singular(vertex: int) -> SingularError:
    return SingularError(f"the edges do not determine vertex {vertex}")


def _known(ids: ArrayLike, count: int, what: str) -> Index:
    at = np.asarray(ids, dtype=np.int64).ravel()
    strange = (at < 0) | (at >= count)
    if strange.any():
        raise GraphSlamError(f"{what} {int(at[strange][0])} does not exist")
    return at


def _admit(ids: Index, inside: NDArray[np.bool_], count: int, what: str) -> None:
    """Note ids as inside, each once; or refuse them all."""
    unfit = incremental.admit(ids, inside, count)
    if unfit != NOTHING:
        _known(ids[unfit], count, what)
        raise GraphSlamError(f"{what} {int(ids[unfit])} was added before")
