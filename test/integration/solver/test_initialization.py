"""Starts that do not need the file's values: spanning tree, chordal, online, in the plane and in space."""

import functools

import numpy as np
import pytest
from places import DATASETS
from reliability import times
from rows import each

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import LANDMARK_POSITION, R2, RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3, Gaussian, Graph
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.optimization import optimize
from graph_slam_ros.solver import Settings, Solver, initial_values
from graph_slam_ros.tools.simulation import city_graph

GRAPHS = DATASETS
GRAPHS = GRAPHS / "pose_graphs"


def solved(graph, method):
    solver = Solver(graph, Settings(max_iterations=50))
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    solver.start_at(initial_values(graph, method, 0))
    solver.hold(0)
    return solver.optimize()


def exact_graph(seed, kind, edge, group, dof):
    """Random poses and a landmark where the plane has one, without noise and with initial values of nonsense."""
    rng = np.random.default_rng(seed)
    truth = [group.exp(tuple(d)) for d in rng.normal(size=(12, dof))]
    graph = Graph()
    ids = graph.add_vertices(kind, [truth[0]] + [group.IDENTITY] * 11)
    pairs = [(i, i + 1) for i in range(11)] + [(0, 5), (7, 2), (11, 3)]
    noise = Gaussian.from_sigmas(*[0.1] * dof)
    for i, j in pairs:
        graph.add_edge(edge, [ids[i], ids[j]], group.between(truth[i], truth[j]), noise, "odometry")
    return graph, np.array(truth)


@each("method", ["tree", "chordal", "online"])
@pytest.mark.parametrize(
    ("kind", "edge", "group", "dof"), [(SE2, RELATIVE_POSE, se2, 3), (SE3, RELATIVE_POSE_3D, se3, 6)], ids=["2D", "3D"]
)
def test_without_noise_the_start_is_the_truth(method, kind, edge, group, dof):
    graph, truth = exact_graph(3, kind, edge, group, dof)
    found = initial_values(graph, method, 0).reshape(truth.shape)
    apart = kind.local(found, truth)
    assert np.abs(apart).max() < 1e-9


def test_a_landmark_is_placed_by_its_first_sighting():
    graph, truth = exact_graph(4, SE2, RELATIVE_POSE, se2, 3)
    landmark = graph.add_vertex(R2, [0, 0])
    noise = Gaussian.from_sigmas(0.1, 0.1)
    graph.add_edge(LANDMARK_POSITION, [6, landmark], [1.0, 2.0], noise, "landmarks")
    graph.add_edge(LANDMARK_POSITION, [2, landmark], [9.0, 9.0], noise, "landmarks")
    assert np.allclose(initial_values(graph, "tree", 0)[-2:], se2.act(tuple(truth[6]), (1.0, 2.0)))


def test_poses_that_nothing_joins_are_named():
    graph, _ = exact_graph(5, SE2, RELATIVE_POSE, se2, 3)
    lost = graph.add_vertex(SE2, [0, 0, 0])
    with pytest.raises(GraphSlamError, match=f"vertex {lost}"):
        initial_values(graph, "tree", 0)


def test_an_unknown_start_is_refused_with_the_choices():
    graph, _ = exact_graph(6, SE2, RELATIVE_POSE, se2, 3)
    with pytest.raises(GraphSlamError, match="chordal"):
        initial_values(graph, "magic", 0)


POSES = times(800, 1500)
FACTORS = times([5.0], [2.0, 5.0, 10.0])


@pytest.mark.parametrize("factor", FACTORS)
def test_a_city_with_bad_odometry_reaches_one_optimum_from_either_start(factor):
    graph, _ = city_graph(seed=1, poses=POSES, blocks=20, odometry_noise_factor=factor)
    tree, chordal = solved(graph, "tree"), solved(graph, "chordal")
    assert tree.chi2_final == pytest.approx(chordal.chi2_final, rel=1e-6)
    assert tree.chi2_final < 1.2 * (3 * graph.edge_count - 3 * graph.vertex_count)  # about its degrees of freedom


@pytest.mark.parametrize("start", times(["online"], ["tree", "chordal", "online"]))
@pytest.mark.parametrize("factor", FACTORS)
def test_a_city_with_bad_odometry_comes_to_what_online_updates_come_to(factor, start):
    graph, _ = city_graph(seed=1, poses=POSES, blocks=20, odometry_noise_factor=factor)
    batch = solved(graph, start)
    assert batch.chi2_final == pytest.approx(online(factor), rel=1e-4)


@functools.cache
def online(factor):
    """Chi2 after an update for each pose."""
    graph, _ = city_graph(seed=1, poses=POSES, blocks=20, odometry_noise_factor=factor)
    newest = next(iter(graph.tables.values())).vertices.values.max(axis=1)
    solver = Solver(graph)
    for k in range(graph.vertex_count):
        solver.add([k], np.flatnonzero(newest == k))
        if k == 0:
            solver.hold(0)
        solver.update()
    return solver.evaluate().chi2_final


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
@pytest.mark.parametrize(
    ("name", "optimum"),
    [("input_INTEL", 215.83023), *times([], [("M3500", 137.91295), ("sphere2500", 1351.362)])],
)
def test_public_graphs_reach_their_optimum_from_a_chordal_start(name, optimum):
    assert solved(read_g2o(GRAPHS / f"{name}.g2o", raw=True).graph, "chordal").chi2_final == pytest.approx(
        optimum, 1e-6
    )


@pytest.mark.skipif(not times(0, 1), reason="only in make soak")
@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
def test_a_graph_of_landmarks_that_no_other_start_solves_is_driven_through():
    solution = optimize(GRAPHS / "victoria_park.txt", Settings(max_iterations=50), init="online")
    assert solution.report.converged
    assert solution.report.chi2_final == pytest.approx(6184.12, rel=1e-5)


def test_a_pose_that_nothing_joins_to_an_earlier_one_is_named():
    graph, _ = exact_graph(5, SE2, RELATIVE_POSE, se2, 3)
    with pytest.raises(GraphSlamError, match="joins vertex 3 to an earlier one"):
        initial_values(graph, "online", 0, [0, 3, 1, 2, *range(4, 12)])


def test_a_vertex_is_placed_only_before_it_is_in_the_problem():
    graph, _ = exact_graph(5, SE2, RELATIVE_POSE, se2, 3)
    solver = Solver(graph)
    solver.place(3, [1.0, 2.0, 0.5])
    assert solver.estimate([3])[0].tolist() == [1.0, 2.0, 0.5]
    for value in ([1.0, 2.0], [1.0, np.nan, 0.0]):
        with pytest.raises(GraphSlamError, match="vertex 3: expected 3 finite numbers"):
            solver.place(3, value)
    solver.add([3], [])
    with pytest.raises(GraphSlamError, match="vertex 3 is in the problem"):
        solver.place(3, [1.0, 2.0, 0.5])
    with pytest.raises(GraphSlamError, match="vertex 99 does not exist"):
        solver.place(99, [1.0, 2.0, 0.5])
