"""The seam between the problem and its solution: what it is made of, its estimate, its covariances."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import SE2, SE3, Graph
from graph_slam_ros.graph.graph import EdgeTable, whole_numbers
from graph_slam_ros.solver.batch import Problem, Settings, minimise
from graph_slam_ros.solver.clique_tree import incremental
from graph_slam_ros.solver.clique_tree.numeric import keep, settle
from graph_slam_ros.solver.clique_tree.storage import (
    ACTIVE,
    AFFECTED,
    BLOCKS_TOP,
    CLIQUE,
    DOF,
    FREE,
    KEY,
    LINKS,
    NOTHING,
    SE2_KIND,
    SE3_KIND,
    TAIL_END,
    TAIL_FIRST,
    VECTOR,
    empty_tree,
    longer,
    with_room,
)
from graph_slam_ros.solver.clique_tree.symbolic import compact
from graph_slam_ros.solver.covariance import joint, marginals
from graph_slam_ros.solver.gauge import check_gauge, fix_the_whole, undetermined
from graph_slam_ros.solver.linearization import (
    Losses,
    chi2_of,
    costs,
    information,
    linearize,
    refuse_nonfinite,
    residuals_of,
    rows_of,
    store,
)
from graph_slam_ros.solver.loss_stages import LossStages
from graph_slam_ros.solver.pending import NONE, PendingChanges
from graph_slam_ros.solver.relinearization import BY_FAR, RelinearizationSchedule
from graph_slam_ros.solver.report import Change, Report
from graph_slam_ros.typing import Array, Index

_KINDS = {SE2: SE2_KIND, SE3: SE3_KIND}


class Solver:
    """Maximum-likelihood estimate of the vertices it was given, online and in batch; it owns their estimates.

    Vertices and edges are records of a ``Graph``; the solver minimises over those that were added to it. ``update``
    costs what has changed, ``optimize`` what there is; both work on one clique tree. What fails, for whatever reason,
    leaves the estimate as it was. The weight of an edge is the graph's, so a graph has but one solver that changes it.
    """

    def __init__(self, graph: Graph, settings: Settings | None = None) -> None:
        self.graph = graph
        self.settings = settings or Settings()
        self._tree = empty_tree()
        self._vertices = 0  # of the graph, that have a record in the tree
        self._inside = np.zeros(0, dtype=bool)  # vertices of the problem
        self._held = np.zeros(0, dtype=bool)
        self._taken = np.zeros(0, dtype=bool)  # edges of the problem
        self._waiting = PendingChanges()
        self._kept = np.zeros(0)  # the estimate that the last call left
        self._stages = LossStages(graph)
        self._settled = True  # the tree's numbers are those at its linearisation points
        self._unfinished = False  # a batch stopped before the optimum
        self._schedule = RelinearizationSchedule()
        self._solved_with: Settings | None = None

    # -- what the problem is -----------------------------------------------------------------------------------------

    def add(self, vertices: ArrayLike, edges: ArrayLike) -> None:
        """Take vertices (at their initial values) and edges of the graph into the problem, by id, each once."""
        self._grow()
        new, new_edges = whole_numbers(vertices, "vertex").ravel(), whole_numbers(edges, "edge").ravel()
        _refuse_unfit(new, self._inside, self._vertices, "vertex")
        _refuse_unfit(new_edges, self._taken, self.graph.edge_count, "edge")
        rows = rows_of(self.graph, new_edges)
        for table, chosen in rows.items():
            missing = incremental.outside(chosen, table.vertices.values, table.weight.values, self._inside, new)
            if missing != NOTHING:
                raise GraphSlamError(f"an edge needs vertex {missing}, which was not added")
        for table, chosen in rows.items():
            self._record(table, chosen)
        there = (self._tree.vertex[new, KEY] != NOTHING).any()  # removed before: they are in the order still
        self._waiting.broken |= bool(there)
        self._waiting.add(new, new_edges)
        self._inside[new], self._taken[new_edges] = True, True

    def start_at(self, values: Array) -> None:
        """Begin from other values than the graph's initial ones: the stored numbers of all vertices, end to end."""
        self._grow()
        size = len(self.graph.initial)
        if values.shape != (size,) or not np.isfinite(values).all():
            raise GraphSlamError(f"start: expected {size} finite numbers, got an array {values.shape}")
        self._set_estimate(values)
        self._waiting.broken = True

    def place(self, vertex: int, value: ArrayLike) -> None:
        """Begin with another value than the graph's initial one for a vertex that is not in the problem yet."""
        self._grow()
        _known([vertex], self._vertices, "vertex")
        if self._inside[vertex]:
            raise GraphSlamError(f"vertex {vertex} is in the problem: it has an estimate")
        numbers, at = np.asarray(value, dtype=float), int(self.graph.offset.values[vertex])
        kind = self.graph.kind_of(vertex)
        if numbers.shape != (kind.size,) or kind.fault(numbers[None]) is not None:
            raise GraphSlamError(
                f"vertex {vertex}: expected {kind.size} finite numbers of {kind.name}, got {numbers.tolist()}"
            )
        for array in (self._tree.value, self._tree.estimate, self._kept):
            array[at : at + kind.size] = numbers

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
            self._waiting.again(one)
        elif self._tree.edge[edge, ACTIVE]:
            self._waiting.touch(ends)
            self._waiting.loose = True
            incremental.deactivate(self._tree, one)

    def hold(self, vertex: int) -> None:
        """Keep a vertex at its present estimate."""
        self._grow()
        one = _known([vertex], self._vertices, "vertex")
        self._held[vertex] = True
        if self._tree.vertex[vertex, FREE]:
            on_it = incremental.edges_of(self._tree.vertex, self._tree.link, vertex)
            on_it = on_it[self._tree.edge[on_it, ACTIVE] == 1]  # they are linearised where it is held
            self._waiting.again(on_it)
            self._take_out(one)

    def release(self, vertices: ArrayLike) -> None:
        """Estimate held vertices again. It makes the whole structure anew."""
        self._grow()
        self._held[_known(vertices, self._vertices, "vertex")] = False
        self.rebuild()

    @property
    def held(self) -> Index:
        """Ids of the vertices that are kept where they are."""
        return np.flatnonzero(self._held)

    def is_held(self, vertex: int) -> bool:
        """Whether a vertex is kept where it is."""
        return vertex < len(self._held) and bool(self._held[vertex])

    def remove(self, vertex: int) -> None:
        """Take a vertex out of the problem again; all its edges must be out (weight 0) before."""
        self._grow()
        one = _known([vertex], self._vertices, "vertex")
        if not self._inside[vertex]:
            raise GraphSlamError(f"vertex {vertex} is not in the problem")
        there = self._weighted(self.edges_on(vertex))
        if len(there):
            raise GraphSlamError(f"vertex {vertex} is needed by edge {int(there[0])}")
        self._inside[vertex] = self._held[vertex] = False
        self._waiting.forget(vertex)
        self._take_out(one)

    def edges_on(self, vertex: int) -> Index:
        """Ids of the edges of the problem on one vertex, also those of weight 0."""
        self._grow()
        _known([vertex], self._vertices, "vertex")
        return incremental.edges_of(self._tree.vertex, self._tree.link, vertex)

    @property
    def vertices(self) -> Index:
        """Ids of the vertices of the problem."""
        self._grow()
        return np.flatnonzero(self._inside)

    @property
    def degrees_of_freedom(self) -> int:
        """Numbers measured, without edges of weight 0, less numbers to be estimated."""
        self._grow()
        graph, tables = self.graph, self.graph.tables.values()
        measured = sum(table.type.residual_size * int(np.count_nonzero(table.weight.values)) for table in tables)
        sizes = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)
        return measured - int(sizes[graph.kind.values[self._unknowns()]].sum())

    @property
    def edges(self) -> Index:
        """Ids of the edges of the problem that have a weight."""
        self._grow()
        return self._weighted(np.flatnonzero(self._taken))

    @property
    def is_current(self) -> bool:
        """Whether nothing waits: covariances then are of all there is, and asking for them changes nothing."""
        return self._settled and not self._waiting

    def is_fixed(self) -> bool:
        """Whether a held vertex, or the edges on one vertex alone, fix position and heading of the whole."""
        self._grow()
        if (self._inside & self._held).any():
            return True
        rows = rows_of(self.graph, self.edges)
        return fix_the_whole(self.graph, self._tree.estimate, rows)

    # -- its solution ------------------------------------------------------------------------------------------------

    def update(self) -> Change:
        """Take in what was added and changed, and bring the estimate to the optimum of all of it.

        It costs what the change costs. Vertices whose step has become large are linearised anew (``Settings``).

        Raises
        ------
        GaugeError, SingularError
            The estimate stays; what was added since the last update is not in it, and waits for the next. So it is with
            any other exception, e.g. of a residual of one's own.
        """
        eliminated = int(self._tree.state[AFFECTED])
        arriving = self._arriving()
        with self._transaction(*arriving):
            moved, linearized = self._take_in(*arriving)
            if self._unfinished:
                moved = self._go_on()
            changed = [moved]
            for edges, these in self._relinearized(moved):
                linearized += edges
                changed.append(these)
        for moved in changed:
            self._keep(moved)
        return Change(int(self._tree.state[AFFECTED]) - eliminated, linearized, sum(map(len, changed)))

    def optimize(self, settings: Settings | None = None) -> Report:
        """Minimise the cost over everything, from the present estimate, until converged.

        Raises
        ------
        GaugeError, SingularError
            As for ``update``.
        """
        settings = settings or self.settings
        self._grow()
        if self._solved_with == settings and not self._waiting:
            return self.evaluate(settings)
        arriving = self._arriving(surely=True)
        with self._transaction(*arriving):
            self._forget_numbers()
            self._restructure(*arriving)
            unknowns = self._unknowns()
            if len(unknowns):
                report = minimise(Problem(self.graph, self._tree, self._active_rows(), unknowns), settings)
            else:
                report = self.evaluate(settings)
        self._kept[:] = self._tree.estimate
        self._settled, self._stages.young = not len(unknowns), NONE
        self._solved_with = settings if report.converged else None
        self._unfinished = not report.converged
        return report

    def evaluate(self, settings: Settings | None = None, at: Array | None = None) -> Report:
        """Chi2 and cost of the present estimate, or at other ``values``, with the last stage of the losses.

        Edges that wait for an update do not count yet.
        """
        self._grow()
        losses = Losses(self.graph, (settings or self.settings).stages()[-1])
        where = self._tree.estimate if at is None else at
        now = costs(self.graph, linearize(self.graph, where, self._active_rows(), losses))
        return Report("gn", "nothing_to_do", now.chi2, now.chi2, now.cost, now.cost, (), now.classes)

    def chi2_of(self, edges: ArrayLike) -> tuple[Array, Index]:
        """How well each edge fits at the estimate: r' Omega r without loss and weight, and how many numbers r is."""
        self._grow()
        ids = whole_numbers(edges, "edge").ravel()
        if len(ids):
            _known(ids, self.graph.edge_count, "edge")
        return chi2_of(self.graph, self._tree.estimate, ids)

    def residuals_of(self, edges: ArrayLike) -> Array:
        """What each edge measured against what the estimate says, in the units of its type, end to end."""
        self._grow()
        ids = whole_numbers(edges, "edge").ravel()
        out: list[list[float]] = [[]] * len(ids)
        for some, residual, _ in residuals_of(self.graph, self._tree.estimate, ids):
            for k, of_one in zip(some.tolist(), residual.tolist(), strict=True):
                out[k] = of_one
        return np.array([x for of_one in out for x in of_one])

    @property
    def values(self) -> Array:
        """The estimates of all vertices, as ``Graph.initial`` has them: what ``start_at`` takes."""
        self._grow()
        return self._tree.estimate[: len(self.graph.initial)].copy()

    def estimate(self, ids: ArrayLike) -> Array:
        """Values of vertices of one kind, (n, size)."""
        self._grow()
        at = whole_numbers(ids, "vertex").ravel()
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
        with self._looking():
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
            with self._looking():
                out[np.ix_(at, at)] = joint(self._tree, wanted[free])
        return out

    def information_matrix(self) -> Array:
        """H as a dense matrix, vertices in order of id, with edges that wait: for tests and small examples.

        It is linearised at the present estimate with the last stage of the losses; ``marginal`` is of the tree, whose
        linearisation points may be a small step (``Settings.relinearize_above``) away.
        """
        self._grow()
        free = np.flatnonzero(self._inside & ~self._held)
        losses = self._stages.losses(self.settings)[-1]
        return information(self.graph, self._tree.estimate, rows_of(self.graph, self.edges), free, losses)

    def compact(self) -> None:
        """Move the fronts in use together, so that what is free lies behind them; memory is not given back.

        It is done by itself before more memory is asked for.
        """
        compact(self._tree)

    def rebuild(self) -> None:
        """Make everything anew from the graph, at the present estimate; what fails leaves all as it was.

        For after a fault that nobody foresaw: whatever it left behind in the tree is gone.
        """
        values, vertices, taken = self.values, self.vertices, np.flatnonzero(self._taken)
        fresh = Solver(self.graph, self.settings)
        fresh.start_at(values)
        fresh.add(vertices, taken)
        for vertex in self.held.tolist():
            fresh.hold(vertex)
        vars(self).update(vars(fresh))

    # -- inside ------------------------------------------------------------------------------------------------------

    def _grow(self) -> None:
        """Follow the graph's growth: new vertices start at their initial values."""
        graph, known = self.graph, self._vertices
        if graph.vertex_count > known:
            count, size = graph.vertex_count, len(graph.initial)
            self._tree = with_room(self._tree, vertex=count, region=2 * count, tail=2 * count)
            self._tree = with_room(self._tree, diagonal=size, step=size, value=size, estimate=size)
            self._inside, self._held = longer(self._inside, count), longer(self._held, count)
            self._kept = longer(self._kept, len(self._tree.estimate))
            first = int(graph.offset.values[known])
            self._kept[first:size] = graph.initial.values[first:]
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
        if not self._held[wanted].all():
            if self._waiting:
                self.update()
            elif not self._settled:
                arriving = self._arriving()
                with self._transaction(*arriving):
                    moved, _ = self._take_in(*arriving)
                self._keep(moved)
            if (self._tree.vertex[wanted[~self._held[wanted]], CLIQUE] == NOTHING).any():
                raise GraphSlamError("a covariance was asked for within an update")
        return wanted

    def _unknowns(self) -> Index:
        return np.flatnonzero(self._tree.vertex[: self._vertices, FREE])

    def _active(self) -> Index:
        return np.flatnonzero(self._tree.edge[:, ACTIVE])

    def _active_rows(self) -> dict[EdgeTable, Index]:
        return rows_of(self.graph, self._active())

    def _weighted(self, edges: Index) -> Index:
        """Those with a weight."""
        for table, rows in rows_of(self.graph, edges).items():
            weight = table.weight.values[rows]
            if not weight.all():
                edges = np.setdiff1d(edges, table.id.values[rows[weight == 0.0]])
        return edges

    def _arriving(self, *, surely: bool = False) -> tuple[Index, Index]:
        """The unknowns and edges that will be part of the problem; all is as it was.

        Raises
        ------
        GaugeError
            With them, nothing fixes a part of it; that is looked into where it may be so, or ``surely``.
        """
        self._grow()
        waiting, tree = self._waiting, self._tree
        vertices, edges = waiting.vertices, self._weighted(waiting.edges())
        wanted = self._inside[vertices] & ~self._held[vertices]
        if not wanted.all():
            vertices = vertices[wanted]
        if (
            surely
            or waiting.loose
            or waiting.broken
            or not incremental.anchored(tree.vertex, tree.edge, tree.link, vertices, edges)
        ):
            self._refuse_loose()
        return vertices, edges

    @contextmanager
    def _transaction(self, vertices: Index, edges: Index) -> Iterator[None]:
        """Let vertices and edges enter; whatever fails then, they are out again and wait, and the estimate stays.

        The tree is made anew at the next update: its numbers are half old and half new.
        """
        waiting, tree = self._waiting, self._tree
        try:
            incremental.enter(tree, vertices, edges)
            yield
        except BaseException:
            waiting.broken, self._stages.young, self._settled = True, NONE, True
            tree.state[TAIL_FIRST] = tree.state[TAIL_END] = 0  # it is filled anew with the tree
            self._set_estimate(self._kept)
            incremental.leave(self._tree, vertices, edges)  # the last: it needs memory
            raise
        self._waiting = PendingChanges()

    @contextmanager
    def _looking(self) -> Iterator[None]:
        """What fails leaves its scratch in the tree, which is made anew at the next update."""
        try:
            yield
        except BaseException:
            self._waiting.broken = True
            raise

    def _keep(self, moved: Index) -> None:
        """The estimates of vertices are those to come back to."""
        if len(moved):
            keep(self._tree.vertex, self._tree.estimate, self._kept, moved)

    def _take_in(self, vertices: Index, edges: Index) -> tuple[Index, int]:
        """Solve with what arrives; the vertices that moved, and how many edges were linearised."""
        waiting, settings = self._waiting, self.settings
        if not self._settled and not waiting.broken:
            self._settle()
        young = self._stages.young
        if not waiting and not len(young):
            return NONE, 0
        fresh = np.union1d(edges, young) if len(young) else edges
        self._stages.begin(edges, settings)
        if waiting.broken:
            self._forget_numbers()
            fresh = self._active()
        self._linearize(fresh)
        cliques = self._restructure(vertices, fresh)
        failed, moved = incremental.solve(self._tree, cliques, settings.tolerance, settings.tolerance_sigmas)
        if failed != NOTHING:
            self._refuse_loose()
            raise undetermined(failed)
        self._stages.mature(self._tree.value, settings)
        self._solved_with, self._settled = None, True
        return moved, len(fresh)

    def _go_on(self) -> Index:
        """Step from where a batch stopped before the optimum; the vertices that moved."""
        settings, self._unfinished = self.settings, False
        failed, moved = incremental.renumber(self._tree, self._active(), settings.tolerance, settings.tolerance_sigmas)
        if failed != NOTHING:
            raise undetermined(failed)
        self._schedule.hasten(settings.relinearize_every)
        return moved

    def _relinearized(self, moved: Index) -> Iterator[tuple[int, Index]]:
        """Pass after pass: how many edges were linearised anew, and the vertices that this moved."""
        settings = self.settings
        moved, far = self._schedule.after_update(moved, settings.relinearize_every)
        for _ in range(settings.relinearize_passes):
            edges = incremental.relinearize(
                self._tree, moved, far * settings.relinearize_above, far**2 * settings.relinearize_error
            )
            if not len(edges):
                return
            self._linearize(edges)
            failed, moved = incremental.renumber(self._tree, edges, settings.tolerance, settings.tolerance_sigmas)
            if failed != NOTHING:
                raise undetermined(failed)
            self._schedule.note(moved)
            far = BY_FAR
            yield len(edges), moved

    def _forget_numbers(self) -> None:
        """All edges are about to be linearised: sums begin at zero."""
        self._tree.blocks[:] = 0.0
        self._tree.diagonal[:] = 0.0

    def _restructure(self, vertices: Index, edges: Index) -> Index:
        """Order and group what new vertices and edges touch; returns the cliques whose numbers are to be made."""
        touched = np.concatenate((incremental.ends_of(self._tree, edges), self._waiting.touched))
        if self._waiting.broken:
            vertices = self._unknowns()
            incremental.reset(self._tree, vertices)
        self._tree, cliques = incremental.restructure(self._tree, touched, vertices)
        return cliques

    def _settle(self) -> None:
        """After a batch: make the numbers of the tree at its result, which stays."""
        self._linearize(self._active())
        failed, _ = incremental.renumber(self._tree, self._active(), np.inf, 0.0)
        if failed != NOTHING:
            self._waiting.broken = True
        self._settled = True

    def _linearize(self, edges: Index) -> None:
        """Put the blocks of edges at the linearisation points into the tree."""
        for ids, losses in self._stages.of(edges, self.settings):
            for b in linearize(self.graph, self._tree.value, rows_of(self.graph, ids), losses):
                refuse_nonfinite(b)
                store(self._tree, b.rows, b.table.id.values, b.residual, b.jacobian)

    def _take_out(self, one: Index) -> None:
        """Make a vertex no unknown any more; it stays at its estimate."""
        settle(self._tree, one)
        if self._tree.vertex[one[0], FREE]:
            self._waiting.touch(incremental.leave(self._tree, one, NONE))

    def _set_estimate(self, values: Array) -> None:
        for array in (self._tree.value, self._tree.estimate, self._kept):
            array[: len(values)] = values
        self._tree.step[:] = 0.0

    def _refuse_loose(self) -> None:
        """Raise GaugeError where nothing fixes a part of the problem, with all that waits."""
        rows = rows_of(self.graph, self.edges)
        check_gauge(
            self.graph, np.flatnonzero(self._inside & ~self._held), np.flatnonzero(self._inside & self._held), rows
        )


def _known(ids: ArrayLike, count: int, what: str) -> Index:
    at = whole_numbers(ids, what).ravel()
    strange = (at < 0) | (at >= count)
    if strange.any():
        raise GraphSlamError(f"{what} {int(at[strange][0])} does not exist")
    return at


def _refuse_unfit(ids: Index, inside: NDArray[np.bool_], count: int, what: str) -> None:
    """Raise where an id does not exist, is inside or is given twice."""
    unfit = incremental.unfit(ids, inside, count)
    if unfit != NOTHING:
        _known(ids[unfit], count, what)
        raise GraphSlamError(f"{what} {int(ids[unfit])} was added before")
