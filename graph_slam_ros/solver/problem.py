"""The problem: which vertices and edges of a graph are solved for, and the edits that the next update integrates."""

from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.graph import whole_numbers
from graph_slam_ros.graph.records import weights_of
from graph_slam_ros.graph.retraction import code_of
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver.batch import Settings
from graph_slam_ros.solver.clique_tree import incremental
from graph_slam_ros.solver.clique_tree.numeric import accept_steps
from graph_slam_ros.solver.clique_tree.ordering import ends_of
from graph_slam_ros.solver.clique_tree.pointers import SHAPE_COLUMNS, pointers_of
from graph_slam_ros.solver.clique_tree.pools import compact
from graph_slam_ros.solver.clique_tree.storage import (
    ACTIVE,
    CLIQUES,
    DEFERRED_COUNT,
    FREE,
    STALE_COUNT,
    SUBSTITUTED,
    TAIL_END,
    TAIL_FIRST,
    empty_tree,
    longer,
    with_room,
)
from graph_slam_ros.solver.clique_tree.substitution import forget, show_all
from graph_slam_ros.solver.entry import (
    ANCHORED,
    LEFT_OUT,
    NO_ROOM,
    RECORDED,
    UNFIT_EDGE,
    UNFIT_VERTEX,
    anchorage,
    record,
)
from graph_slam_ros.solver.gauge import check_gauge, degrees_of_freedom, fix_the_whole
from graph_slam_ros.solver.linearization import chi2_of, evaluated, rows_of
from graph_slam_ros.solver.pending import NONE, PendingChanges
from graph_slam_ros.typing import Array, Index


