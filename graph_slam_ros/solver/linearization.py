"""Linearisation of edges to whitened blocks: only here the solver uses an edge type, and only calls it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
from scipy.sparse import coo_array

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import EdgeType, Graph, Loss, records
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.records import address_of, call_native, integers, native_address, reals, table_at
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.numeric import add_to_diagonal, clear_block
from graph_slam_ros.solver.clique_tree.storage import BLOCK, MARKED, NOTHING, ZERO, Tree, row_of
from graph_slam_ros.solver.settings import LossKey
from graph_slam_ros.typing import Array, Index

CHUNK = 512  # edges that are linearised together: arrays of that size stay in the cache and in the process


@kernel
def gather(rows: Index, vertices: Index, offset: Index, measured: Array) -> tuple[Index, Array]:
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
def whiten(
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
    both, white = np.empty((2, n)), np.empty((width + 1) * m)  # to allocate one takes as long as an edge
    chi2, cost, r, j = both[0], both[1], white[:m], white[m:].reshape(m, width)
    for e in range(n):
        row = rows[e]
        s = 0.0
        for a in range(m):
            r[a] = 0.0
            for c in range(width):
                j[a, c] = 0.0
            for b in range(m):
                root = sqrt_information[row, a, b]
                if root == 0.0:  # half of a triangle, and more where components are independent
                    continue
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


@kernel
def loss_weights(kind: int, scale: float, chi2: Array) -> Array:
    """Return the weights rho'(s) (n,) that one loss gives to squared residuals."""
    out = np.empty(len(chi2))
    for k in range(len(chi2)):
        out[k], _ = weight_and_cost(kind, scale, chi2[k])
    return out


@kernel
def squares(root: Array, rows: Index, residual: Array) -> Array:
    """Return the squared whitened residual of each edge, without its weight; ``root`` is of the whole table."""
    n, m = residual.shape
    out = np.zeros(n)
    for e in range(n):
        for a in range(m):
            white = 0.0
            for b in range(m):
                white += root[rows[e], a, b] * residual[e, b]
            out[e] += white * white
    return out


@kernel
def evaluate(graph: Index, values: Array, vertices: int, edges: Index) -> tuple[int, Array, Array, Index]:
    """Evaluate edges at stored values.

    Parameters
    ----------
    vertices : how many the graph has

    Returns
    -------
    NOTHING, or the table of an edge that is not compiled, and then the rest is empty; residuals, end to end; chi2 (n,)
    without loss and weight; and the numbers (n,) of each residual.
    """
    room, n = graph[records.EDGE_ROOM], len(edges)
    table_of, row_of = integers(graph[records.TABLE_OF_EDGE], room), integers(graph[records.ROW_OF_EDGE], room)
    offset = integers(graph[records.OFFSET], vertices)
    chi2, numbers, begin, total = np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64), ZERO
    many = np.zeros(len(graph) - records.TABLES, np.int64)
    for k in range(n):
        table = table_at(graph, table_of[edges[k]])
        if table[records.LINEARIZE] == 0:
            return table_of[edges[k]], chi2[:0], chi2[:0], numbers[:0]
        numbers[k], begin[k] = table[records.RESIDUAL_SIZE], total
        total += numbers[k]
        many[table_of[edges[k]]] += 1
    out = np.empty(total)
    for code in range(len(many)):
        if many[code] == 0:
            continue
        table = table_at(graph, code)
        rows, where, count = np.empty(many[code], np.int64), np.empty(many[code], np.int64), ZERO
        for k in range(n):
            if table_of[edges[k]] == code:
                rows[count], where[count] = row_of[edges[k]], k
                count += 1
        for first in range(0, count, CHUNK):
            some = rows[first : first + CHUNK]
            residual = _rows_residuals(table, offset, values, some)
            m, long = residual.shape[1], table[records.ROOM]
            of_each = squares(reals(table[records.SQRT_INFORMATION], long * m * m).reshape(long, m, m), some, residual)
            for k in range(len(some)):
                at = where[first + k]
                chi2[at] = of_each[k]
                for i in range(m):
                    out[begin[at] + i] = residual[k, i]
    return ZERO + NOTHING, out, chi2, numbers


