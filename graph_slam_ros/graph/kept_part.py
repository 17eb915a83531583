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
    new_edge, is_kept = new_ids(edges, graph.edge_count), np.zeros(graph.edge_count, dtype=bool)
    is_kept[edges] = True
    found = [(table, rows) for table in graph.tables.values() if len(rows := np.flatnonzero(is_kept[table.id.values]))]
    for table, rows in sorted(
        found, key=lambda one: int(one[0].id.values[one[1][0]])
    ):  # as if it was added edge by edge
        code = len(out.tables)
        fresh = out.tables[table.type] = EdgeTable(table.type, code)
        out._in_order.append(fresh)
        ids, some = new_edge[table.id.values[rows]], table.at(rows)
        of_all = (fresh.id, ids), (fresh.vertices, moved[some.vertices]), (fresh.measured, some.measured)
        rest = (fresh.sqrt_information, some.sqrt_information), (fresh.label, some.label), (fresh.source, some.source)
        Column.extend(
            *((column, rows_of, len(rows)) for column, rows_of in (*of_all, *rest, (fresh.weight, some.weight)))
        )
        code_of_edge[ids], row_of_edge[ids] = code, np.arange(len(rows))
    Column.extend((out.table_of_edge, code_of_edge, count), (out.row_of_edge, row_of_edge, count))
    out.vertex_ids = graph.vertex_ids.kept(vertices, graph.vertex_count)
    out.edge_ids = graph.edge_ids.kept(edges, graph.edge_count)
    for table in out.tables.values():
        table.locate()
    out.locate()
    return out


def new_ids(kept: Index, count: int) -> Index:
    """Return the new id of each of so many, (count,): -1 where it is not kept."""
    out = np.full(count, -1, dtype=np.int64)
    out[kept] = np.arange(len(kept))
    return out
