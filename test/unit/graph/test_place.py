"""Place edges: a pose and many points in one edge, in the solver and in g2o files."""

import numpy as np
import pytest

from graph_slam_ros import graph as g
from graph_slam_ros.errors import FormatError, GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import Gaussian, Graph, place_edge
from graph_slam_ros.lie import se3
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


def test_there_is_one_type_for_so_many_points_of_a_pose_and_none_for_others():
    assert place_edge(g.SE2, 4) is place_edge(g.SE2, 4, 0)
    for kind, points, poses in ((g.SE2, 0, 0), (g.R2, 3, 0), (g.SE3, 900, 100), (g.SE2, -1, 2)):
        with pytest.raises(GraphSlamError, match="a place edge of"):
            place_edge(kind, points, poses)


def solved(space, together, points=9, poses=6):
    """A drive past points, each seen by each pose: in one edge of the pose, or in an edge of its own for each."""
    pose, point, sighting = space
    rng = np.random.default_rng(4)
    there = 4.0 * rng.standard_normal((points, point.size))
    graph = Graph()
    solver = Solver(graph)
    marks, edges, before = [], [], None
    for k in range(poses):
        turn = (0.3 * k, 0.1, 0.2 * k) if pose is g.SE2 else se3.exp((0.3 * k, 0.1, 0.2, 0.1, 0.1 * k, 0.2))
        at = graph.add_vertex(pose, np.array(turn) if pose is g.SE2 else turn)
        new, fresh = [at], []
        if before is None:
            marks = graph.add_vertices(point, there + 0.3 * rng.standard_normal(there.shape)).tolist()
            new += marks
            prior = g.POSE_PRIOR if pose is g.SE2 else g.POSE_PRIOR_3D
            fresh.append(graph.add_edge(prior, [at], turn, Gaussian.from_sigmas(*[0.1] * pose.dof), "priors"))
        seen = 0.1 * rng.standard_normal(there.shape) + there
        roots = rng.standard_normal((points, point.size, point.size)) + 2.0 * np.eye(point.size)
        if together:
            whole = np.zeros((seen.size, seen.size))
            for m, root in enumerate(roots):
                low = m * point.size
                whole[low : low + point.size, low : low + point.size] = root
            seen_at = [at, *marks]
            fresh.append(graph.add_edge(place_edge(pose, points), seen_at, seen.ravel(), Gaussian(whole), "places"))
            edges.append([fresh[-1]])
        else:
            one_each = [[at, mark] for mark in marks]
            fresh += graph.add_edges(sighting, one_each, seen, Gaussian(roots), "landmarks").tolist()
            edges.append(fresh[-points:])
        solver.add(new, fresh)
        solver.update()
        before = at
    for edge in edges[2]:
        solver.set_weight(edge, 0.0)
    poses_at = np.flatnonzero(graph.kind.values == graph.kinds.index(pose))
    solver.remove(int(poses_at[2]))
    solver.update()
    kept = [int(poses_at[0]), *marks, int(poses_at[-1])]
    return solver.values, solver.joint_marginal(kept), solver.information_matrix()


def test_one_edge_of_many_points_is_worth_as_much_as_an_edge_for_each(space):
    for one, many in zip(solved(space, together=True), solved(space, together=False), strict=True):
        assert one == pytest.approx(many, rel=1e-8, abs=1e-9 * np.abs(many).max())


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


def test_a_line_with_too_few_points_names_itself(tmp_path):
    lines = "VERTEX_SE2 0 0 0 0\nVERTEX_XY 1 1 1\nEDGE_PLACE_SE2_XY:2 0 1 2\n"
    (tmp_path / "a.g2o").write_text(lines)
    with pytest.raises(FormatError, match=r"a\.g2o:3: EDGE_PLACE_SE2_XY:2"):
        read_g2o(tmp_path / "a.g2o")
