"""From edges to whitened blocks: the only place of the solver that looks at an edge type, and only to call it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.graph.graph import EdgeTable
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.lie.jit import kernel
from graph_slam_ros.solver.report import ClassCost
from graph_slam_ros.solver.tree import BLOCK, COUNT, DOF, END, STEP, Tree

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
    """The loss of each label of a graph, by its code, as arrays for the kernels."""

    def __init__(self, graph: Graph, by_label: Mapping[str, Loss]) -> None:
        losses = [by_label.get(label, Loss()) for label in graph.labels]
        self.kind = np.array([loss.kind for loss in losses], dtype=np.int64)
        self.scale = np.array([loss.scale for loss in losses])


@kernel
def _take(rows: Index, vertices: Index, offset: Index, measured: Array) -> tuple[Index, Array]:
    """Where the vertices of some edges begin, and what was measured."""
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
    label: Index,
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
        slope, rho = weight_and_cost(loss_kind[label[row]], loss_scale[label[row]], s)
        chi2[e], cost[e] = s, rho
        factor = np.sqrt(weight[row] * slope)
        for a in range(m):
            residual[e, a] = factor * r[a]
            for c in range(width):
                jacobian[e, a, c] = factor * j[a, c]
    return chi2, cost


def linearize(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], losses: Losses) -> list[Block]:
    """Linearise the given rows of each table at the stored values x, with the loss of each edge's label."""
    blocks = []
    offset = graph.offset.values
    for table, chosen in rows.items():
        at, measured = _take(chosen, table.vertices.values, offset, table.measured.values)
        residual, jacobian = table.type.linearize(x, at, measured)
        chi2, cost = _whiten(
            chosen,
            residual,
            jacobian,
            table.sqrt_information.values,
            table.weight.values,
            table.label.values,
            losses.kind,
            losses.scale,
        )
        blocks.append(Block(table, chosen, residual, jacobian, chi2, cost))
    return blocks


@kernel
def store(t: Tree, rows: Index, ids: Index, residual: Array, jacobian: Array) -> None:
    """Put the shares of whitened edges into the tree: J'J and J'r, and the diagonal of H."""
    vertex, edge, blocks, diagonal = t.vertex, t.edge, t.blocks, t.diagonal
    n, m, width = jacobian.shape
    for k in range(n):
        e = ids[rows[k]]
        block = blocks[edge[e, BLOCK] : edge[e, BLOCK] + width * (width + 1)].reshape(width, width + 1)
        p = 0
        for s in range(edge[e, COUNT]):
            v = edge[e, END + s]
            for i in range(vertex[v, DOF]):
                before = block[p, p]
                for c in range(width):
                    total = 0.0
                    for a in range(m):
                        total += jacobian[k, a, p] * jacobian[k, a, c]
                    block[p, c] = total
                total = 0.0
                for a in range(m):
                    total += jacobian[k, a, p] * residual[k, a]
                block[p, width] = total
                diagonal[vertex[v, STEP] + i] += block[p, p] - before
                p += 1


def rows_of(graph: Graph, edges: Index) -> dict[EdgeTable, Index]:
    """Edges, by id, as rows of their tables."""
    rows = graph.row_of_edge.values[edges]
    if len(graph.tables) == 1:
        return dict.fromkeys(graph.tables.values(), rows)
    codes = graph.table_of_edge.values[edges]
    return {table: rows[codes == code] for code, table in enumerate(graph.tables.values()) if (codes == code).any()}


def total(blocks: list[Block]) -> tuple[float, float]:
    """(chi2, cost) of all edges."""
    return float(sum(b.chi2.sum() for b in blocks)), float(sum(b.cost.sum() for b in blocks))


def refuse_nonfinite(blocks: list[Block]) -> None:
    """Raise where numbers are so large that a cost overflows, naming the first such edge."""
    for b in blocks:
        bad = np.flatnonzero(~np.isfinite(b.cost))
        if len(bad):
            row = b.rows[bad[0]]
            raise GraphSlamError(
                f"edge {int(b.table.id.values[row])} ({b.table.type.name}) between vertices"
                f" {b.table.vertices.values[row].tolist()}: its chi2 is not finite"
            )


def by_class(graph: Graph, blocks: list[Block]) -> dict[str, ClassCost]:
    """chi2 and number of edges of each label."""
    count, chi2 = np.zeros(len(graph.labels), dtype=np.int64), np.zeros(len(graph.labels))
    for b in blocks:
        label = b.table.label.values[b.rows]
        np.add.at(count, label, 1)
        np.add.at(chi2, label, b.chi2)
    return {name: ClassCost(int(count[k]), float(chi2[k])) for k, name in enumerate(graph.labels) if count[k]}