@inner
def _rows_residuals(table: Index, offset: Index, values: Array, rows: Index) -> Array:
    """Return the residuals (n, m) of rows of a table at stored values."""
    room, slots, size = table[records.ROOM], table[records.ENDS], table[records.MEASURED_SIZE]
    vertices = integers(table[records.VERTICES], room * slots).reshape(room, slots)
    measured = reals(table[records.MEASURED], room * size).reshape(room, size)
    at, z = gather(rows, vertices, offset, measured)
    residual, _ = call_native(table[records.LINEARIZE], values, at, z)
    return residual


@kernel
def store(t: Tree, rows: Index, ids: Index, residual: Array, jacobian: Array) -> None:
    """Put whitened edges into the tree that have nothing there: J'J and J'r, and the diagonal of H."""
    vertex, edge, link, blocks, diagonal = t.vertex, t.edge, t.link, t.blocks, t.diagonal
    n, m, width = jacobian.shape
    for k in range(n):
        e = ids[rows[k]]
        at = edge[e, BLOCK]
        for p in range(width):
            if m == 2:  # the usual sizes by themselves: short loops take most of the time
                x, y = jacobian[k, 0, p], jacobian[k, 1, p]
                for c in range(p, width):
                    blocks[at + c] = x * jacobian[k, 0, c] + y * jacobian[k, 1, c]
                blocks[at + width] = x * residual[k, 0] + y * residual[k, 1]
            elif m == 3:
                x, y, z = jacobian[k, 0, p], jacobian[k, 1, p], jacobian[k, 2, p]
                for c in range(p, width):
                    blocks[at + c] = x * jacobian[k, 0, c] + y * jacobian[k, 1, c] + z * jacobian[k, 2, c]
                blocks[at + width] = x * residual[k, 0] + y * residual[k, 1] + z * residual[k, 2]
            elif m == 6:
                u, v, w = jacobian[k, 0, p], jacobian[k, 1, p], jacobian[k, 2, p]
                x, y, z = jacobian[k, 3, p], jacobian[k, 4, p], jacobian[k, 5, p]
                for c in range(p, width):
                    first = u * jacobian[k, 0, c] + v * jacobian[k, 1, c] + w * jacobian[k, 2, c]
                    last = x * jacobian[k, 3, c] + y * jacobian[k, 4, c] + z * jacobian[k, 5, c]
                    blocks[at + c] = first + last
                first = u * residual[k, 0] + v * residual[k, 1] + w * residual[k, 2]
                blocks[at + width] = first + x * residual[k, 3] + y * residual[k, 4] + z * residual[k, 5]
            else:
                blocks[at + p : at + width + 1] = 0.0
                for a in range(m):
                    x = jacobian[k, a, p]
                    for c in range(p, width):
                        blocks[at + c] += x * jacobian[k, a, c]
                    blocks[at + width] += x * residual[k, a]
            at += width - p  # column c of the next row is at + c
        add_to_diagonal(vertex, edge, link, e, blocks, diagonal)


@kernel
def whiten_and_store(t: Tree, table: Index, rows: Index, residual: Array, jacobian: Array, losses: Index) -> int:
    """Whiten edges and add them to the tree; or add none, and return the row of one whose cost is not finite."""
    m, room = table[records.RESIDUAL_SIZE], table[records.ROOM]
    root = reals(table[records.SQRT_INFORMATION], room * m * m).reshape(room, m, m)
    label, source = integers(table[records.LABEL], room), integers(table[records.SOURCE], room)
    loss, sources = np.empty(len(rows), np.int64), losses[3]
    for k in range(len(rows)):
        loss[k] = label[rows[k]] * sources + source[rows[k]] if sources else label[rows[k]]
    kind, scale = integers(losses[0], losses[2]), reals(losses[1], losses[2])
    _, cost = whiten(rows, residual, jacobian, root, reals(table[records.WEIGHT], room), loss, kind, scale)
    total, worst = 0.0, 0
    for k in range(len(cost)):
        total += cost[k]
        if not np.isfinite(cost[k]):
            return rows[k]
        if cost[k] > cost[worst]:
            worst = k
    if not np.isfinite(total):
        return rows[worst]
    ids = integers(table[records.ID], room)
    for row in rows:
        clear_block(t.vertex, t.edge, t.link, ids[row], t.blocks, t.diagonal)
    store(t, rows, ids, residual, jacobian)
    return NOTHING


