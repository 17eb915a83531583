"""How much of the tree is walked to tell small pivots from rounding."""

import numpy as np

from graph_slam_ros.graph import POSE_PRIOR, RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.clique_tree.storage import AFFECTED, CHECKED, CLIQUES


def test_an_update_of_a_long_open_drive_looks_at_what_changed_not_at_the_whole_tree():
    graph, rng, pose, told = Graph(), np.random.default_rng(0), (0.0, 0.0, 0.0), []
    solver, noise = Solver(graph), Gaussian.from_sigmas(0.005, 0.005, 0.02)
    for k in range(1650):
        step = (1.0, 0.0, 0.02 * rng.standard_normal())
        pose = se2.compose(pose, step) if k else pose
        v = graph.add_vertex(SE2, pose)  # measurements are exact: the estimate is the linearisation point
        edge = (
            (RELATIVE_POSE, [v - 1, v], step, noise)
            if k
            else (POSE_PRIOR, [v], pose, Gaussian.from_sigmas(*[0.01] * 3))
        )
        solver.add([v], [graph.add_edge(*edge, "odometry")])
        solver.update()
        told.append(solver._tree.state[[CHECKED, AFFECTED]])
    looked, again = told[-1] - told[1600]
    assert 49 <= looked <= 3 * again
    assert solver._tree.state[CLIQUES] > 150
