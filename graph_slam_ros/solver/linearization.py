"""Linearisation of edges to whitened blocks: only here the solver uses an edge type, and only calls it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TypeAlias

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import EdgeType, Graph, Loss
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.clique_tree.numeric import add_to_diagonal, clear_block
from graph_slam_ros.solver.clique_tree.pointers import tree_of
from graph_slam_ros.solver.clique_tree.storage import BLOCK, NOTHING, Tree
from graph_slam_ros.solver.report import ClassCost
from graph_slam_ros.typing import Array, Index

CHUNK = 512  # edges
LossKey: TypeAlias = str | tuple[str, str]


@dataclass(frozen=True, slots=True)
class Block:
    """Edges of one type, linearised, whitened and weighted.

    Attributes
    ----------
    residual : (n, m); jacobian : (n, m, D)
    chi2, cost : (n,) of each edge, without and with its loss
    """

    table: EdgeTable
    rows: Index
    residual: Array
    jacobian: Array
    chi2: Array
    cost: Array


class Losses:
    """The loss of each edge of a graph, as arrays for the kernels: by label or, where one is given, label and source.

    Parameters
    ----------
    given : by label, or by (label, source), which comes first; edges without one have none
    """

    def __init__(self, graph: Graph, given: Mapping[LossKey, Loss]) -> None:
        sources = graph.sources if any(isinstance(key, tuple) for key in given) else [""]
        pairs = [(label, source) for label in graph.labels for source in sources]
        losses = [given.get(pair) or given.get(pair[0]) or Loss() for pair in pairs]
        self.kind = np.array([loss.kind for loss in losses], dtype=np.int64)
        self.scale = np.array([loss.scale for loss in losses])
        self._sources = len(sources) if sources != [""] else 0

    def codes(self, table: EdgeTable, rows: Index) -> Index:
        """Return the indices (n,) of the losses of some edges in ``kind`` and ``scale``."""
        label: Index = table.label.values[rows]
        return label * self._sources + table.source.values[rows] if self._sources else label


@kernel
def _gather(rows: Index, vertices: Index, offset: Index, measured: Array) -> tuple[Index, Array]:
    """Return offsets (n, k) of the vertices of some edges, and their measurements (n, p)."""
    n, ends = len(rows), vertices.shape[1]
    at, z = np.empty((n, ends), np.int64), np.empty((n, measured.shape[1]))
    for k in range(n):
        for s in range(ends):
            at[k, s] = offset[vertices[rows[k], s]]
        for c in range(measured.shape[1]):
            z[k, c] = measured[rows[k], c]
    return at, z


@kernel
def _whiten(
    rows: Index,
    residual: Array,
    jacobian: Array,
    sqrt_information: Array,
    weight: Array,
    loss: Index,
    loss_kind: Index,
    loss_scale: Array,
) -> tuple[Array, Array]:
    """Multiply residuals and Jacobians by sqrt(weight * rho') R in place; returns chi2 and cost of each edge."""
    n, m, width = jacobian.shape
    chi2, cost = np.zeros(n), np.zeros(n)
    r, j = np.zeros(m), np.zeros((m, width))
    for e in range(n):
        row = rows[e]
        s = 0.0
        for a in range(m):
            r[a] = 0.0
            for c in range(width):
                j[a, c] = 0.0
            for b in range(m):
                root = sqrt_information[row, a, b]
                r[a] += root * residual[e, b]
                for c in range(width):
                    j[a, c] += root * jacobian[e, b, c]
            s += r[a] * r[a]
        s *= weight[row]
        slope, rho = weight_and_cost(loss_kind[loss[e]], loss_scale[loss[e]], s)
        chi2[e], cost[e] = s, rho
        factor = np.sqrt(weight[row] * slope)
        for a in range(m):
            residual[e, a] = factor * r[a]
            for c in range(width):
                jacobian[e, a, c] = factor * j[a, c]
    return chi2, cost


def linearize(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], losses: Losses) -> Iterator[Block]:
    """Linearise the given rows of each table at the stored values x, with the loss of each edge.

    Blocks come some hundred edges at a time: arrays of that size stay in the cache and in the process.
    """
    for table, chosen in rows.items():
        for first in range(0, len(chosen), CHUNK):
            some = chosen[first : first + CHUNK]
            residual, jacobian = given = _evaluate(graph, x, table, some)
            chi2, cost = _whiten(some, *given, *_weights(table, some, losses))
            yield Block(table, some, residual, jacobian, chi2, cost)


