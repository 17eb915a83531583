"""Edges of odometry that were replaced: by a slip, by a displacement."""

import numpy as np
import pytest

from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.slam.robust.hypotheses import _along_odometry
from graph_slam_ros.slam.robust.pairwise_consistency import odometry_in_use

STEP, EXACT = (1.0, 0.0, 0.0), Gaussian.from_sigmas(0.01, 0.01, 0.01)


def test_the_path_by_odometry_alone_goes_along_what_replaced_an_edge():
    graph = Graph()
    path = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 50.0, 0.0), (3.0, 50.0, 0.0), (4.0, 50.0, 0.0)]
    vertices = [graph.add_vertex(PLANAR.pose, pose) for pose in path]
    ends = [vertices[k : k + 2] for k in range(4)]
    edges = [graph.add_edge(PLANAR.relative_pose, pair, STEP, EXACT, "odometry", "odom") for pair in ends]
    graph.set_weights(np.array(edges[1:2]), 0.0)
    loose = Gaussian.from_sigmas(10.0, 10.0, 3.0)
    graph.add_edge(PLANAR.relative_pose, vertices[1:3], (1.0, 50.0, 0.0), loose, "odometry", "odom")
    assert odometry_in_use(graph).tolist() == [0, 4, 2, 3]
    found = _along_odometry(graph, graph.initial.values, set())
    assert found.reshape(-1, 3) == pytest.approx(np.array(path))