@kernel
def linearize_edges(t: Tree, graph: Index, edges: Index, losses: Index, young: Index, first: Index) -> tuple[int, int]:
    """Linearise edges at the linearisation points of the tree, and put them into it (``linearize_into``).

    Returns NOTHING; the table of an edge that is not compiled, and then none is put into the tree; or the table and the
    row of one whose cost is not finite.
    """
    room = graph[records.EDGE_ROOM]
    table_of, row_of = integers(graph[records.TABLE_OF_EDGE], room), integers(graph[records.ROW_OF_EDGE], room)
    for e in edges:
        if table_at(graph, table_of[e])[records.LINEARIZE] == 0:
            return table_of[e], NOTHING
    for e in edges:
        t.edge[e, MARKED] = 0  # an error may have left it
    for e in young:
        t.edge[e, MARKED] = 1
    bad, of_bad, rows = ZERO + NOTHING, ZERO + NOTHING, np.empty(len(edges), np.int64)
    for is_old in range(0 if len(young) else 1, 2):
        for code in range(len(graph) - records.TABLES if bad == NOTHING else 0):
            count = ZERO
            for e in edges:
                if table_of[e] == code and t.edge[e, MARKED] != is_old:
                    rows[count] = row_of[e]
                    count += 1
            bad = _linearize_rows(t, graph, table_at(graph, code), rows[:count], losses if is_old else first)
            if bad != NOTHING:
                of_bad = code
                break
    for e in young:
        t.edge[e, MARKED] = 0
    return of_bad, bad


@inner
def _linearize_rows(t: Tree, graph: Index, table: Index, rows: Index, losses: Index) -> int:
    """Linearise rows of a table and put them into the tree; or return the row of one whose cost is not finite."""
    room, slots, size = table[records.ROOM], table[records.ENDS], table[records.MEASURED_SIZE]
    vertices = integers(table[records.VERTICES], room * slots).reshape(room, slots)
    measured = reals(table[records.MEASURED], room * size).reshape(room, size)
    offset = integers(graph[records.OFFSET], len(t.vertex))
    for begin in range(0, len(rows), CHUNK):
        some = rows[begin : begin + CHUNK]
        at, z = gather(some, vertices, offset, measured)
        residual, jacobian = call_native(table[records.LINEARIZE], t.value, at, z)
        bad = whiten_and_store(t, table, some, residual, jacobian, losses)
        if bad != NOTHING:
            return bad
    return ZERO + NOTHING


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
        self._graph = graph
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

    def weight(self, edge: int, chi2: float) -> float:
        """Return the weight rho'(s) of one edge by its chi2 without its own weight."""
        table, row = self._graph.row(edge)
        code = int(self.codes(table, np.array([row]))[0])
        return weight_and_cost(self.kind[code], self.scale[code], chi2 * table.weight.values[row])[0]


def linearize(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], losses: Losses) -> Iterator[Block]:
    """Linearise the given rows of each table at the stored values x, with the loss of each edge.

    Blocks come some hundred edges at a time: arrays of that size stay in the cache and in the process.
    """
    for table, chosen in rows.items():
        for first in range(0, len(chosen), CHUNK):
            some = chosen[first : first + CHUNK]
            residual, jacobian = given = _evaluate(graph, x, table, some)
            weights = table.sqrt_information.values, table.weight.values
            chi2, cost = whiten(some, *given, *weights, losses.codes(table, some), losses.kind, losses.scale)
            yield Block(table, some, residual, jacobian, chi2, cost)


def _evaluate(graph: Graph, x: Array, table: EdgeTable, rows: Index) -> tuple[Array, Array]:
    """Return residuals (n, m) and Jacobians (n, m, width) of rows of a table at the stored values x."""
    at, measured = gather(rows, table.vertex_rows.values, graph.offset.values, table.measured.values)
    return table.type.linearize(x, at, measured)


def linearize_into(graph: Graph, tree: Tree, edges: Index, losses: Losses, young: Index, first: Losses) -> None:
    """Linearise edges at the linearisation points of the tree, and put them into it; ``young`` ones have ``first``.

    A GraphSlamError where the cost of an edge is not finite.
    """
    code, row = linearize_edges(tree, graph.pointers, edges, losses.pointers, young, first.pointers)
    if code == NOTHING:
        return
    if row != NOTHING:
        _refuse_row(list(graph.tables.values())[code], row)
    known = np.sort(young)  # not all edge types are compiled: one after the other
    is_young = np.isin(edges, known)
    for some, of_some in ((edges[is_young], first), (edges[~is_young], losses)):
        for table, chosen in graph.rows_by_table(some).items():
            for begin in range(0, len(chosen), CHUNK):
                rows = chosen[begin : begin + CHUNK]
                given = _evaluate(graph, tree.value, table, rows)
                bad = whiten_and_store(tree, table.pointers, rows, *given, of_some.pointers)
                if bad != NOTHING:
                    _refuse_row(table, bad)
            table.pointers[records.LINEARIZE] = native_address(table.type.linearize)


