"""The records of a graph for compiled code: one array of the addresses of all columns, and what appends to them.

Rows are written beyond the end of the columns, which have room for them. The graph then counts them, all or none.
"""

import numpy as np

from graph_slam_ros.lie.addresses import integers, reals
from graph_slam_ros.lie.jit import inner, kernel
from graph_slam_ros.typing import Array, Index, Mask

# pointers of a graph: where its columns begin; how many edges there is room for; from TABLES on, where the pointers of
# each table are
KIND, OFFSET, INITIAL, TABLE_OF_EDGE, ROW_OF_EDGE, EDGE_ROOM, TABLES = range(7)
# pointers of a table: where its columns begin; the rows that there is room for; the sizes of its edge type; where its
# compiled linearisation begins, 0 where there is none
(
    ID,
    VERTICES,
    MEASURED,
    SQRT_INFORMATION,
    LABEL,
    SOURCE,
    WEIGHT,
    ROOM,
    ENDS,
    MEASURED_SIZE,
    RESIDUAL_SIZE,
    WIDTH,
    LINEARIZE,
    TABLE_COLUMNS,
) = range(14)

FITS, NOT_FINITE, MISSING, ITSELF, OF_ANOTHER_KIND = range(5)


@inner
def table_at(graph: Index, table: int) -> Index:
    """Return the pointers of a table."""
    return integers(graph[TABLES + table], TABLE_COLUMNS)


@kernel
def labels_of(graph: Index, edges: Index) -> Index:
    """Return the codes (n,) of the classes of edges that exist."""
    table_of, row_of = integers(graph[TABLE_OF_EDGE], graph[EDGE_ROOM]), integers(graph[ROW_OF_EDGE], graph[EDGE_ROOM])
    out = np.empty(len(edges), np.int64)
    for k in range(len(edges)):
        table = table_at(graph, table_of[edges[k]])
        out[k] = integers(table[LABEL], table[ROOM])[row_of[edges[k]]]
    return out


@kernel
def weights_of(graph: Index, edges: Index) -> Array:
    """Return the weights (n,) of edges that exist."""
    table_of, row_of = integers(graph[TABLE_OF_EDGE], graph[EDGE_ROOM]), integers(graph[ROW_OF_EDGE], graph[EDGE_ROOM])
    out = np.empty(len(edges))
    for k in range(len(edges)):
        table = table_at(graph, table_of[edges[k]])
        out[k] = reals(table[WEIGHT], table[ROOM])[row_of[edges[k]]]
    return out


@kernel
def append_vertices(pointers: Index, first: int, numbers: int, values: Array, kind: int) -> int:
    """Append vertices of one kind with their values; or none, and return the row of one that is not finite.

    Parameters
    ----------
    first, numbers : vertices, and their stored numbers, that are there
    """
    count, size = values.shape
    kinds, offset = integers(pointers[KIND], first + count), integers(pointers[OFFSET], first + count)
    initial = reals(pointers[INITIAL], numbers + count * size)
    for k in range(count):
        for i in range(size):
            if not np.isfinite(values[k, i]):
                return k
            initial[numbers + k * size + i] = values[k, i]
        kinds[first + k], offset[first + k] = kind, numbers + k * size
    return -1


@kernel
def misfit(at: Index, measured: Array, kind: Index, accepted: Mask) -> tuple[int, int, int]:
    """Return what the first edge that cannot be is refused for, its row, and the slot of the vertex."""
    count, slots = at.shape
    for row in range(count):
        for k in range(measured.shape[1]):
            if not np.isfinite(measured[row, k]):
                return NOT_FINITE, row, 0
        for slot in range(slots):
            if at[row, slot] < 0 or at[row, slot] >= len(kind):
                return MISSING, row, slot
            for other in range(slot):
                if at[row, slot] == at[row, other]:
                    return ITSELF, row, slot
        for slot in range(slots):
            if not accepted[slot, kind[at[row, slot]]]:
                return OF_ANOTHER_KIND, row, slot
    return FITS, 0, 0


@kernel
def append_edges(
    graph: Index,
    pointers: Index,
    counts: tuple[int, int, int],
    at: Index,
    measured: Array,
    root: Array,
    accepted: Mask,
    codes: tuple[int, int, int],
) -> tuple[int, int, int]:
    """Append edges to a table; or none, where one does not fit. Returns that of ``misfit``.

    Parameters
    ----------
    graph, pointers : those of the graph, and of the table
    counts : vertices and edges of the graph, and edges of the table, that are there
    at : (n, k) vertices; measured : (n, p)
    root : the square root information of all, end to end, or one for all
    accepted : (k, kinds) whether a slot takes a kind
    codes : of the table, the class and the input
    """
    (vertices, edges, rows), (table, label, source), p = counts, codes, pointers
    found = misfit(at, measured, integers(graph[KIND], vertices), accepted)
    if found[0] != FITS:
        return found
    n, slots = at.shape
    size, of_root = measured.shape[1], p[RESIDUAL_SIZE] ** 2
    table_of, row_of = integers(graph[TABLE_OF_EDGE], edges + n), integers(graph[ROW_OF_EDGE], edges + n)
    ids, weight = integers(p[ID], rows + n), reals(p[WEIGHT], rows + n)
    labels, sources = integers(p[LABEL], rows + n), integers(p[SOURCE], rows + n)
    ends, seen = integers(p[VERTICES], (rows + n) * slots), reals(p[MEASURED], (rows + n) * size)
    roots = reals(p[SQRT_INFORMATION], (rows + n) * of_root)
    for k in range(n):
        row = rows + k
        table_of[edges + k], row_of[edges + k] = table, row
        ids[row], labels[row], sources[row], weight[row] = edges + k, label, source, 1.0
        for i in range(slots):
            ends[row * slots + i] = at[k, i]
        for i in range(size):
            seen[row * size + i] = measured[k, i]
        begin = k * of_root if len(root) > of_root else 0
        for i in range(of_root):
            roots[row * of_root + i] = root[begin + i]
    return found