def _evaluate(graph: Graph, x: Array, table: EdgeTable, rows: Index) -> tuple[Array, Array]:
    """Return residuals (n, m) and Jacobians (n, m, width) of rows of a table at the stored values x."""
    at, measured = _gather(rows, table.vertices.values, graph.offset.values, table.measured.values)
    return table.type.linearize(x, at, measured)


def _weights(table: EdgeTable, rows: Index, losses: Losses) -> tuple[Array, Array, Index, Index, Array]:
    """Return root information and weight by row, the loss of each given row, and kinds and scales of all losses."""
    of_each = losses.codes(table, rows)
    return table.sqrt_information.values, table.weight.values, of_each, losses.kind, losses.scale


def linearize_into(pointers: Index, graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], losses: Losses) -> None:
    """Linearise rows of tables at the stored values x, and put them into the tree (``pointers_of``).

    Raises
    ------
    GraphSlamError
        The cost of an edge is not finite.
    """
    for table, chosen in rows.items():
        for first in range(0, len(chosen), CHUNK):
            some = chosen[first : first + CHUNK] if len(chosen) > CHUNK else chosen
            given = *_evaluate(graph, x, table, some), *_weights(table, some, losses)
            bad = _whiten_and_store(pointers, table.id.values, some, *given)
            if bad != NOTHING:
                _refuse_row(table, bad)


def linearized(graph: Graph, x: Array, edge: EdgeType, vertices: Sequence[int], measured: Array) -> tuple[Array, Array]:
    """Residual (m,) and Jacobian (m, width) of one measurement (p,) between vertices (k,) at the stored values x."""
    residual, jacobian = edge.linearize(x, graph.offset.values[list(vertices)][None], measured[None])
    return residual[0], jacobian[0]


def residuals_of(graph: Graph, x: Array, edges: Index) -> Iterator[tuple[Index, Array, Array]]:
    """Places among these edges, their residuals (n, m) at the stored values x, and square root informations."""
    codes = graph.table_of_edge.values[edges]
    for code, table in enumerate(graph.tables.values()):
        of_table = np.flatnonzero(codes == code)
        for first in range(0, len(of_table), CHUNK):
            some = of_table[first : first + CHUNK]
            rows = graph.row_of_edge.values[edges[some]]
            residual, _ = _evaluate(graph, x, table, rows)
            yield some, residual, table.sqrt_information.values[rows]


def chi2_of(graph: Graph, x: Array, edges: Index) -> tuple[Array, Index]:
    """Squared whitened residual of each edge at the stored values x, without loss and weight, and its numbers."""
    chi2, numbers = np.empty(len(edges)), np.empty(len(edges), dtype=np.int64)
    for some, residual, root in residuals_of(graph, x, edges):
        chi2[some], numbers[some] = _squares(root, residual), residual.shape[1]
    return chi2, numbers


@kernel
def _squares(root: Array, residual: Array) -> Array:
    """Return the squared whitened residual of each edge."""
    n, m = residual.shape
    out = np.zeros(n)
    for e in range(n):
        for a in range(m):
            white = 0.0
            for b in range(m):
                white += root[e, a, b] * residual[e, b]
            out[e] += white * white
    return out


@kernel
def store(t: Tree, rows: Index, ids: Index, residual: Array, jacobian: Array) -> None:
    """Put whitened edges into the tree: J'J and J'r, and the diagonal of H, instead of what they had there."""
    vertex, edge, link, blocks, diagonal = t.vertex, t.edge, t.link, t.blocks, t.diagonal
    for k in range(len(rows)):
        clear_block(vertex, edge, link, ids[rows[k]], blocks, diagonal)
    store_first(t, rows, ids, residual, jacobian)


@kernel
def store_first(t: Tree, rows: Index, ids: Index, residual: Array, jacobian: Array) -> None:
    """Put whitened edges into the tree that have nothing there yet."""
    vertex, edge, link, blocks, diagonal = t.vertex, t.edge, t.link, t.blocks, t.diagonal
    n, m, width = jacobian.shape
    for k in range(n):
        e = ids[rows[k]]
        at = edge[e, BLOCK]
        for p in range(width):
            if m == 2:  # the usual sizes by themselves: short loops take most of the time
                x, y = jacobian[k, 0, p], jacobian[k, 1, p]
                for c in range(width):
                    blocks[at + c] = x * jacobian[k, 0, c] + y * jacobian[k, 1, c]
                blocks[at + width] = x * residual[k, 0] + y * residual[k, 1]
            elif m == 3:
                x, y, z = jacobian[k, 0, p], jacobian[k, 1, p], jacobian[k, 2, p]
                for c in range(width):
                    blocks[at + c] = x * jacobian[k, 0, c] + y * jacobian[k, 1, c] + z * jacobian[k, 2, c]
                blocks[at + width] = x * residual[k, 0] + y * residual[k, 1] + z * residual[k, 2]
            else:
                blocks[at : at + width + 1] = 0.0
                for a in range(m):
                    x = jacobian[k, a, p]
                    for c in range(width):
                        blocks[at + c] += x * jacobian[k, a, c]
                    blocks[at + width] += x * residual[k, a]
            at += width + 1
        add_to_diagonal(vertex, edge, link, e, blocks, diagonal)


