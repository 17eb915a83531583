"""Compaction: rows that are not in the problem any more leave a graph and its solver, and all others move up."""

from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.kept_part import kept_part, new_ids
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Index


@dataclass(frozen=True, slots=True)
class Renumbered:
    """The new ids of vertices and edges by old ones, (n,): -1 where they were removed."""

    vertices: Index
    edges: Index


def compact(solver: Solver, vertices: Index | None = None, edges: Index | None = None) -> Renumbered:
    """Remove all other vertices and edges from a graph and its solver, in place. The estimate stays.

    Whoever has an id of them must take over the new one. What the solver had is pending: the next update solves it.

    Parameters
    ----------
    vertices, edges : that stay, ascending; by default those of the problem, and edges that have a weight
    """
    graph = solver.graph
    vertices = solver.vertices if vertices is None else vertices
    edges = solver.edges if edges is None else edges
    inside, held = solver.vertices, solver.held
    part = kept_part(graph, vertices, edges, solver.values)
    out = Renumbered(new_ids(vertices, graph.vertex_count), new_ids(edges, graph.edge_count))
    vars(graph).update(vars(part))
    fresh = Solver(graph, solver.settings)
    still = out.vertices[inside]
    fresh.add(still[still >= 0], np.arange(graph.edge_count))
    for vertex in out.vertices[held].tolist():
        if vertex >= 0:
            fresh.hold(vertex)
    vars(solver).update(vars(fresh))
    return out
