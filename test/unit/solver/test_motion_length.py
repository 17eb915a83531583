"""Where steps are linearised anew: turns that show in chi2."""

import numpy as np
from rows import each

from graph_slam_ros.graph import RELATIVE_POSE, SE2, Gaussian, Graph
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Solver


@each("seed", range(2))
def test_a_small_graph_is_at_its_optimum_after_each_closure(seed):
    """Compass headings of 0.3 rad; a search for large steps is due at every tenth update only."""
    random, graph, worst = np.random.default_rng(seed), Graph(), 1.0
    noise, truth = Gaussian(np.diag([20.0, 20.0, 1.0 / 0.3])), np.zeros(3)
    solver, poses = Solver(graph), [truth]
    solver.add([graph.add_vertex(SE2, truth)], [])
    solver.hold(0)
    for k in range(1, 30):
        poses.append(np.array(se2.compose(tuple(poses[-1]), (1.0, 0.0, np.pi / 2 if k % 3 == 0 else 0.0))))
        measured = [noisy(random, poses, k - 1, k)]
        at = se2.compose(tuple(solver.estimate([k - 1])[0]), measured[0])
        solver.add([graph.add_vertex(SE2, at)], [graph.add_edge(RELATIVE_POSE, (k - 1, k), measured[0], noise, "o")])
        if k >= 12:
            closed = noisy(random, poses, k - 12, k)
            solver.add([], [graph.add_edge(RELATIVE_POSE, (k - 12, k), closed, noise, "closures")])
        solver.update()
        if k > 15:
            best = Solver(graph)
            best.start_at(solver.values)
            best.add(range(k + 1), range(graph.edge_count))
            best.hold(0)
            best.optimize()
            worst = max(worst, solver.evaluate().chi2_final / best.evaluate().chi2_final)
    assert worst < 1.1, "1.4 to 3.9 where all steps wait for the search"


def noisy(random, poses, a, b):
    """A motion between two of the poses, as it is measured."""
    motion = np.array(se2.between(tuple(poses[a]), tuple(poses[b])))
    return tuple((motion + random.normal(0.0, [0.05, 0.05, 0.3])).tolist())
