"""Compile every kernel once, so that nothing is compiled while a robot drives."""

import time

import numpy as np

from graph_slam_ros.graph import (
    DIFFERENCE,
    HUBER,
    INVERSE_RELATIVE_POSE,
    LANDMARK_POSITION,
    LANDMARK_POSITION_3D,
    POINT_PRIOR,
    POSE_PRIOR,
    POSE_PRIOR_3D,
    R2,
    R3,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    TAG_POSITION,
    Gaussian,
    Graph,
    Loss,
)
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import METHODS, Settings, Solver


def warmup() -> float:
    """Solve a graph that has every edge type; returns the seconds it took (compilation is cached on disk)."""
    start = time.perf_counter()
    graph = Graph()
    poses = graph.add_vertices(SE2, np.zeros((2, 3)))
    points = graph.add_vertices(R2, np.zeros((2, 2)))
    planar, flat = Gaussian.from_sigmas(1.0, 1.0, 1.0), Gaussian.from_sigmas(1.0, 1.0)
    graph.add_edge(POSE_PRIOR, [poses[0]], [0, 0, 0], planar, "anchor")
    graph.add_edge(POINT_PRIOR[R2], [points[1]], [1, 1], flat, "anchor")
    for edge in (RELATIVE_POSE, INVERSE_RELATIVE_POSE):
        graph.add_edge(edge, poses, [1, 0, 0.1], planar, "odometry")
    graph.add_edge(LANDMARK_POSITION, [poses[0], points[0]], [1, 1], flat, "landmarks")
    graph.add_edge(TAG_POSITION, poses, [1, 0], flat, "landmarks")
    graph.add_edge(DIFFERENCE[R2], points, [1, 0], flat, "landmarks")
    space, far = graph.add_vertices(SE3, [[0, 0, 0, 0, 0, 0, 1.0]] * 2), graph.add_vertex(R3, [1, 0, 0])
    six, three = Gaussian.from_sigmas(*[1.0] * 6), Gaussian.from_sigmas(1.0, 1.0, 1.0)
    graph.add_edge(POSE_PRIOR_3D, [space[0]], [0, 0, 0, 0, 0, 0, 1], six, "anchor")
    graph.add_edge(RELATIVE_POSE_3D, space, [1, 0, 0, 0, 0, 0, 1], six, "odometry")
    for _ in range(2):
        graph.add_edge(LANDMARK_POSITION_3D, [space[0], far], [1, 1, 0], three, "landmarks")
    solver = Solver(
        graph, Settings(losses={"landmarks": [Loss(HUBER), Loss()]}, relinearize_above=0.0, relinearize_every=1)
    )
    edges = range(graph.edge_count - 1)
    solver.add(range(graph.vertex_count), edges)
    solver.update()
    solver.marginal([0])
    solver.estimate([0])
    solver.add([], [edges.stop])
    solver.update()
    solver.set_weight(edges.stop, 0.0)
    solver.hold(0)
    solver.update()
    for method in METHODS:
        solver.start_at(graph.initial.values)
        solver.optimize(Settings(method))
    se2.noise_during((1.0, 0.0, 0.1), np.eye(3))
    se2.propagate_during(np.eye(3), (1.0, 0.0, 0.1), np.eye(3))
    se2.propagate(np.eye(3), (1.0, 0.0, 0.1), np.eye(3))
    return time.perf_counter() - start
