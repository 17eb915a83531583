"""The edges that determine each landmark: whether one can be taken out."""

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.solver import Solver

_TOGETHER = 8  # sightings that tell but a part each determine a landmark, wherever they are from


def landmark_of(graph: Graph, edge: int) -> int | None:
    """The vertex of an edge's landmark."""
    return graph.ends_of(edge)[1] if graph.label_of(edge) == "landmarks" else None


def is_needed(solver: Solver, edge: int) -> bool:
    """Return whether a landmark may be undetermined without the edge: it is the last, or one of very few."""
    landmark = landmark_of(solver.graph, edge)
    return landmark is not None and not is_determined(solver, landmark, without=edge)


def is_determined(solver: Solver, landmark: int, without: int = -1) -> bool:
    """Return whether the edges that count determine a landmark, also without one of them."""
    if solver.is_held(landmark):
        return True
    graph, edges = solver.graph, solver.edges_on(landmark)
    edges = edges[(edges != without) & graph.has_label(edges, ("landmarks", PLACES))]
    by_table = graph.by_table(edges[graph.weights(edges) > 0.0]).items()
    dof = graph.kind_of(landmark).dof
    is_one_enough = any(len(rows) and table.type.residual_size >= dof for table, rows in by_table)
    return is_one_enough or sum(len(rows) for _, rows in by_table) >= _TOGETHER
