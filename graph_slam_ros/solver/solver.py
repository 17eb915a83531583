"""The solution of a problem: which vertices and edges of a graph are solved for, their estimates and covariances."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.records import weights_of
from graph_slam_ros.graph.tables import whole_numbers
from graph_slam_ros.graph.vertices import code_of
from graph_slam_ros.solver import update
from graph_slam_ros.solver.batch import BatchProblem, Change, Report, minimise
from graph_slam_ros.solver.clique_tree import incremental
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.incremental import DISSECT, DONE, more_room, restructure
from graph_slam_ros.solver.clique_tree.numeric import accept_steps
from graph_slam_ros.solver.clique_tree.ordering import dissect, ends_of
from graph_slam_ros.solver.clique_tree.storage import (
    NONE,
    NOTHING,
    Limits,
    Tree,
    compact,
    empty_tree,
    longer,
    pointers_of,
    with_room,
)
from graph_slam_ros.solver.clique_tree.substitution import forget, read, show, show_all
from graph_slam_ros.solver.covariance import among, joint, joint_of_each, without_edges
from graph_slam_ros.solver.gauge import check_gauge, degrees_of_freedom, fix_the_whole, undetermined
from graph_slam_ros.solver.linearization import (
    Losses,
    chi2_of,
    costs,
    evaluated,
    information,
    linearize_into,
)
from graph_slam_ros.solver.relinearization import (
    MAYBE,
    NO_LIMITS,
    SURELY,
    LossStages,
    RelinearizationSchedule,
    neglected,
)
from graph_slam_ros.solver.settings import Settings
from graph_slam_ros.typing import Array, Index


class PendingChanges:
    """Changes that the next update integrates.

    Attributes
    ----------
    vertices : that were added
    new, back : edges that were added; that came back, or have another weight or a newly held vertex
    touched : vertices that lost an edge or a neighbour
    may_float : whether something that held parts together may be gone
    moved : whether all linearisation points were moved, so that nothing is linearised there yet
    broken : whether the tree must be made anew
    """

    __slots__ = ("back", "broken", "may_float", "moved", "new", "touched", "vertices")

    def __init__(self) -> None:
        self.vertices = self.new = self.touched = NONE
        self.back: list[Index] = []
        self.may_float = self.moved = self.broken = False

    def __bool__(self) -> bool:
        is_changed = len(self.vertices) or len(self.new) or self.back or len(self.touched)
        return bool(is_changed or self.moved or self.broken)

    def is_plain(self) -> bool:
        """Return whether vertices and edges were added, and nothing else was changed."""
        is_special = self.back or self.may_float or self.moved or self.broken
        return not is_special and len(self.vertices) + len(self.new) > 0

    def add(self, vertices: Index, edges: Index) -> None:
        """Append new vertices and edges."""
        all_vertices = np.concatenate((self.vertices, vertices)) if len(self.vertices) else vertices
        all_new = np.concatenate((self.new, edges)) if len(self.new) else edges
        self.vertices, self.new = all_vertices, all_new  # both, or where memory lacks neither

    def edges(self) -> Index:
        """Return all edges to be linearised, each once."""
        return np.unique(np.concatenate((self.new, *self.back))) if self.back else self.new

    def touch(self, vertices: Index) -> None:
        """Append vertices that lost an edge or a neighbour."""
        self.touched = np.concatenate((self.touched, vertices))

    def forget(self, vertices: Index) -> None:
        """Drop vertices that were removed before an update integrated them."""
        if len(self.vertices):
            self.vertices = self.vertices[~np.isin(self.vertices, vertices)]


class Transaction:
    """The context in which all that is pending enters and is solved for; an error undoes it.

    After an error it is pending again, and the estimate is that of before. The tree is rebuilt at the next update,
    because its numbers are half old and half new; not so if nothing has entered yet.

    A generator as context would take twice the time, in each update.
    """

    __slots__ = ("_entered", "_problem", "_substituted")

    def __init__(self, problem: "Solver") -> None:
        state = problem._tree.state
        self._problem, self._entered, self._substituted = problem, int(state[its.ENTERED]), int(state[its.SUBSTITUTED])

    def __enter__(self) -> None:
        pass

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None:
            self._problem._pending = PendingChanges()
        elif self._problem._tree.state[its.ENTERED] != self._entered:
            self._problem._undo(self._substituted)


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
        self._shapes = np.zeros((0, its.SHAPE_COLUMNS), dtype=np.int64)  # of the graph's kinds
        self._room = 0, 0, 0  # for vertices, their numbers, and edges
        self._vertices = 0  # of the graph, that have a record in the tree
        self._inside = np.zeros(0, dtype=bool)  # vertices of the problem
        self._held = np.zeros(0, dtype=bool)
        self._edge_inside = np.zeros(0, dtype=bool)  # edges of the problem
        self._pending = PendingChanges()
        self._kept = np.zeros(0)  # the estimate that the last call left, of what was read since it changed
        self._stages = LossStages(graph)
        self._schedule = RelinearizationSchedule()
        self._numbers_current = True  # the tree's numbers are those at its linearisation points
        self._solved_with: Settings | None = None  # a batch that converged, and nothing was changed since
        self._unfinished = False  # a batch stopped before the optimum
        self._locate()

    # -- the problem ---------------------------------------------------------------------------------------------------

    def add(self, vertices: ArrayLike, edges: ArrayLike) -> None:
        """Add vertices (at their initial values) and edges of the graph to the problem, by id, each once."""
        ids, edge_ids = whole_numbers(vertices, "vertex").ravel(), whole_numbers(edges, "edge").ravel()
        new, new_edges = self.graph.vertex_ids.rows(ids), self.graph.edge_ids.rows(edge_ids)
        was_in = self._record(new, new_edges, (ids, edge_ids))  # and was removed: it is in the order still
        self._pending.broken |= was_in
        self._pending.add(new, new_edges)
        self._inside[new], self._edge_inside[new_edges] = True, True

    def start_at(self, values: Array) -> None:
        """Start from other values than the graph's initial ones: the stored numbers of all vertices in one array."""
        self._grow()
        size = len(self.graph.initial)
        if values.shape != (size,) or not np.isfinite(values).all():
            raise GraphSlamError(f"start: expected {size} finite numbers, got an array {values.shape}")
        self._set_estimate(values)
        self._pending.moved |= bool(self._tree.state[its.CLIQUES])

    def place(self, vertex: int, value: ArrayLike) -> None:
        """Start a vertex that is not in the problem yet from another value than the graph's initial one."""
        self._grow()
        one, numbers = self.graph.vertex(vertex), np.asarray(value, dtype=float)
        if self.has(vertex):
            raise GraphSlamError(f"vertex {vertex} is in the problem: it has an estimate")
        kind = one.kind
        if numbers.shape != (kind.size,) or kind.fault(numbers[None]) is not None:
            due = f"{kind.size} finite numbers of {kind.name}"
            raise GraphSlamError(f"vertex {vertex}: expected {due}, got {numbers.tolist()}")
        for array in (self._tree.value, self._tree.estimate, self._kept):
            array[one.stored] = numbers

    def set_weight(self, edge: int, weight: float) -> None:
        """Multiply the information of an edge; 0 removes it from the structure, another value adds it again."""
        if not (np.isfinite(weight) and weight >= 0.0):
            raise GraphSlamError(f"edge {edge}: weight {weight} is not a finite number >= 0")
        if not weight:
            return self.leave_out([edge])
        self._grow()
        one = self.graph.edge_ids.existing([edge])
        table, row = self.graph.row(edge)
        ends, is_inside = table.vertex_rows.values[row], self._edge_inside[one[0]]
        if is_inside and len(removed := ends[~self._inside[ends]]):
            raise GraphSlamError(f"edge {edge} needs vertex {self.graph.vertex_ids.of(removed[0])}, which was removed")
        table.weight.values[row] = weight
        if is_inside:
            self._pending.back.append(one)

    def leave_out(self, edges: ArrayLike) -> None:
        """Set the weight of edges to 0, as ``set_weight`` does one by one."""
        self._grow()
        rows = self.graph.edge_ids.existing(edges)
        for table, of_table in self.graph.rows_by_table(rows).items():
            table.weight.values[of_table] = 0.0
        active = rows[self._edge_inside[rows] & (self._tree.edge[rows, its.ACTIVE] == 1)]
        if len(active):
            self._pending.touch(ends_of(self._tree, active))
            self._pending.may_float = True
            incremental.deactivate(self._tree, active)

    def hold(self, vertex: int) -> None:
        """Keep a vertex at its present estimate."""
        self._grow()
        one = self.graph.vertex_ids.existing([vertex])
        self._held[one] = True
        if self._tree.vertex[one[0], its.FREE]:
            on_it = incremental.edges_of(self._tree.vertex, self._tree.link, int(one[0]))
            on_it = on_it[self._tree.edge[on_it, its.ACTIVE] == 1]  # they are linearised where it is held
            self._pending.back.append(on_it)
            self._fix_at_estimate(one)

    @property
    def held(self) -> Index:
        """Ids of the vertices that stay at their values."""
        return self.graph.vertex_ids.of_all(np.flatnonzero(self._held))

    def has(self, vertex: int) -> bool:
        """Return whether a vertex is part of the problem."""
        return 0 <= (row := self.graph.vertex_ids.row(vertex)) < len(self._inside) and bool(self._inside[row])

    def is_held(self, vertex: int) -> bool:
        """Return whether a vertex stays at its value."""
        return 0 <= (row := self.graph.vertex_ids.row(vertex)) < len(self._held) and bool(self._held[row])

    def remove(self, vertices: ArrayLike) -> None:
        """Remove vertices from the problem; all their edges must have weight 0 before."""
        self._grow()
        rows = self._of_problem(vertices)
        for row in rows.tolist():
            needed = self._weighted(incremental.edges_of(self._tree.vertex, self._tree.link, row))
            if len(needed):
                vertex, edge = self.graph.vertex_ids.of(row), self.graph.edge_ids.of(int(needed[0]))
                raise GraphSlamError(f"vertex {vertex} is needed by edge {edge}")
        self._inside[rows] = self._held[rows] = False
        self._pending.forget(rows)
        self._fix_at_estimate(rows)

    def edges_on(self, vertex: int) -> Index:
        """Ids of the edges of the problem on one vertex, also those of weight 0."""
        self._grow()
        (row,) = self.graph.vertex_ids.existing([vertex]).tolist()
        return self.graph.edge_ids.of_all(incremental.edges_of(self._tree.vertex, self._tree.link, row))

    @property
    def vertices(self) -> Index:
        """Ids of the vertices of the problem."""
        self._grow()
        return self.graph.vertex_ids.of_all(np.flatnonzero(self._inside))

    @property
    def degrees_of_freedom(self) -> int:
        """The measured numbers, without edges of weight 0, less the estimated numbers, also those of a frozen map."""
        self._grow()
        return degrees_of_freedom(self.graph, self._unknowns(), self._held[: self.graph.vertex_count])

    @property
    def edges(self) -> Index:
        """Ids of the edges of the problem that have a weight."""
        self._grow()
        return self.graph.edge_ids.of_all(self._in_use())

    def is_fixed(self) -> bool:
        """Return whether a held vertex, or the edges on one vertex alone, fix position and heading of the whole."""
        self._grow()
        if (self._inside & self._held).any():
            return True
        return fix_the_whole(self.graph, self._estimates(), self.graph.rows_by_table(self._in_use()))

    @property
    def values(self) -> Array:
        """The estimates of all vertices, in the layout of ``Graph.initial``; ``start_at`` accepts them."""
        self._grow()
        return self._estimates()[: len(self.graph.initial)].copy()

    def chi2_of(self, edges: ArrayLike) -> tuple[Array, Index]:
        """Chi2 of each edge at the estimate: r' Omega r without loss and weight, and the size of r."""
        self._grow()
        return chi2_of(self.graph, self._estimates(), self.graph.edge_ids.existing(edges))

    def residuals_of(self, edges: ArrayLike) -> Array:
        """Residuals of edges at the estimate, not whitened, in the units of their types, end to end."""
        self._grow()
        return evaluated(self.graph, self._estimates(), self.graph.edge_ids.existing(edges))[0]

    def compact(self) -> None:
        """Move the fronts in use together in memory; memory is not returned to the system.

        The solver does so itself before it asks for more memory.
        """
        compact(self._tree)

    # -- the solution --------------------------------------------------------------------------------------------------

    def release(self, vertices: ArrayLike) -> None:
        """Estimate held vertices again. The whole structure is rebuilt."""
        self._grow()
        self._held[self.graph.vertex_ids.existing(vertices)] = False
        self.rebuild()

    @property
    def is_current(self) -> bool:
        """Return whether nothing is pending, covariances then include all edges, and reading them changes nothing."""
        return self._numbers_current and not self._pending

    def update(self) -> Change:
        """Integrate what was added and changed, and bring the estimate to the optimum of all of it.

        It costs what the change costs. Vertices whose step has become large are linearised anew (``Settings``).

        Raises
        ------
        GaugeError, SingularError
            The estimate stays; what was added since the last update is not in it, and stays pending. So it is with
            any other exception, e.g. of a residual of one's own.
        """
        self._grow()
        state = self._tree.state
        eliminated = int(state[its.AFFECTED])
        found: list[Index] = []
        with Transaction(self):
            linearized, moved, solved, far = self._integrate()
            if self._unfinished:
                solved, far = self._continue_batch()
                moved = len(solved)
            if len(far):
                found.append(solved)
                for again, these in self._relinearized(far):
                    linearized, moved = linearized + again, moved + len(these)
                    found.append(these)
        if self.settings.at_once:
            self._estimates()
        else:
            for these in found:
                show(self._tree, self._kept, these)
        return Change(int(state[its.AFFECTED]) - eliminated, linearized, moved)

    def optimize(self, settings: Settings | None = None) -> Report:
        """Minimise the cost over everything, from the present estimate, until converged.

        Raises
        ------
        GaugeError, SingularError
            As for ``update``.
        """
        settings = settings or self.settings
        self._grow()
        if self.graph.vertex_count and not len(self.vertices):
            raise GraphSlamError("nothing to solve: give the solver vertices and edges (add), or call optimize(graph)")
        if self._solved_with == settings and not self._pending:
            return self.evaluate(settings)
        arriving = self._arriving(surely=bool(self._pending))
        self._estimates()
        with Transaction(self):
            incremental.enter(self._tree, *arriving)
            self._tree.state[its.SUBSTITUTED] += 1  # from here on, steps are those of the batch
            self._forget_numbers()
            self._restructure(*arriving)
            active, unknowns = self.graph.rows_by_table(self._active()), self._unknowns()
            if len(unknowns):
                report = minimise(BatchProblem(self.graph, self._tree, active, unknowns), settings)
            else:
                report = self.evaluate(settings)
        forget(self._tree)
        self._kept[:] = self._tree.estimate
        self._numbers_current, self._stages.young = not len(unknowns), NONE
        self._solved_with = settings if report.converged else None
        self._unfinished = not report.converged
        return report

    def evaluate(self, settings: Settings | None = None, at: Array | None = None) -> Report:
        """Chi2 and cost of the present estimate, or at other ``values``, with the last stage of the losses.

        Pending edges do not count yet.
        """
        self._grow()
        losses = Losses(self.graph, (settings or self.settings).stages()[-1])
        where = self._estimates() if at is None else at
        chi2, cost, classes = costs(self.graph, where, self.graph.rows_by_table(self._active()), losses)
        return Report("gn", "nothing_to_do", chi2, chi2, cost, cost, (), classes)

    def estimate(self, ids: ArrayLike) -> Array:
        """Values of vertices of one kind, (n, size)."""
        self._grow()
        at = self.graph.vertex_ids.rows(whole_numbers(ids, "vertex").ravel())
        if not len(at):
            return np.empty((0, 0))
        settings = self.settings
        tolerances = settings.tolerance, settings.tolerance_sigmas
        unfit, out = read(self.graph.pointers, self._pointers, self._vertices, at, *tolerances)
        if unfit != NOTHING:
            self.graph.vertex_ids.existing(ids)
            raise GraphSlamError("estimate: the vertices are not of one kind")
        return out

    def marginal(self, ids: ArrayLike) -> list[Array]:
        """Covariance (dof, dof) of each vertex in its tangent space; zero for a held one.

        Pending changes are integrated first.

        Raises
        ------
        GaugeError, SingularError
            A covariance that does not exist is refused.
        """
        wanted = self._with_covariance(ids)
        dofs, out = self._tree.vertex[wanted, its.DOF], [np.empty((0, 0))] * len(wanted)
        with self._tree_remade_after_error():
            for dof in np.unique(dofs):
                of_size = np.flatnonzero(dofs == dof)
                is_one = len(wanted) == 1 and not self._held[wanted[0]]
                found = joint(self._tree, wanted)[None] if is_one else among(self._tree, wanted[of_size, None])
                for k, covariance in zip(of_size.tolist(), found, strict=True):
                    out[k] = covariance
        return out

    def joint_marginal(self, ids: ArrayLike) -> Array:
        """Covariance (D, D) of some vertices together, in the order given, each once; as ``marginal`` for each."""
        return self._joint(self._with_covariance(ids))

    def _joint(self, wanted: Index) -> Array:
        if len(set(wanted.tolist())) < len(wanted):
            raise GraphSlamError("a joint covariance of a vertex with itself")
        held = self._held[wanted]
        with self._tree_remade_after_error():
            of_free = np.zeros((0, 0)) if held.all() else joint(self._tree, wanted[~held])
        if not held.any():
            return of_free
        free = np.repeat(~held, self._tree.vertex[wanted, its.DOF])
        out = np.zeros((len(free), len(free)))
        out[np.ix_(free, free)] = of_free
        return out

    def joint_marginal_without(self, ids: ArrayLike, edges: ArrayLike) -> tuple[Array, Array]:
        """Stored values of vertices and their ``joint_marginal``, as they would be without some edges.

        All others stay linearised where they are. Nothing is changed.

        Raises
        ------
        GaugeError, SingularError
            Also where the other edges do not determine these vertices, or so weakly that rounding would decide.
        """
        wanted = self._with_covariance(ids)
        left_out = self.graph.edge_ids.existing(edges)
        self._estimates()
        return without_edges(self.graph, self._tree, self._joint, wanted, left_out)

    def edge_marginals(self, ends: Index, *, are_inside: bool = True) -> Array:
        """Covariances (n, D, D) as ``joint_marginal`` has them, of the vertices (n, k) of edges of one type.

        It takes longer if the edges are not in the problem.
        """
        rows = self._with_covariance(ends).reshape(ends.shape)
        with self._tree_remade_after_error():
            of_each = among if are_inside else joint_of_each
            return of_each(self._tree, rows) if len(rows) else np.zeros((0, 0, 0))

    def covariances_with(self, vertex: int) -> dict[int, Array]:
        """Covariances (dof, d) of each vertex, by id, with one of them; zero for held ones.

        ``joint_marginal`` of each pair would take a thousand times as long for a drive.
        """
        self._with_covariance(self.vertices)
        held, dofs = (self._held | ~self._inside)[: self._vertices], self._tree.vertex[: self._vertices, its.DOF]
        row = self.graph.vertex_ids.row(vertex)
        is_free, first = np.repeat(~held, dofs), int(self._tree.vertex[row, its.STEP])
        out = np.zeros((len(is_free), int(dofs[row])))
        if not held[row]:
            unit = np.eye(*out.shape, -first)[is_free]
            out[is_free] = splu(self._information(self._tree.value).tocsc(), permc_spec="MMD_AT_PLUS_A").solve(unit)
        return dict(zip(self.graph.vertex_ids.since().tolist(), np.split(out, np.cumsum(dofs)[:-1]), strict=True))

    def information_matrix(self) -> Array:
        """H as a dense matrix, vertices in order of id, with pending edges: for tests and small examples.

        It is linearised at the present estimate with the last stage of the losses; ``marginal`` is of the tree, whose
        linearisation points may be a small step (``Settings.relinearize_above``) away.
        """
        self._grow()
        return self._information(self._estimates()).toarray()

    def rebuild(self) -> None:
        """Rebuild everything from the graph, at the present estimate; a failure leaves all as it was.

        It is for an unforeseen fault: it removes whatever that left in the tree.
        """
        edges = self.graph.edge_ids.of_all(np.flatnonzero(self._edge_inside))
        self._begin_anew(self.values, self.vertices, edges, self.held)

    def keep(self, vertices: Index, edges: Index) -> None:
        """Remove all but some vertices and edges, given in order, from the graph, too; what stays is pending."""
        inside, held = (np.intersect1d(vertices, some) for some in (self.vertices, self.held))
        self.graph.keep(vertices, edges, self.values)
        self._begin_anew(self.graph.initial.values, inside, edges, held)

    def _begin_anew(self, values: Array, vertices: Index, edges: Index, held: Index) -> None:
        fresh = Solver(self.graph, self.settings)
        fresh.start_at(values)
        fresh.add(vertices, edges)
        for vertex in held.tolist():
            fresh.hold(vertex)
        vars(self).update(vars(fresh))

    # -- inside: the problem -------------------------------------------------------------------------------------------

    def _estimates(self) -> Array:
        """Return the estimates of all vertices, none of them waiting; they stay the tree's."""
        state = self._tree.state
        if state[its.STALE_COUNT] or state[its.DEFERRED_COUNT]:
            show_all(self._tree, self._kept, self.settings.tolerance, self.settings.tolerance_sigmas)
        return self._tree.estimate

    def _grow(self) -> None:
        """Follow the graph's growth: new vertices start at their initial values."""
        graph = self.graph
        if graph.kind.count > self._vertices or graph.row_of_edge.count > self._room[2]:
            self._record(NONE, NONE)

    def _record(self, new: Index, new_edges: Index, named: tuple[Index, Index] = (NONE, NONE)) -> bool:
        """Follow the graph's growth, and record what is added to the problem; nothing where some of it is unfit.

        Returns whether one of the vertices is in the order of the tree still.
        """
        graph = self.graph
        now = graph.kind.count, graph.initial.count, graph.row_of_edge.count
        room = self._room
        if now[0] > room[0] or now[1] > room[1] or now[2] > room[2] or len(self._shapes) != len(graph.kinds):
            self._follow(*now)
        how, what, blocks = update.record(graph.pointers, self._pointers, (self._vertices, *now), new, new_edges)
        while how == update.NO_ROOM:
            self._replace_tree(partial(with_room, link=what, blocks=blocks))
            how, what, blocks = update.record(graph.pointers, self._pointers, (self._vertices, *now), new, new_edges)
        self._vertices = now[0]
        if how == update.RECORDED:
            return bool(what)
        if how == update.WITHOUT_VERTEX:
            raise GraphSlamError(f"an edge needs vertex {graph.vertex_ids.of(int(what))}, which was not added")
        one = int(named[how == update.UNFIT_EDGE][what])
        (graph.edge if how == update.UNFIT_EDGE else graph.vertex)(one)  # it may not exist
        raise GraphSlamError(f"{'edge' if how == update.UNFIT_EDGE else 'vertex'} {one} was added before")

    def _follow(self, count: int, size: int, edges: int) -> None:
        """Make room for so many vertices, their stored numbers, and edges."""
        try:
            self._tree = with_room(
                self._tree,
                vertex=count, region=2 * count, tail=2 * count, listed=count, edge=edges,
                diagonal=size, step=size, reference=size, value=size, estimate=size,
            )  # fmt: skip
            self._inside, self._held = longer(self._inside, count), longer(self._held, count)
            self._edge_inside = longer(self._edge_inside, edges)
            self._kept = longer(self._kept, len(self._tree.estimate))
            if len(self._shapes) != len(self.graph.kinds):
                self._shapes = np.array([(k.dof, k.size, code_of(k)) for k in self.graph.kinds])
        finally:  # some may have grown in place
            self._locate()
        self._room = self._room_now()

    def _locate(self) -> None:
        """Note where the arrays are, after they moved in memory."""
        more = self._kept, self._inside, self._held, self._edge_inside, self._shapes
        self._pointers = pointers_of(self._tree, *more)

    def _room_now(self) -> tuple[int, int, int]:
        """Return for how many vertices, numbers of theirs, and edges there is room."""
        t = self._tree
        vertices = t.vertex, t.listed, self._inside, self._held, t.tail[::2], t.region[::2]
        numbers = t.diagonal, t.step, t.reference, t.value, t.estimate, self._kept
        return min(map(len, vertices)), min(map(len, numbers)), min(len(t.edge), len(self._edge_inside))

    def _replace_tree(self, change: Callable[[Tree], Tree]) -> None:
        """Take another tree for the present one, some of whose arrays may have grown in place even if this fails."""
        try:
            self._tree = change(self._tree)
        finally:
            self._locate()

    def _unknowns(self) -> Index:
        return np.flatnonzero(self._tree.vertex[: self._vertices, its.FREE])

    def _active(self) -> Index:
        return np.flatnonzero(self._tree.edge[:, its.ACTIVE])

    def _in_use(self) -> Index:
        return self._weighted(np.flatnonzero(self._edge_inside))

    def _of_problem(self, vertices: ArrayLike) -> Index:
        """The rows of vertices, which must be in the problem."""
        rows = self.graph.vertex_ids.existing(vertices)
        if not (is_inside := self._inside[rows]).all():
            raise GraphSlamError(f"vertex {self.graph.vertex_ids.of(rows[~is_inside][0])} is not in the problem")
        return rows

    def _weighted(self, edges: Index) -> Index:
        """The edges among these that have a weight."""
        has_weight = weights_of(self.graph.pointers, edges) != 0.0
        return edges if np.count_nonzero(has_weight) == len(edges) else edges[has_weight]

    def _arriving(self, *, surely: bool = False) -> tuple[Index, Index]:
        """Return the unknowns and edges that enter the problem; nothing is changed.

        A GaugeError where nothing would fix a part of the problem. This is checked if it may be so, or if ``surely``.
        """
        self._grow()
        pending, graph = self._pending, self.graph
        vertices, edges = pending.vertices, pending.edges()
        found = update.anchorage(self._tree, graph.pointers, self._pointers, vertices, edges)
        if found == update.LEFT_OUT:
            vertices, edges = vertices[self._inside[vertices] & ~self._held[vertices]], self._weighted(edges)
            found = update.anchorage(self._tree, graph.pointers, self._pointers, vertices, edges)
        if surely or pending.may_float or pending.broken or found != update.ANCHORED:
            self._refuse_floating()
        return vertices, edges

    def _undo(self, substituted: int) -> None:
        """Undo what a transaction did since there were so many substitutions."""
        self._pending.broken = True
        state = self._tree.state
        if state[its.SUBSTITUTED] == substituted:
            with suppress(MemoryError):
                self._estimates()  # what waits still can be solved
        state[its.TAIL_FIRST] = state[its.TAIL_END] = 0  # it is filled anew with the tree
        self._set_estimate(self._kept)
        self._stages.young, self._numbers_current = NONE, True
        incremental.leave(self._tree, self._pending.vertices, self._pending.edges())  # the last: it needs memory

    def _fix_at_estimate(self, vertices: Index) -> None:
        """Remove vertices from the unknowns; they stay at their estimates."""
        self._estimates()
        accept_steps(self._tree, vertices)
        free = vertices[self._tree.vertex[vertices, its.FREE] == 1]
        if len(free):
            self._pending.touch(incremental.leave(self._tree, free, NONE))

    def _set_estimate(self, values: Array) -> None:
        for array in (self._tree.value, self._tree.estimate, self._kept):
            array[: len(values)] = values
        forget(self._tree)

    def _refuse_floating(self) -> None:
        """Raise GaugeError if nothing fixes a part of the problem, with all pending changes."""
        rows = self.graph.rows_by_table(self._in_use())
        check_gauge(
            self.graph, np.flatnonzero(self._inside & ~self._held), np.flatnonzero(self._inside & self._held), rows
        )

    # -- inside: the solution ------------------------------------------------------------------------------------------

    def _integrate(self) -> tuple[int, int, Index, Index]:
        """Solve with all that is pending, within a transaction.

        Returns how many edges were linearised, and how many vertices were solved; then, if edges on these are far from
        their linearisation point (now moved there), the vertices and the edges.
        """
        pending, stages, settings = self._pending, self._stages, self.settings
        due, losses = self._schedule.is_due(settings.relinearize_every), stages.pointers(settings)
        stage, vertices, edges, again = update.CHECK, pending.vertices, pending.new, NONE
        young = stages.of_new(edges, settings)
        if not (self._numbers_current and pending.is_plain()) or len(stages.young):
            stage, vertices, edges, again, young = self._entered(due)
            if stage == update.END:
                return 0, 0, NONE, NONE
        touched, unseen = pending.touched, self._schedule.unseen()
        while True:
            linear = np.union1d(edges, again) if len(again) else edges
            how, what, count, found = update.update(
                self.graph.pointers, self._pointers, stage, due,
                vertices, edges, linear, again, touched, unseen, young, losses, *self._limits(),
            )  # fmt: skip
            if how == update.UNSURE:
                stage, vertices, edges, again, young = self._entered(due)
                continue
            stages.young = young
            if how == DONE:
                break
            stage = update.GROUP
            if how == update.SEARCH:
                stage, again = update.LINEARIZE, self._far_from_linearization()
            elif how == update.IN_PYTHON:
                stage = update.ORDER
                self._linearize(linear)
            elif how == DISSECT:
                touched = np.concatenate((found, dissect(self._tree, what)))
            else:
                touched = found
                self._replace_tree(more_room)
        if what != NOTHING:
            self._refuse_floating()
            raise undetermined(self.graph, what)
        stages.mature(self._tree.value, settings)
        self._solved_with, self._numbers_current = None, True
        if not len(found):
            return len(linear), count, NONE, NONE
        return len(linear), count, found[:count], found[count:]

    def _entered(self, due: int) -> tuple[int, Index, Index, Index, Index]:
        """Let all that is pending enter, of whatever kind it is.

        Returns the stage of the compiled update that comes next (END if there is nothing to do), and what it is called
        with: vertices and edges that entered, edges that are to be linearised again, and young ones.
        """
        pending, stages = self._pending, self._stages
        vertices, edges = self._arriving()
        incremental.enter(self._tree, vertices, edges)
        if not (self._numbers_current or pending.broken or pending.moved):
            self._renumber_after_batch()
        if due == MAYBE and len(edges) and not pending.broken and incremental.reach_back(self._tree, edges):
            due = SURELY
        again = self._far_from_linearization() if due == SURELY else NONE
        if not pending and not len(stages.young) and not len(again):
            return update.END, NONE, NONE, NONE, NONE
        fresh = np.union1d(edges, stages.young) if len(stages.young) else edges
        stages.young = young = stages.of_new(edges, self.settings)
        if pending.broken:
            self._forget_numbers()
            fresh, vertices = self._active(), self._unknowns()
            self._linearize(fresh)
            self._estimates()
            incremental.reset(self._tree, vertices)
            return update.ORDER, vertices, fresh, NONE, young
        if pending.moved:
            self._forget_numbers()
            again = np.setdiff1d(self._active(), fresh)
        return update.LINEARIZE, vertices, fresh, again, young

    def _far_from_linearization(self) -> Index:
        """Search all vertices for large steps, and move their linearisation points; return the edges on them."""
        settings = self.settings
        self._tree.state[its.MOTION_MM] = self._schedule.begin(self.graph)
        if self._pending.broken:
            return NONE
        if self._schedule.is_check_due(self.graph.edge_count, settings):
            edges = self._active()
            self._estimates()
            self._schedule.learn(*neglected(self.graph, self._tree, edges), len(edges))
        tightness = self._schedule.tightness
        above, error = tightness * settings.relinearize_above, tightness**2 * settings.relinearize_error
        return incremental.relinearize_changed(self._pointers, *self._limits()[:2], (above, above, error))

    def _limits(self) -> tuple[float, float, Limits]:
        """The tolerances of steps, and the limits above which a step is far (``substitute``)."""
        return self._schedule.limits(self.graph, self.settings)

    def _relinearized(self, far: Index) -> Iterator[tuple[int, Index]]:
        """Linearise edges that are far, pass after pass; yields how many were, and the vertices that were solved."""
        limits, passes = self._limits(), self.settings.relinearize_passes
        for k in range(passes):
            self._linearize(far)
            failed, solved = incremental.renumber(self._tree, far, *limits)
            if failed != NOTHING:
                raise undetermined(self.graph, failed)
            yield len(far), solved
            if k == passes - 1:
                self._schedule.note(solved)
                return
            far = incremental.relinearize(self._tree, solved, *limits[2:])
            if not len(far):
                return

    def _forget_numbers(self) -> None:
        """Set the sums to zero, because all edges are about to be linearised."""
        self._tree.blocks[:] = 0.0
        self._tree.diagonal[:] = 0.0

    def _restructure(self, vertices: Index, edges: Index) -> None:
        """Order and group what new vertices and edges touch, without numbers."""
        if self._pending.broken:
            vertices = self._unknowns()
            incremental.reset(self._tree, vertices)
        touched, tolerances = self._pending.touched, self._limits()[:2]
        self._replace_tree(lambda tree: restructure(tree, edges, touched, vertices, *tolerances))

    def _renumber_after_batch(self) -> None:
        """Compute the numbers of the tree at the result of a batch. The result stays."""
        self._linearize(self._active())
        failed, _ = incremental.renumber(self._tree, self._active(), np.inf, 0.0, NO_LIMITS)
        if failed != NOTHING:
            self._pending.broken = True
        self._numbers_current = True

    def _information(self, x: Array) -> coo_array:
        """H at the stored values x, over the vertices that are not held, in order of id."""
        free = np.flatnonzero(self._inside & ~self._held)
        losses = self._stages.losses(self.settings)[-1]
        return information(self.graph, x, self.graph.rows_by_table(self._in_use()), free, losses)

    def _linearize(self, edges: Index) -> None:
        """Put the blocks of edges at the linearisation points into the tree."""
        first, *_, last = 2 * self._stages.losses(self.settings)
        linearize_into(self.graph, self._tree, edges, last, self._stages.young, first)

    def _with_covariance(self, ids: ArrayLike) -> Index:
        """Check vertices whose covariance is asked for, and integrate pending changes."""
        self._grow()
        wanted = self._of_problem(ids)
        if not self._held[wanted].all():
            if self._pending:
                self.update()
            elif not self._numbers_current:
                with Transaction(self):
                    incremental.enter(self._tree, NONE, NONE)
                    self._renumber_after_batch()
            if (self._tree.vertex[wanted[~self._held[wanted]], its.CLIQUE] == NOTHING).any():
                raise GraphSlamError("a covariance was asked for within an update")
        return wanted

    @contextmanager
    def _tree_remade_after_error(self) -> Iterator[None]:
        """Mark the tree to be rebuilt at the next update if an error occurs, which leaves scratch in it."""
        try:
            yield
        except BaseException:
            self._pending.broken = True
            raise

    def _continue_batch(self) -> tuple[Index, Index]:
        """Step on from where a batch stopped before the optimum; returns what was solved, and edges that are far."""
        self._unfinished = False
        failed, solved = incremental.renumber(self._tree, self._active(), *self._limits())
        if failed != NOTHING:
            raise undetermined(self.graph, failed)
        self._schedule.hasten(self.settings.relinearize_every)
        return solved, incremental.relinearize(self._tree, solved, *self._limits()[2:])
