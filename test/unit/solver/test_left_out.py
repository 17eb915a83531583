"""The solution without some edges, from the one with them, against dense algebra and a problem solved anew."""

from dataclasses import replace

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import (
    DIFFERENCE,
    HUBER,
    LANDMARK_POSITION,
    POINT_PRIOR,
    POSE_PRIOR,
    R2,
    RELATIVE_POSE,
    SE2,
    Gaussian,
    Graph,
    Loss,
)
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Settings, Solver

STEPS = 24
TIGHT = {"step_tolerance": 1e-11, "cost_tolerance": 1e-15, "max_iterations": 100}


def gaussian(rng, size, sigma):
    a = rng.standard_normal((size, size))
    return Gaussian.from_covariance(sigma**2 * (a @ a.T / size + 0.3 * np.eye(size)))


def vectors(rng):
    """A linear problem: a chain of points with a loop, and the edges of the loop."""
    graph = Graph()
    graph.add_vertices(R2, rng.standard_normal((STEPS, 2)))
    graph.add_edge(POINT_PRIOR[R2], [0], [1.0, 2.0], gaussian(rng, 2, 0.1), "anchor")
    for k in range(1, STEPS):
        graph.add_edge(DIFFERENCE[R2], [k - 1, k], rng.standard_normal(2), gaussian(rng, 2, 0.1), "odometry")
    loop = [
        graph.add_edge(DIFFERENCE[R2], ends, rng.standard_normal(2), gaussian(rng, 2, 0.1), "closures")
        for ends in ((2, 19), (5, 23), (23, 1), (9, 11))
    ]
    return graph, loop


def drive(rng, noise=1.0):
    """Poses around four landmarks that all see, and the edges of the last eight poses with the landmarks."""
    graph, turn, pose = Graph(), 2.0 * np.pi / 12, (0.0, 0.0, 0.0)
    points = np.array([[1.0, 2.0], [3.0, 4.0], [-2.0, 3.0], [0.0, 5.0]])
    graph.add_vertices(SE2, [pose])
    graph.add_edge(POSE_PRIOR, [0], pose, Gaussian.from_sigmas(0.01, 0.01, 0.01), "anchor")
    marks = graph.add_vertices(R2, points + 0.1 * rng.standard_normal(points.shape))
    poses, seen = [0], []
    for k in range(STEPS):
        if k:
            step = se2.retract((1.0, 0.0, turn), noise * 0.03 * rng.standard_normal(3))
            guess = se2.compose(tuple(graph.initial.values[graph.vertex(poses[-1]).stored]), step)
            pose = se2.compose(pose, (1.0, 0.0, turn))
            poses.append(graph.add_vertex(SE2, guess))
            graph.add_edge(RELATIVE_POSE, poses[-2:], step, gaussian(rng, 3, 0.03), "odometry")
        for mark, point in zip(marks, points, strict=True):
            there = np.array(se2.act(se2.inverse(pose), point)) + noise * 0.05 * rng.standard_normal(2)
            noises = gaussian(rng, 2, 0.05)
            seen.append(graph.add_edge(LANDMARK_POSITION, [poses[-1], mark], there, noises, "landmarks"))
    return graph, poses, list(marks), seen[-32:]


def solved(graph, held=(), **settings):
    solver = Solver(graph, Settings(**settings))
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    for vertex in held:
        solver.hold(vertex)
    solver.optimize(replace(solver.settings, **TIGHT))
    return solver


def stored(solver, vertices):
    return np.concatenate([solver.values[solver.graph.vertex(vertex).stored] for vertex in vertices])


@each("held", [(), (4,), (2, 7)])
@each("seed", [0, 1])
def test_where_all_is_linear_it_is_the_solution_anew(seed, held):
    graph, loop = vectors(np.random.default_rng(seed))
    found, wanted = solved(graph, held=held), [7, 0, 23, 12]
    values, covariance = found.joint_marginal_without(wanted, loop)
    anew = Solver(graph)
    anew.add(range(STEPS), [edge for edge in range(graph.edge_count) if edge not in loop])
    anew.start_at(found.values)  # the held ones stay where they are
    for vertex in held:
        anew.hold(vertex)
    anew.optimize(Settings(**TIGHT))
    assert values == pytest.approx(stored(anew, wanted), abs=1e-9)
    assert covariance == pytest.approx(anew.joint_marginal(wanted), abs=1e-12)
    assert np.array_equal(covariance, covariance.T)


@each("losses", [{}, {"landmarks": [Loss(HUBER, 1.0)]}])
def test_it_is_the_dense_inverse_without_what_the_edges_say(losses):
    graph, poses, marks, seen = drive(np.random.default_rng(3))
    solver = solved(graph, losses=losses)
    wanted = [poses[15], *marks]
    values, covariance = solver.joint_marginal_without(wanted, seen)
    before = solver.values
    graph.set_weights(np.array(seen), 0.0)
    anew = Solver(graph, Settings(losses=losses))
    anew.add(range(graph.vertex_count), range(graph.edge_count))
    anew.start_at(before)
    dense = np.linalg.inv(anew.information_matrix())
    first = np.cumsum([0] + [graph.kind_of(v).dof for v in range(graph.vertex_count)])
    rows = np.concatenate([np.arange(first[v], first[v + 1]) for v in wanted])
    sigmas = np.sqrt(np.diag(dense)[rows])
    assert np.abs((covariance - dense[np.ix_(rows, rows)]) / np.outer(sigmas, sigmas)).max() < 1e-7
    anew.optimize(Settings(losses=losses, max_iterations=1))  # one step
    assert (np.abs(stored(anew, wanted) - stored(solver, wanted)) / sigmas).max() > 0.3  # there is something to find
    assert (np.abs(values - stored(anew, wanted)) / sigmas).max() < 0.05  # which is damped a little


def test_what_only_these_edges_determine_is_refused_and_nothing_has_changed():
    graph, _, marks, _ = drive(np.random.default_rng(4))
    every = [edge for edge in graph.edges_of("landmarks").tolist() if marks[0] in graph.edge(edge).vertices]
    solver = solved(graph)
    before, eliminated = solver.values, solver.joint_marginal(marks)
    with pytest.raises(SingularError, match="do not determine"):
        solver.joint_marginal_without([marks[0]], every)
    assert np.array_equal(solver.values, before)
    assert np.array_equal(solver.joint_marginal(marks), eliminated)
