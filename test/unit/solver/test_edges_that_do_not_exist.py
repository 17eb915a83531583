"""Edges that do not exist are refused before compiled code reads them."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import R2, Gaussian, Graph
from graph_slam_ros.graph.edges import DIFFERENCE
from graph_slam_ros.solver import Solver


@each("edge", [-1, 1, 10**12])
@each(
    "ask",
    [
        lambda solver, ids: solver.chi2_of(ids),
        lambda solver, ids: solver.residuals_of(ids),
        lambda solver, ids: solver.leave_out(ids),
        lambda solver, ids: solver.graph.has_label(ids, ("one",)),
    ],
)
def test_an_edge_that_does_not_exist_is_refused(ask, edge):
    graph = Graph()
    ends = graph.add_vertices(R2, np.zeros((2, 2)))
    graph.add_edge(DIFFERENCE[R2], ends, np.ones(2), Gaussian(np.eye(2)), "one")
    solver = Solver(graph)
    solver.add(ends, [0])
    solver.hold(0)
    solver.update()
    ask(solver, np.array([0]))
    with pytest.raises(GraphSlamError, match=f"edge {edge} does not exist"):
        ask(solver, np.array([0, edge]))