@kernel
def _whiten_and_store(
    pointers: Index,
    ids: Index,
    rows: Index,
    residual: Array,
    jacobian: Array,
    sqrt_information: Array,
    weight: Array,
    loss: Index,
    loss_kind: Index,
    loss_scale: Array,
) -> int:
    """Whiten edges and add them to the tree; or add none, and return the row of one whose cost is not finite."""
    _, cost = _whiten(rows, residual, jacobian, sqrt_information, weight, loss, loss_kind, loss_scale)
    total, worst = 0.0, 0
    for k in range(len(cost)):
        total += cost[k]
        if not np.isfinite(cost[k]):
            return rows[k]
        if cost[k] > cost[worst]:
            worst = k
    if not np.isfinite(total):
        return rows[worst]
    store(tree_of(pointers), rows, ids, residual, jacobian)
    return NOTHING


def information(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], free: Index, losses: Losses) -> Array:
    """H as a dense matrix over some vertices, in this order."""
    dof = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)[graph.kind.values[free]]
    size, first = int(dof.sum()), np.full(graph.vertex_count, -1)
    first[free] = np.cumsum(dof) - dof
    out = np.zeros((size + 1, size + 1))  # the last row and column are for all other vertices
    for b in linearize(graph, x, rows, losses):
        slots = np.repeat(np.arange(len(b.table.type.dofs)), b.table.type.dofs)
        within = np.concatenate([np.arange(d) for d in b.table.type.dofs])
        begins = first[b.table.vertices.values[b.rows]][:, slots]
        at = np.where(begins < 0, size, begins + within)
        np.add.at(out, (at[:, :, None], at[:, None, :]), np.swapaxes(b.jacobian, 1, 2) @ b.jacobian)
    return out[:size, :size]


def rows_of(graph: Graph, edges: Index) -> dict[EdgeTable, Index]:
    """Edges, by id, as rows of their tables."""
    rows = graph.row_of_edge.values[edges]
    if len(edges) == 1:
        return {graph.row(edges[0])[0]: rows}
    if len(graph.tables) == 1:
        return dict.fromkeys(graph.tables.values(), rows)
    codes = graph.table_of_edge.values[edges]
    by_table = ((table, rows[codes == code]) for code, table in enumerate(graph.tables.values()))
    return {table: of_table for table, of_table in by_table if len(of_table)}


def refuse_nonfinite(block: Block) -> None:
    """Raise GraphSlamError if numbers are so large that a cost overflows; it names the first such edge."""
    if isfinite(block.cost[0] if len(block.cost) == 1 else block.cost.sum()):
        return
    bad = np.flatnonzero(~np.isfinite(block.cost))
    _refuse_row(block.table, block.rows[bad[0] if len(bad) else int(block.cost.argmax())])


def _refuse_row(table: EdgeTable, row: int) -> None:
    """Raise GraphSlamError for an edge whose cost is not finite."""
    raise GraphSlamError(
        f"edge {int(table.id.values[row])} ({table.type.name}) between vertices"
        f" {table.vertices.values[row].tolist()}: its chi2 is not finite"
    )


@dataclass(slots=True)
class Costs:
    """Sums over edges: chi2 without and cost with their losses, and chi2 and numbers by label."""

    chi2: float
    cost: float
    classes: dict[str, ClassCost]


def costs(graph: Graph, blocks: Iterable[Block]) -> Costs:
    """Add up the costs of linearised edges."""
    count, residuals = np.zeros((2, len(graph.labels)), dtype=np.int64)
    chi2, cost = np.zeros(len(graph.labels)), 0.0
    for b in blocks:
        label = b.table.label.values[b.rows]
        edges = np.bincount(label, minlength=len(count))
        count += edges
        residuals += b.table.type.residual_size * edges
        chi2 += np.bincount(label, b.chi2, minlength=len(count))
        cost += float(b.cost.sum())
    classes = {
        name: ClassCost(int(count[k]), float(chi2[k]), int(residuals[k]))
        for k, name in enumerate(graph.labels)
        if count[k]
    }
    return Costs(float(chi2.sum()), cost, classes)
