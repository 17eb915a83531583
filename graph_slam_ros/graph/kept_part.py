"""A part of a graph as a graph of its own: rows move up, and their lasting ids stay."""

import numpy as np

from graph_slam_ros.graph.graph import Graph
from graph_slam_ros.graph.tables import Column, EdgeTable
from graph_slam_ros.typing import Array, Index


def kept_part(graph: Graph, vertices: Index, edges: Index, values: Array) -> Graph:
    """Return a graph of some vertices and edges, in the same order.

    Parameters
    ----------
    vertices, edges : ids, ascending; all ends of the edges are among the vertices
    values : stored numbers of all vertices, as ``Graph.initial``: what the vertices begin with
    """
    out, moved = Graph(), new_ids(vertices, graph.vertex_count)
    out.kinds, out.labels, out.sources = list(graph.kinds), list(graph.labels), list(graph.sources)
    kinds = graph.kind.values[vertices]
    sizes = np.array([kind.size for kind in graph.kinds], dtype=np.int64)[kinds]
    ends = np.cumsum(sizes)
    numbers = np.repeat(graph.offset.values[vertices] - (ends - sizes), sizes) + np.arange(int(sizes.sum()))
    count = len(vertices)
    Column.extend(
        (out.kind, kinds, count), (out.offset, ends - sizes, count), (out.initial, values[numbers], len(numbers))
    )
    count, code_of_edge, row_of_edge = len(edges), np.empty(len(edges), np.int64), np.empty(len(edges), np.int64)
    new_edge = new_ids(edges, graph.edge_count)
    kept = [(table, np.flatnonzero(new_edge[table.id.values] >= 0)) for table in graph.tables.values()]
    found = [(int(table.id.values[rows[0]]), table, rows) for table, rows in kept if len(rows)]
    for _, table, rows in sorted(found):  # as if it was added edge by edge
        fresh = out.tables[table.type] = EdgeTable(table.type, len(out.tables))
        out._in_order.append(fresh)
        columns = zip(fresh.columns, table.columns, strict=True)
        Column.extend(*((column, of_all.values[rows], len(rows)) for column, of_all in columns))
        fresh.id.values[:] = ids = new_edge[fresh.id.values]
        fresh.vertices.values[:] = moved[fresh.vertices.values]
        fresh.locate()
        code_of_edge[ids], row_of_edge[ids] = fresh.code, np.arange(len(rows))
    Column.extend((out.table_of_edge, code_of_edge, count), (out.row_of_edge, row_of_edge, count))
    out.vertex_ids = graph.vertex_ids.kept(vertices, graph.vertex_count)
    out.edge_ids = graph.edge_ids.kept(edges, graph.edge_count)
    out.locate()
    return out


def new_ids(kept: Index, count: int) -> Index:
    """Return the new id of each of so many, (count,): -1 where it is not kept."""
    out = np.full(count, -1, dtype=np.int64)
    out[kept] = np.arange(len(kept))
    return out