def linearized(graph: Graph, x: Array, edge: EdgeType, vertices: Sequence[int], measured: Array) -> tuple[Array, Array]:
    """Residual (m,) and Jacobian (m, width) of one measurement (p,) between vertices (k,) at the stored values x."""
    residual, jacobian = edge.linearize(x, graph.begins(np.array([vertices])), measured[None])
    return residual[0], jacobian[0]


def evaluated(graph: Graph, x: Array, edges: Index) -> tuple[Array, Array, Index]:
    """Evaluate edges at the stored values x.

    Returns residuals, not whitened, end to end; chi2 (n,) without loss and weight; the numbers (n,) of each residual.
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


def information(graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], free: Index, losses: Losses) -> coo_array:
    """H as a sparse matrix over some vertices, in this order."""
    dof = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)[graph.kind.values[free]]
    size, first = int(dof.sum()), np.full(graph.vertex_count, NOTHING)
    first[free] = np.cumsum(dof) - dof
    numbers, places = [np.empty(0)], [np.empty((2, 0), dtype=np.int64)]
    for b in linearize(graph, x, rows, losses):
        slots = np.repeat(np.arange(len(b.table.type.dofs)), b.table.type.dofs)
        within = np.concatenate([np.arange(d) for d in b.table.type.dofs])
        begins = first[b.table.vertex_rows.values[b.rows]][:, slots]
        row, column = np.broadcast_arrays((begins + within)[:, :, None], (begins + within)[:, None, :])
        is_free = (begins[:, :, None] != NOTHING) & (begins[:, None, :] != NOTHING)
        numbers.append((np.swapaxes(b.jacobian, 1, 2) @ b.jacobian)[is_free])
        places.append(np.stack((row[is_free], column[is_free])))
    return coo_array((np.concatenate(numbers), np.concatenate(places, axis=1)), shape=(size, size))


def blocks_of(tree: Tree, table: EdgeTable, rows: Index) -> Array:
    """Return what a tree has of rows of a table, (n, D, D + 1): J'J, and J'r as the last column."""
    row, column = np.indices((table.width, table.width + 1))
    packed = row_of(np.minimum(row, column), table.width) + np.maximum(row, column)
    return tree.blocks[tree.edge[table.edge_row.values[rows], BLOCK][:, None, None] + packed]


def refuse_nonfinite(block: Block) -> None:
    """Raise GraphSlamError if numbers are so large that a cost overflows; it names the first such edge."""
    if isfinite(block.cost[0] if len(block.cost) == 1 else block.cost.sum()):
        return
    bad = np.flatnonzero(~np.isfinite(block.cost))
    _refuse_row(block.table, block.rows[bad[0] if len(bad) else int(block.cost.argmax())])


def _refuse_row(table: EdgeTable, row: int) -> None:
    """Raise GraphSlamError for an edge whose cost is not finite."""
    raise GraphSlamError(
        f"edge {int(table.ids[row])} ({table.type.name}) between vertices {table.vertices[row].tolist()}:"
        " its chi2 is not finite"
    )


@dataclass(frozen=True, slots=True)
class ClassCost:
    """The number of edges of a label, their share of chi2, and the number of residuals in it."""

    edges: int
    chi2: float
    residuals: int


def costs(
    graph: Graph, x: Array, rows: Mapping[EdgeTable, Index], losses: Losses
) -> tuple[float, float, dict[str, ClassCost]]:
    """Return chi2, the cost with losses, and chi2 by label, of the given rows of each table at the stored values x."""
    count, residuals = np.zeros((2, len(graph.labels)), dtype=np.int64)
    chi2, cost = np.zeros(len(graph.labels)), 0.0
    for b in linearize(graph, x, rows, losses):
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
    return float(chi2.sum()), cost, classes
