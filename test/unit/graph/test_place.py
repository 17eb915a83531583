"""Place edges: a pose and many points in one edge, in the solver and in g2o files."""

import numpy as np
import pytest

from graph_slam_ros import graph as g
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import Gaussian, Graph, place_edge
from graph_slam_ros.solver import Solver

SPACES = {"plane": (g.SE2, g.R2, g.LANDMARK_POSITION), "space": (g.SE3, g.R3, g.LANDMARK_POSITION_3D)}


@pytest.fixture(params=SPACES)
def space(request):
    return SPACES[request.param]


def test_the_derivative_is_that_of_the_residual(space):
    for points, poses in ((1, 0), (5, 0), (0, 1), (2, 3)):
        edge = place_edge(space[0], points, poses)

        def measured(rng, size=edge.measured_size, poses=poses):
            numbers = rng.standard_normal(size)
            if space[0] is g.SE3 and poses:
                turns = numbers[-4 * poses :].reshape(poses, 4)
                turns /= np.linalg.norm(turns, axis=1, keepdims=True)
            return numbers

        g.check_edge(edge, measured, tolerance=1e-6)


def test_one_edge_of_many_points_is_worth_as_much_as_an_edge_for_each(space):
    pose, point, sighting = space
    rng, points, dof, size = np.random.default_rng(4), 9, pose.dof, point.size
    at = np.array(g.GROUPS[pose].exp(tuple(rng.standard_normal(dof))))
    there, seen = 4.0 * rng.standard_normal((2, points, size))
    x = np.concatenate([at, there.ravel()])
    begins = pose.size + size * np.arange(points)
    residual, jacobian = place_edge(pose, points).linearize(x, np.array([[0, *begins]]), seen.ravel()[None])
    ends = np.column_stack([np.zeros(points, dtype=int), begins])
    residuals, jacobians = sighting.linearize(x, ends, sighting.whole(seen))
    assert residual[0].reshape(points, size) == pytest.approx(residuals)
    blocks = jacobian[0].reshape(points, size, -1)
    assert blocks[:, :, :dof] == pytest.approx(jacobians[:, :, :dof])
    for k, block in enumerate(blocks[:, :, dof:].reshape(points, size, points, size)):
        assert block[:, k] == pytest.approx(jacobians[k, :, dof:])
        assert not np.delete(block, k, axis=1).any()


def test_it_is_written_to_g2o_and_read_back(space, tmp_path):
    pose, point, _ = space
    rng, graph = np.random.default_rng(1), Graph()
    at = graph.add_vertex(pose, [1.0, 2.0, 0.3] if pose is g.SE2 else [1, 2, 3, 0, 0, 0.6, 0.8])
    for points, poses in ((2, 0), (5, 0), (0, 1), (2, 2)):
        marks = graph.add_vertices(point, rng.standard_normal((points, point.size))).tolist()
        group = g.GROUPS[pose]
        tags = [group.exp(tuple(rng.standard_normal(pose.dof))) for _ in range(poses)]
        marks += [graph.add_vertex(pose, tag) for tag in tags]
        edge = place_edge(pose, points, poses)
        root = rng.standard_normal((edge.residual_size,) * 2)
        noise = Gaussian.from_information(root @ root.T + np.eye(len(root)))
        turns = [number for tag in tags for number in tag[point.size :]]
        positions = rng.standard_normal(point.size * (points + poses)).tolist()
        graph.add_edge(edge, [at, *marks], [*positions, *turns], noise, "places")
    write_g2o(tmp_path / "a.g2o", G2oFile(graph, list(range(graph.vertex_count))), Solver(graph).estimate)
    read = read_g2o(tmp_path / "a.g2o")
    assert not read.unknown and len(read.graph.edges_of("places")) == 4
    for edge in range(4):
        before, after = graph.edge(edge), read.graph.edge(edge)
        assert after.type is before.type
        assert [read.ids[v] for v in after.vertices] == list(before.vertices)
        assert after.measured == pytest.approx(before.measured, rel=1e-14)
        information = before.sqrt_information.T @ before.sqrt_information
        assert after.sqrt_information.T @ after.sqrt_information == pytest.approx(information, rel=1e-11, abs=1e-11)