class Problem:
    """The vertices and edges of a graph that are solved for, the held vertices, and the edits since the last update.

    Edits are pending until an update integrates them. An update that fails leaves them pending.
    """

    def __init__(self, graph: Graph, settings: Settings | None = None) -> None:
        self.graph = graph
        self.settings = settings or Settings()
        self._tree = empty_tree()
        self._shapes = np.zeros((0, SHAPE_COLUMNS), dtype=np.int64)  # of the graph's kinds
        self._room = 0, 0, 0  # for vertices, their numbers, and edges
        self._vertices = 0  # of the graph, that have a record in the tree
        self._inside = np.zeros(0, dtype=bool)  # vertices of the problem
        self._held = np.zeros(0, dtype=bool)
        self._edge_inside = np.zeros(0, dtype=bool)  # edges of the problem
        self._pending = PendingChanges()
        self._kept = np.zeros(0)  # the estimate that the last call left, of what was read since it changed
        self._locate()

    def add(self, vertices: ArrayLike, edges: ArrayLike) -> None:
        """Add vertices (at their initial values) and edges of the graph to the problem, by id, each once."""
        new, new_edges = whole_numbers(vertices, "vertex").ravel(), whole_numbers(edges, "edge").ravel()
        self._pending.broken |= self._record(new, new_edges)  # removed before: they are in the order still
        self._pending.add(new, new_edges)
        self._inside[new], self._edge_inside[new_edges] = True, True

    def start_at(self, values: Array) -> None:
        """Start from other values than the graph's initial ones: the stored numbers of all vertices in one array."""
        self._grow()
        size = len(self.graph.initial)
        if values.shape != (size,) or not np.isfinite(values).all():
            raise GraphSlamError(f"start: expected {size} finite numbers, got an array {values.shape}")
        self._set_estimate(values)
        self._pending.moved |= bool(self._tree.state[CLIQUES])

    def place(self, vertex: int, value: ArrayLike) -> None:
        """Start a vertex that is not in the problem yet from another value than the graph's initial one."""
        self._grow()
        existing([vertex], self._vertices, "vertex")
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
        """Multiply the information of an edge; 0 removes it from the structure, another value adds it again."""
        if not (np.isfinite(weight) and weight >= 0.0):
            raise GraphSlamError(f"edge {edge}: weight {weight} is not a finite number >= 0")
        self._grow()
        one = existing([edge], self.graph.edge_count, "edge")
        table, row = self.graph.row(edge)
        ends = table.vertices.values[row]
        if weight and self._edge_inside[edge] and not self._inside[ends].all():
            raise GraphSlamError(f"edge {edge} needs vertex {int(ends[~self._inside[ends]][0])}, which was removed")
        table.weight.values[row] = weight
        if not self._edge_inside[edge]:
            return
        if weight:
            self._pending.again(one)
        elif self._tree.edge[edge, ACTIVE]:
            self._pending.touch(ends)
            self._pending.may_float = True
            incremental.deactivate(self._tree, one)

    def leave_out(self, edges: ArrayLike) -> None:
        """Set the weight of edges to 0, as ``set_weight`` does one by one."""
        self._grow()
        ids = existing(edges, self.graph.edge_count, "edge")
        self.graph.set_weights(ids, 0.0)
        active = ids[self._edge_inside[ids] & (self._tree.edge[ids, ACTIVE] == 1)]
        if len(active):
            self._pending.touch(ends_of(self._tree, active))
            self._pending.may_float = True
            incremental.deactivate(self._tree, active)

    def hold(self, vertex: int) -> None:
        """Keep a vertex at its present estimate."""
        self._grow()
        one = existing([vertex], self._vertices, "vertex")
        self._held[vertex] = True
        if self._tree.vertex[vertex, FREE]:
            on_it = incremental.edges_of(self._tree.vertex, self._tree.link, vertex)
            on_it = on_it[self._tree.edge[on_it, ACTIVE] == 1]  # they are linearised where it is held
            self._pending.again(on_it)
            self._fix_at_estimate(one)

    @property
    def held(self) -> Index:
        """Ids of the vertices that stay at their values."""
        return np.flatnonzero(self._held)

    def has(self, vertex: int) -> bool:
        """Return whether a vertex is part of the problem."""
        return vertex < len(self._inside) and bool(self._inside[vertex])

    def is_held(self, vertex: int) -> bool:
        """Return whether a vertex stays at its value."""
        return vertex < len(self._held) and bool(self._held[vertex])

    def remove(self, vertices: ArrayLike) -> None:
        """Remove vertices from the problem; all their edges must have weight 0 before."""
        self._grow()
        ids = existing(vertices, self._vertices, "vertex")
        if not self._inside[ids].all():
            raise GraphSlamError(f"vertex {int(ids[~self._inside[ids]][0])} is not in the problem")
        for vertex in ids.tolist():
            needed = self._weighted(incremental.edges_of(self._tree.vertex, self._tree.link, vertex))
            if len(needed):
                raise GraphSlamError(f"vertex {vertex} is needed by edge {int(needed[0])}")
        self._inside[ids] = self._held[ids] = False
        self._pending.forget(ids)
        self._fix_at_estimate(ids)

    def edges_on(self, vertex: int) -> Index:
        """Ids of the edges of the problem on one vertex, also those of weight 0."""
        self._grow()
        existing([vertex], self._vertices, "vertex")
        return incremental.edges_of(self._tree.vertex, self._tree.link, vertex)

    @property
    def vertices(self) -> Index:
        """Ids of the vertices of the problem."""
        self._grow()
        return np.flatnonzero(self._inside)

    @property
    def degrees_of_freedom(self) -> int:
        """The measured numbers, without edges of weight 0, less the estimated numbers, also those of a frozen map."""
        self._grow()
        return degrees_of_freedom(self.graph, self._unknowns(), self._held[: self.graph.vertex_count])

    @property
    def edges(self) -> Index:
        """Ids of the edges of the problem that have a weight."""
        self._grow()
        return self._weighted(np.flatnonzero(self._edge_inside))

    def is_fixed(self) -> bool:
        """Return whether a held vertex, or the edges on one vertex alone, fix position and heading of the whole."""
        self._grow()
        if (self._inside & self._held).any():
            return True
        rows = rows_of(self.graph, self.edges)
        return fix_the_whole(self.graph, self._estimates(), rows)

    @property
    def values(self) -> Array:
        """The estimates of all vertices, in the layout of ``Graph.initial``; ``start_at`` accepts them."""
        self._grow()
        return self._estimates()[: len(self.graph.initial)].copy()

    def chi2_of(self, edges: ArrayLike) -> tuple[Array, Index]:
        """Chi2 of each edge at the estimate: r' Omega r without loss and weight, and the size of r."""
        self._grow()
        ids = whole_numbers(edges, "edge").ravel()
        if len(ids):
            existing(ids, self.graph.edge_count, "edge")
        return chi2_of(self.graph, self._estimates(), ids)

    def residuals_of(self, edges: ArrayLike) -> Array:
        """Residuals of edges at the estimate, not whitened, in the units of their types, end to end."""
        self._grow()
        return evaluated(self.graph, self._estimates(), existing(edges, self.graph.edge_count, "edge"))[0]

    def compact(self) -> None:
        """Move the fronts in use together in memory; memory is not returned to the system.

        The solver does so itself before it asks for more memory.
        """
        compact(self._tree)

    # -- for the solution --------------------------------------------------------------------------------------------

    def _estimates(self) -> Array:
        """Return the estimates of all vertices, none of them waiting; they stay the tree's."""
        state = self._tree.state
        if state[STALE_COUNT] or state[DEFERRED_COUNT]:
            show_all(self._tree, self._kept, self.settings.tolerance, self.settings.tolerance_sigmas)
        return self._tree.estimate

    def _grow(self) -> None:
        """Follow the graph's growth: new vertices start at their initial values."""
        graph = self.graph
        if graph.kind.count > self._vertices or graph.row_of_edge.count > self._room[2]:
            self._record(NONE, NONE)

    def _record(self, new: Index, new_edges: Index) -> bool:
        """Follow the graph's growth, and record what is added to the problem; nothing where some of it is unfit.

        Returns whether one of the vertices is in the order of the tree still.
        """
        graph = self.graph
        now = graph.kind.count, graph.initial.count, graph.row_of_edge.count
        room = self._room
        if now[0] > room[0] or now[1] > room[1] or now[2] > room[2] or len(self._shapes) != len(graph.kinds):
            self._follow(*now)
        how, what, blocks = record(graph.pointers, self._pointers, (self._vertices, *now), new, new_edges)
        while how == NO_ROOM:
            self._make_room(link=what, blocks=blocks)
            how, what, blocks = record(graph.pointers, self._pointers, (self._vertices, *now), new, new_edges)
        self._vertices = now[0]
        if how == RECORDED:
            return bool(what)
        if how == UNFIT_VERTEX:
            _refuse_unfit(new, what, self._vertices, "vertex")
        if how == UNFIT_EDGE:
            _refuse_unfit(new_edges, what, graph.edge_count, "edge")
        raise GraphSlamError(f"an edge needs vertex {what}, which was not added")

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

    def _make_room(self, **lengths: int) -> None:
        """Let arrays of the tree have at least so many rows."""
        try:
            self._tree = with_room(self._tree, **lengths)
        finally:  # some may have grown in place
            self._locate()

    def _unknowns(self) -> Index:
        return np.flatnonzero(self._tree.vertex[: self._vertices, FREE])

    def _active(self) -> Index:
        return np.flatnonzero(self._tree.edge[:, ACTIVE])

    def _active_rows(self) -> dict[EdgeTable, Index]:
        return rows_of(self.graph, self._active())

    def _weighted(self, edges: Index) -> Index:
        """The edges among these that have a weight."""
        has_weight = weights_of(self.graph.pointers, edges) != 0.0
        return edges if np.count_nonzero(has_weight) == len(edges) else edges[has_weight]

    def _arriving(self, *, surely: bool = False) -> tuple[Index, Index]:
        """Return the unknowns and edges that enter the problem; nothing is changed.

        Raises
        ------
        GaugeError
            Nothing would fix a part of the problem. This is checked if it may be so, or if ``surely``.
        """
        self._grow()
        pending, graph = self._pending, self.graph
        vertices, edges = pending.vertices, pending.edges()
        found = anchorage(graph.pointers, self._pointers, vertices, edges)
        if found == LEFT_OUT:
            vertices, edges = vertices[self._inside[vertices] & ~self._held[vertices]], self._weighted(edges)
            found = anchorage(graph.pointers, self._pointers, vertices, edges)
        if surely or pending.may_float or pending.broken or found != ANCHORED:
            self._refuse_floating()
        return vertices, edges

    def _undo(self, substituted: int) -> None:
        """Undo what a transaction did since there were so many substitutions."""
        self._pending.broken = True
        state = self._tree.state
        if state[SUBSTITUTED] == substituted:
            with suppress(MemoryError):
                self._estimates()  # what waits still can be solved
        state[TAIL_FIRST] = state[TAIL_END] = 0  # it is filled anew with the tree
        self._set_estimate(self._kept)
        self._after_error()
        incremental.leave(self._tree, self._pending.vertices, self._pending.edges())  # the last: it needs memory

    def _after_error(self) -> None:
        """Undo what a solution keeps besides."""

    def _fix_at_estimate(self, vertices: Index) -> None:
        """Remove vertices from the unknowns; they stay at their estimates."""
        self._estimates()
        accept_steps(self._tree, vertices)
        free = vertices[self._tree.vertex[vertices, FREE] == 1]
        if len(free):
            self._pending.touch(incremental.leave(self._tree, free, NONE))

    def _set_estimate(self, values: Array) -> None:
        for array in (self._tree.value, self._tree.estimate, self._kept):
            array[: len(values)] = values
        forget(self._tree)

    def _refuse_floating(self) -> None:
        """Raise GaugeError if nothing fixes a part of the problem, with all pending changes."""
        rows = rows_of(self.graph, self.edges)
        check_gauge(
            self.graph, np.flatnonzero(self._inside & ~self._held), np.flatnonzero(self._inside & self._held), rows
        )


def existing(ids: ArrayLike, count: int, what: str) -> Index:
    """Ids as an array; raises GraphSlamError for one that is not below ``count``."""
    at = whole_numbers(ids, what).ravel()
    strange = (at < 0) | (at >= count)
    if np.count_nonzero(strange):
        raise GraphSlamError(f"{what} {int(at[strange][0])} does not exist")
    return at


def _refuse_unfit(ids: Index, unfit: int, count: int, what: str) -> None:
    """Raise GraphSlamError for an id that does not exist, is in the problem already or is repeated."""
    existing(ids[unfit], count, what)
    raise GraphSlamError(f"{what} {int(ids[unfit])} was added before")
