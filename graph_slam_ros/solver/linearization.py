"""Linearisation of edges to whitened blocks: only here the solver uses an edge type, and only calls it."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TypeAlias

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import EdgeType, Graph, Loss, records
from graph_slam_ros.graph.native import native_address
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.lie.addresses import address_of
from graph_slam_ros.solver.blocks import (
    CHUNK,
    evaluate,
    gather,
    squares,
    store_linearized,
    whiten,
    whiten_and_store,
)
from graph_slam_ros.solver.clique_tree.storage import NOTHING, Tree
from graph_slam_ros.solver.report import ClassCost
from graph_slam_ros.typing import Array, Index

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
        self.pointers = np.array([address_of(self.kind), address_of(self.scale), len(losses), self._sources])

    def codes(self, table: EdgeTable, rows: Index) -> Index:
        """Return the indices (n,) of the losses of some edges in ``kind`` and ``scale``."""
        label: Index = table.label.values[rows]
        return label * self._sources + table.source.values[rows] if self._sources else label


def linearize(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], losses: Losses) -> Iterator[Block]:
    """Linearise the given rows of each table at the stored values x, with the loss of each edge.

    Blocks come some hundred edges at a time: arrays of that size stay in the cache and in the process.
    """
    for table, chosen in rows.items():
        for first in range(0, len(chosen), CHUNK):
            some = chosen[first : first + CHUNK]
            residual, jacobian = given = _evaluate(graph, x, table, some)
            chi2, cost = whiten(some, *given, *_weights(table, some, losses))
            yield Block(table, some, residual, jacobian, chi2, cost)


def _evaluate(graph: Graph, x: Array, table: EdgeTable, rows: Index) -> tuple[Array, Array]:
    """Return residuals (n, m) and Jacobians (n, m, width) of rows of a table at the stored values x."""
    at, measured = gather(rows, table.vertices.values, graph.offset.values, table.measured.values)
    return table.type.linearize(x, at, measured)


def _weights(table: EdgeTable, rows: Index, losses: Losses) -> tuple[Array, Array, Index, Index, Array]:
    """Return root information and weight by row, the loss of each given row, and kinds and scales of all losses."""
    of_each = losses.codes(table, rows)
    return table.sqrt_information.values, table.weight.values, of_each, losses.kind, losses.scale


def linearize_into(
    pointers: Index, graph: Graph, tree: Tree, edges: Index, losses: Losses, young: Index, first: Losses
) -> None:
    """Linearise edges at the linearisation points of the tree, and put them into it; the pointers are the tree's.

    Parameters
    ----------
    young, first : those of the edges whose loss is not of ``losses`` but of these

    Raises
    ------
    GraphSlamError
        The cost of an edge is not finite.
    """
    code, row = store_linearized(graph.pointers, pointers, edges, losses.pointers, young, first.pointers)
    if code == NOTHING:
        return
    if row != NOTHING:
        _refuse_row(list(graph.tables.values())[code], row)
    known = np.sort(young)  # not all edge types are compiled: one after the other
    is_young = np.isin(edges, known)
    for some, of_some in ((edges[is_young], first), (edges[~is_young], losses)):
        for table, chosen in rows_of(graph, some).items():
            for begin in range(0, len(chosen), CHUNK):
                rows = chosen[begin : begin + CHUNK]
                given = _evaluate(graph, tree.value, table, rows)
                bad = whiten_and_store(tree, table.pointers, rows, *given, of_some.pointers)
                if bad != NOTHING:
                    _refuse_row(table, bad)
            table.pointers[records.LINEARIZE] = native_address(table.type.linearize)


def linearized(graph: Graph, x: Array, edge: EdgeType, vertices: Sequence[int], measured: Array) -> tuple[Array, Array]:
    """Residual (m,) and Jacobian (m, width) of one measurement (p,) between vertices (k,) at the stored values x."""
    residual, jacobian = edge.linearize(x, graph.offset.values[list(vertices)][None], measured[None])
    return residual[0], jacobian[0]


def evaluated(graph: Graph, x: Array, edges: Index) -> tuple[Array, Array, Index]:
    """Evaluate edges at the stored values x.

    Returns
    -------
    Residuals, not whitened, end to end; squared whitened residuals (n,), without loss and weight; the numbers (n,) of
    each residual.
    """
    code, residual, chi2, numbers = evaluate(graph.pointers, x, graph.vertex_count, edges)
    return (residual, chi2, numbers) if code == NOTHING else _evaluated_by_table(graph, x, edges)


def _evaluated_by_table(graph: Graph, x: Array, edges: Index) -> tuple[Array, Array, Index]:
    """The same where not all edge types are compiled, or some were never called."""
    chi2, numbers, out = np.empty(len(edges)), np.empty(len(edges), dtype=np.int64), [np.empty(0)] * len(edges)
    codes = graph.table_of_edge.values[edges]
    for code, table in enumerate(graph.tables.values()):
        of_table = np.flatnonzero(codes == code)
        for first in range(0, len(of_table), CHUNK):
            some = of_table[first : first + CHUNK]
            rows = graph.row_of_edge.values[edges[some]]
            residual, _ = _evaluate(graph, x, table, rows)
            chi2[some], numbers[some] = squares(table.sqrt_information.values, rows, residual), residual.shape[1]
            for k, of_one in zip(some.tolist(), residual, strict=True):
                out[k] = of_one
        if len(of_table):
            table.pointers[records.LINEARIZE] = native_address(table.type.linearize)
    return np.concatenate((np.empty(0), *out)), chi2, numbers


def chi2_of(graph: Graph, x: Array, edges: Index) -> tuple[Array, Index]:
    """Squared whitened residual of each edge at the stored values x, without loss and weight, and its numbers."""
    _, chi2, numbers = evaluated(graph, x, edges)
    return chi2, numbers


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
