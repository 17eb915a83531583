"""Starts that do not need the file's values: spanning tree, chordal, online, in the plane and in space."""

import numpy as np
import pytest
from places import DATASETS
from reliability import times
from rows import each

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D, SE2, SE3, Gaussian, Graph
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.optimization import optimize
from graph_slam_ros.solver import Settings, Solver, initial_values
from graph_slam_ros.tools.simulation import city_graph

GRAPHS = DATASETS / "pose_graphs"


def test_what_cannot_be_a_start_is_named():
    graph, _ = exact_graph(5, SE2, RELATIVE_POSE, se2, 3)
    with pytest.raises(GraphSlamError, match="chordal"):
        initial_values(graph, "magic", 0)
    with pytest.raises(GraphSlamError, match="joins vertex 3 to an earlier one"):
        initial_values(graph, "online", 0, [0, 3, 1, 2, *range(4, 12)])
    lost = graph.add_vertex(SE2, [0, 0, 0])
    with pytest.raises(GraphSlamError, match=f"vertex {lost}"):
        initial_values(graph, "tree", 0)


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


POSES = times(500, 1500)


@pytest.mark.parametrize("factor", times([5.0], [2.0, 5.0, 10.0]))
def test_a_city_with_bad_odometry_reaches_one_optimum_from_any_start(factor):
    graph, _ = city_graph(seed=1, poses=POSES, blocks=20, odometry_noise_factor=factor)
    tree, *others = (solved(graph, start).chi2_final for start in ("tree", "chordal", "online"))
    assert others == pytest.approx([tree] * 2, rel=1e-4)
    assert tree < 1.2 * (3 * graph.edge_count - 3 * graph.vertex_count)  # about its degrees of freedom


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
@pytest.mark.parametrize(
    ("name", "optimum"), [("input_INTEL", 215.83023), *times([], [("M3500", 137.91295), ("sphere2500", 1351.362)])]
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
