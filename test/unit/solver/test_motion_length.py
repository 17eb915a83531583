"""Where steps are linearised anew: the typical length of a motion, and turns that show in chi2."""

from itertools import pairwise

import numpy as np
import pytest
from rows import each

from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3, Gaussian, Graph
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.solver.relinearization import NO_LIMITS, MotionLength, RelinearizationSchedule, far_limits


def chain(lengths, dimensions=2):
    """Poses in a row, at the motions that are measured between them."""
    graph, nowhere = Graph(), (0.0, 0.0) if dimensions == 2 else (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    kind, edge = (SE2, RELATIVE_POSE) if dimensions == 2 else (SE3, RELATIVE_POSE_3D)
    vertices = [graph.add_vertex(kind, (at, *nowhere)) for at in np.cumsum([0.0, *lengths])]
    for ends, length in zip(pairwise(vertices), lengths, strict=True):
        graph.add_edge(edge, ends, (length, *nowhere), Gaussian(np.eye(sum(edge.dofs) // 2)), "odometry")
    return graph


@each("dimensions", [2, 3])
@each("length, mm", [(0.1, 1000), (1.2, 1000), (4.2, 4000), (1e9, 2**20 * 1000)])
def test_it_is_the_median_to_a_factor_of_the_root_of_two_and_a_metre_at_least(dimensions, length, mm):
    assert MotionLength().typical_mm(chain([length] * 5, dimensions)) == mm


def test_false_closures_of_any_length_do_not_change_it_and_what_comes_later_counts():
    graph, motions = chain([4.2] * 9 + [1e8] * 4), MotionLength()
    assert motions.typical_mm(graph) == 4000
    for k in range(40):
        graph.add_edge(RELATIVE_POSE, (0, 1), (1.0, 0.0, 0.0), Gaussian(np.eye(3)), f"closures {k % 2}")
    assert motions.typical_mm(graph) == MotionLength().typical_mm(graph) == 1000


@each("length, again", [(1.0, True), (10.0, False)])
def test_a_step_of_a_tenth_of_a_metre_is_linearised_anew_among_short_motions_only(length, again):
    graph = chain([length] * 4)
    solver = Solver(graph, Settings(relinearize_every=1, relinearize_error=1e9))
    solver.add(range(5), range(4))
    solver.hold(0)
    solver.update()
    for ends, measured in (((3, 4), length + 0.3), ((0, 1), length)):
        solver.add([], [graph.add_edge(RELATIVE_POSE, ends, (measured, 0.0, 0.0), Gaussian(np.eye(3)), "odometry")])
        change = solver.update()
    assert change.linearized == (3 if again else 1), "both edges of the pose that has moved by 0.15 m, and the new one"
    assert solver.estimate([4])[0] == pytest.approx((4.0 * length + 0.15, 0.0, 0.0))


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


def test_the_limit_of_a_turn_grows_with_the_graph_to_ten_times_the_threshold():
    graph, limits = chain([1.0]), []
    for _ in range(2000):
        graph.add_edge(RELATIVE_POSE, (0, 1), (1.0, 0.0, 0.0), Gaussian(np.eye(3)), "closures")
        limits.append(far_limits(graph, Settings())[1])
    assert limits[0] == 0.05
    assert limits[999] == pytest.approx(np.sqrt(5e-5 * 2997))
    assert limits[-1] == 0.5
    assert {far_limits(graph, Settings())[k] for k in (0, 2)} == {0.5, 10.0}
    assert far_limits(graph, Settings(relinearize_neglected=np.inf))[1] == 0.5
    assert RelinearizationSchedule().limits(graph, Settings(relinearize_passes=0))[2] == NO_LIMITS
