"""Blocks of edges in the tree: gathered, linearised, whitened and stored by compiled code."""

import numpy as np

from graph_slam_ros.graph import records
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.native import call_native
from graph_slam_ros.graph.records import table_at
from graph_slam_ros.lie.addresses import integers, reals
from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.solver.clique_tree.numeric import add_to_diagonal, clear_block
from graph_slam_ros.solver.clique_tree.pointers import tree_of
from graph_slam_ros.solver.clique_tree.storage import BLOCK, MARKED, NOTHING, ZERO, Tree
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
    """Return the squared whitened residual of each edge, without its weight.

    Parameters
    ----------
    root : square root informations of the whole table; rows : (n,) those of the edges
    """
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
    store(t, rows, integers(table[records.ID], room), residual, jacobian)
    return NOTHING


@kernel
def store_linearized(
    graph: Index, pointers: Index, edges: Index, losses: Index, young: Index, first: Index
) -> tuple[int, int]:
    """Linearise edges at the linearisation points of the tree, and put them into it (``linearize_into``).

    Returns NOTHING; the table of an edge that is not compiled, and then none is put into the tree; or the table and the
    row of one whose cost is not finite.
    """
    return linearize_edges(tree_of(pointers), graph, edges, losses, young, first)


@inner
def linearize_edges(t: Tree, graph: Index, edges: Index, losses: Index, young: Index, first: Index) -> tuple[int, int]:
    """Do as ``store_linearized``, with the tree itself."""
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
