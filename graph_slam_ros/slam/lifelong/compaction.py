"""Compaction: a graph and its solver made anew with the vertices and edges that are still in the problem."""

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.solver import Solver


@dataclass(frozen=True, slots=True)
class Compacted:
    """A problem without dead rows.

    Attributes
    ----------
    solver : of a new graph; its estimate is that of the old one
    vertices, edges : new ids by old ones, of all that is in the problem
    """

    solver: Solver
    vertices: dict[int, int]
    edges: dict[int, int]


def compacted(solver: Solver) -> Compacted:
    """Return the problem of a solver in a graph of its own, in the same order.

    Pending changes are not in the solution yet, as before. Vertices without an edge stay.
    """
    old, graph = solver.graph, Graph()
    vertices = _copy_vertices(solver, graph)
    edges: dict[int, int] = {}
    counting = solver.edges.tolist()
    kinds = [(old.row(edge)[0].code, old.label_of(edge), old.source_of(edge)) for edge in counting]
    for (_, label, source), run in groupby(zip(kinds, counting, strict=True), key=lambda one: one[0]):
        ids = [edge for _, edge in run]
        some = old.row(ids[0])[0].at(np.array([old.row(edge)[1] for edge in ids]))
        ends = [[vertices[v] for v in of_one] for of_one in some.vertices.tolist()]
        new = graph.add_edges(some.table.type, ends, some.measured, Gaussian(some.sqrt_information), label, source)
        for edge, weight in zip(new.tolist(), some.weight.tolist(), strict=True):
            if weight != 1.0:
                graph.set_weights(np.array([edge]), weight)
        edges |= zip(ids, new.tolist(), strict=True)
    fresh = Solver(graph, solver.settings)
    fresh.add(range(graph.vertex_count), range(graph.edge_count))
    for vertex in solver.held.tolist():
        fresh.hold(vertices[vertex])
    return Compacted(fresh, vertices, edges)


def _copy_vertices(solver: Solver, graph: Graph) -> dict[int, int]:
    """Copy the vertices of the problem at their estimates; returns new ids by old ones."""
    out: dict[int, int] = {}
    for kind, run in groupby(solver.vertices.tolist(), key=solver.graph.kind_of):
        ids = list(run)
        out |= zip(ids, graph.add_vertices(kind, solver.estimate(ids)).tolist(), strict=True)
    return out
