"""A whole graph in one call: what holds it, where it starts, and graphs with next to nothing in them."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import (
    ATTITUDE_PRIOR_3D,
    CAUCHY,
    HEADING_PRIOR,
    HUBER,
    LANDMARK_POSITION,
    POINT_PRIOR,
    POSE_PRIOR,
    POSITION_PRIOR,
    POSITION_PRIOR_3D,
    R1,
    R2,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    Gaussian,
    Graph,
    Loss,
)
from graph_slam_ros.lie import se3
from graph_slam_ros.optimization import optimize
from graph_slam_ros.solver import Settings, Solver, initial_values

STARTS = ["file", "tree", "chordal", "online"]
STEP = (1.0, 0.2, 0.0, *np.array([0.1, -0.2, 0.3, np.sqrt(0.86)]))


def unit(size, sigma=1.0):
    return Gaussian.from_sigmas(*[sigma] * size)


def chain(count=4):
    """Poses in the plane, each 1 m before the last, that begin at (5, 6) and half a radian."""
    graph = Graph()
    for k in range(count):
        graph.add_vertex(SE2, [5.0 + k * np.cos(0.5), 6.0 + k * np.sin(0.5), 0.5])
        if k:
            graph.add_edge(RELATIVE_POSE, [k - 1, k], [1, 0, 0], unit(3), "odometry")
    return graph


@each("init", STARTS)
def test_graphs_with_next_to_nothing_are_solved_from_any_start(init):
    nothing = optimize(Graph(), init=init)
    assert (nothing.report.stop, nothing.poses.shape, nothing.points.shape) == ("nothing_to_do", (0, 0), (0, 0))
    assert optimize(chain(1), init=init).poses.tolist() == [[5.0, 6.0, 0.5]]
    points = Graph()
    points.add_vertices(R2, [[1.0, 2.0], [3.0, 4.0]])
    for k in range(2):
        points.add_edge(POINT_PRIOR[R2], [k], [0.0, float(k)], unit(2), "surveyed")
    solved = optimize(points, init=init)
    assert solved.start == "file"
    assert solved.points == pytest.approx(np.array([[0.0, 0.0], [0.0, 1.0]]), abs=1e-12)


def without_a_weight(graph):
    graph.set_weights(np.array([graph.add_edge(POSE_PRIOR, [2], [0, 0, 0], unit(3), "anchor")]), 0.0)


@each(
    "prior",
    [
        lambda g: None,
        lambda g: g.add_edges(POSE_PRIOR, np.empty((0, 1), dtype=int), np.empty((0, 3)), unit(3), "anchor"),
        without_a_weight,
        lambda g: g.add_edge(HEADING_PRIOR, [2], [0.5], unit(1), "compass"),
        lambda g: g.add_edge(POSITION_PRIOR, [0], [5, 6], unit(2), "fixes"),
        lambda g: g.add_edge(POINT_PRIOR[R1], [g.add_vertex(R1, [0.0])], [0.0], unit(1), "offset"),
    ],
)
@each("init", STARTS)
def test_G2_the_first_pose_is_held_where_priors_do_not_fix_position_and_heading(prior, init):
    graph = chain()
    prior(graph)
    solved = optimize(graph, init=init)
    assert solved.poses[0].tolist() == [5.0, 6.0, 0.5]
    assert not solved.solver.marginal([0])[0].any()
    assert solved.report.converged


def in_space():
    graph, pose = Graph(), se3.retract(se3.IDENTITY, (100.0, -50.0, 7.0, 0.3, -0.2, 0.9))
    for k in range(4):
        graph.add_vertex(SE3, pose)
        pose = se3.compose(pose, STEP)
        if k:
            graph.add_edge(RELATIVE_POSE_3D, [k - 1, k], STEP, unit(6), "odometry")
    return graph


@each(
    "graph, priors, fixed",
    [
        (chain, [(POSE_PRIOR, 1, [7, 8, 0.3])], True),
        (chain, [(POSITION_PRIOR, 1, [7, 8]), (HEADING_PRIOR, 3, [0.3])], True),
        (chain, [(POSITION_PRIOR, 0, [7, 8]), (POSITION_PRIOR, 2, [9, 8])], True),
        (in_space, [(POSITION_PRIOR_3D, k, slice(3)) for k in (0, 1)], False),  # it turns about the line through both
        (in_space, [(POSITION_PRIOR_3D, k, slice(3)) for k in (0, 1, 2)], True),
        (in_space, [(ATTITUDE_PRIOR_3D, 1, slice(3, 7))], False),
        (in_space, [(POSITION_PRIOR_3D, 2, slice(3)), (ATTITUDE_PRIOR_3D, 1, slice(3, 7))], True),
    ],
)
def test_nothing_is_held_where_priors_fix_the_whole_together(graph, priors, fixed):
    graph = graph()
    for edge, vertex, at in priors:
        measured = graph.vertex(vertex).initial[at] if isinstance(at, slice) else at
        graph.add_edge(edge, [vertex], measured, unit(edge.residual_size), "priors")
    solved = optimize(graph, Settings(step_tolerance=1e-10, cost_tolerance=0.0))
    assert solved.report.chi2_final == pytest.approx(0.0, abs=1e-12)
    assert solved.solver.marginal([0])[0].any() == fixed


@each("init", STARTS[1:])
def test_edges_of_no_weight_do_not_say_where_to_start(init):
    graph = Graph()
    graph.add_vertices(SE2, np.zeros((3, 3)))
    point = graph.add_vertex(R2, [0.0, 0.0])
    graph.add_edge(RELATIVE_POSE, [0, 1], [9, 9, 1], unit(3), "odometry")
    graph.add_edge(LANDMARK_POSITION, [0, point], [9, 9], unit(2), "landmarks")
    graph.set_weights(np.arange(2), 0.0)
    for k in range(2):
        graph.add_edge(RELATIVE_POSE, [k, k + 1], [1, 0, 0], unit(3), "odometry")
    graph.add_edge(LANDMARK_POSITION, [2, point], [0, 1], unit(2), "landmarks")
    expected = [0, 0, 0, 1, 0, 0, 2, 0, 0, 2, 1]
    assert initial_values(graph, init, 0) == pytest.approx(np.array(expected, dtype=float), abs=1e-12)


def test_settings_that_cannot_be_are_refused_by_name():
    wrong = {"max_iterations": -3, "step_tolerance": float("nan"), "cost_tolerance": -1e-9, "relinearize_every": 0}
    wrong |= {"relinearize_passes": -1, "tolerance_sigmas": -1.0, "losses": {"odometry": []}, "method": "newton"}
    for name, value in wrong.items():
        with pytest.raises(GraphSlamError, match=name):
            Settings(**{name: value})
    assert Settings(losses={"odometry": [Loss(HUBER)]}).stages()


def test_a_start_that_fails_is_told_and_the_first_result_stays():
    graph = chain(3)
    graph.add_vertex(SE2, [5.0, 5.0, 0.0])
    for at in ([5.0, 5.0, 0.0], [9.0, 5.0, 0.0]):  # on its own, and contradicting itself: no tree leads to it
        graph.add_edge(POSE_PRIOR, [3], at, unit(3, 0.1), "priors")
    graph.add_edge(POSE_PRIOR, [0], [5.0, 6.0, 0.5], unit(3), "priors")
    solution = optimize(graph)
    assert solution.start == "file"
    assert "far" in solution.suspicion
    assert [bool(one.failure) for one in solution.attempts] == [False, True, True]


def test_Q2_a_loss_whose_weights_follow_the_steps_needs_no_more_iterations():
    graph = Graph()
    vertex = graph.add_vertex(R1, [0.5])
    for x in (-0.98, 0.98):  # the curvature of their costs together is a fiftieth of what their weights say
        graph.add_edge(POINT_PRIOR[R1], [vertex], [x], unit(1), "range")
    solver = Solver(graph, Settings(losses={"range": [Loss(CAUCHY, 1.0)]}, step_tolerance=1e-8, cost_tolerance=0.0))
    solver.add([vertex], [0, 1])
    report = solver.optimize()
    assert report.converged
    assert report.method == "gn"  # nor with damping
    assert solver.estimate([vertex])[0, 0] == pytest.approx(0.0, abs=1e-4)
