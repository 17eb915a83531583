"""Edge types against an example that is computed by hand; the graph's records and refusals."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import LANDMARK_POSITION, POSE_PRIOR, R2, RELATIVE_POSE, SE2, SE3, EdgeType, Gaussian, Graph

UNIT = Gaussian.from_sigmas(1.0, 1.0, 1.0)


# Two poses, one reading, and an information matrix that is neither isotropic nor diagonal.


def two_poses_and_a_point():
    graph = Graph()
    graph.add_vertices(SE2, np.zeros((2, 3)))
    graph.add_vertex(R2, [0.0, 0.0])
    graph.add_edge(RELATIVE_POSE, [0, 1], [1, 0, 0], UNIT, "odometry")
    return graph


@each(
    "edge, ends, measured, noise, culprit",
    [
        (RELATIVE_POSE, [[0, 1], [0, 7]], [[1, 0, 0]] * 2, UNIT, "vertex 7 does not exist"),
        (RELATIVE_POSE, [-1, 0], [1, 0, 0], UNIT, "vertex -1 does not exist"),
        (LANDMARK_POSITION, [0, 1], [1, 0], Gaussian.from_sigmas(1, 1), "vertex 1 is SE2, not R2"),
        (RELATIVE_POSE, [1, 1], [1, 0, 0], UNIT, "vertex 1 to itself"),
        (RELATIVE_POSE, [0, 1], [1, np.nan, 0], UNIT, r"\[1.0, nan, 0.0\] at vertices \[0, 1\]"),
        (POSE_PRIOR, [1], [np.inf, 0, 0], UNIT, r"\[inf, 0.0, 0.0\] at vertices \[1\]"),
        (RELATIVE_POSE, [0, 1], [1, 0, 0], Gaussian.from_sigmas(1, 1), r"noise of shape \(2, 2\)"),
        (RELATIVE_POSE, [0, 1], [1, 0, 0], Gaussian.from_information([np.eye(3)] * 2), r"noise of shape \(2, 3, 3\)"),
        (RELATIVE_POSE, [[0, 1], [1, 0]], [1, 0, 0], UNIT, "2 edges but 1 measurements"),
    ],
)
def test_an_edge_that_is_refused_is_named_and_leaves_no_trace(edge, ends, measured, noise, culprit):
    graph = two_poses_and_a_point()
    with pytest.raises(GraphSlamError, match=culprit):
        graph.add_edges(edge, np.atleast_2d(ends), np.atleast_2d(measured), noise, "closures")
    assert graph.edge_count == 1
    assert (list(graph.tables), graph.labels) == ([RELATIVE_POSE], ["odometry"])
    assert graph.add_edge(RELATIVE_POSE, [1, 0], [1, 0, 0], UNIT, "closures") == 1


@each(
    "add, complaint",
    [
        (lambda g: g.add_vertices(SE2, [[0, 0, 0], [0, np.nan, 0]]), r"\[0.0, nan, 0.0\] of vertex 4"),
        (lambda g: g.add_vertex(SE2, [1, 2, 3, 4, 5, 6]), r"SE2: values of shape \(1, 6\)"),
        (lambda g: g.add_vertices(SE2, [1, 2, 3, 4, 5, 6]), r"SE2: values of shape \(6,\)"),
        (lambda g: g.add_vertex(SE3, [0.0] * 7), "SE3: its quaternion is not of unit length"),
        (lambda g: g.add_edge(RELATIVE_POSE, [0, 1, 1, 0], [1, 0, 0] * 2, UNIT, "x"), r"vertices of shape \(1, 4\)"),
        (lambda g: g.add_edge(RELATIVE_POSE, [0, 1], [1, 0, 0] * 2, UNIT, "x"), r"measurements of shape \(1, 6\)"),
        (lambda g: g.add_edges(RELATIVE_POSE, [0, 1], [1, 0, 0], UNIT, "x"), r"vertices of shape \(2,\)"),
        (lambda g: g.add_edge(RELATIVE_POSE, [0.9, 1.2], [1, 0, 0], UNIT, "x"), "whole numbers"),
    ],
)
def test_numbers_are_not_taken_for_what_they_were_not_given_as(add, complaint):
    graph = two_poses_and_a_point()
    with pytest.raises(GraphSlamError, match=complaint):
        add(graph)
    assert (graph.vertex_count, len(graph.initial), graph.edge_count) == (3, 8, 1)


@each(
    "accepts, complaint",
    [
        ((), "0 vertices; an edge has at least one"),
        (((R2,), (R2, SE2)), "slot 1 takes R2, SE2: not kinds of one and the same dof"),
        (((R2,), ()), "slot 1 takes nothing"),
    ],
)
def test_an_edge_type_without_vertices_or_of_mixed_kinds_is_refused(accepts, complaint):
    with pytest.raises(GraphSlamError, match=complaint):
        EdgeType("odd", accepts, 1, 1, lambda x, at, z: (z, z))


def test_a_view_of_an_edge_and_of_a_vertex_has_what_was_added_and_cannot_change_it():
    graph = Graph()
    graph.add_vertices(SE2, [[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]])
    graph.add_vertex(R2, [7.0, 8.0])
    noise = Gaussian.from_sigmas(0.5, 0.25)
    graph.add_edge(RELATIVE_POSE, [0, 1], [1.0, 2.0, 0.5], UNIT, "odometry")
    graph.add_edge(LANDMARK_POSITION, [1, 2], [3.0, 4.0], noise, "landmarks", "/tags")
    assert graph.add_vertices(SE2, np.zeros((2, 3))).tolist() == [3, 4], "ids have no gap"
    graph.set_weights(np.array([1]), 0.5)
    edge, vertex = graph.edge(1), graph.vertex(1)
    assert (edge.id, edge.type, edge.vertices, edge.weight) == (1, LANDMARK_POSITION, (1, 2), 0.5)
    assert (edge.label, edge.source, graph.edge(0).source) == ("landmarks", "/tags", "")
    assert edge.measured.tolist() == LANDMARK_POSITION.whole([3.0, 4.0]).tolist()
    assert np.array_equal(edge.sqrt_information, noise.sqrt_information)
    assert (vertex.id, vertex.kind, vertex.initial.tolist()) == (1, SE2, [1.0, 2.0, 0.5])
    assert graph.initial.values[graph.vertex(2).stored].tolist() == [7.0, 8.0]
    edge.measured[:], edge.sqrt_information[:], vertex.initial[:] = 9.0, 9.0, 9.0
    assert graph.edge(1).measured[0] == 3.0
    assert np.array_equal(graph.edge(1).sqrt_information, noise.sqrt_information)
    assert graph.vertex(1).initial[0] == 1.0
    for one in (-1, 5):
        with pytest.raises(GraphSlamError, match=f"vertex {one} does not exist"):
            graph.vertex(one)
        with pytest.raises(GraphSlamError, match=f"edge {one} does not exist"):
            graph.edge(one)
