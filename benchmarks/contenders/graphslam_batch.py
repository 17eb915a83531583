"""python-graphslam: NumPy edge by edge, for small graphs in the plane."""

import time

import numpy as np
from graphslam.edge.edge_odometry import EdgeOdometry
from graphslam.graph import Graph
from graphslam.pose.se2 import PoseSE2
from graphslam.vertex import Vertex

from benchmarks.contenders import MAX_ITERATIONS, TOLERANCE, Solved
from benchmarks.problem import Problem


def solve(problem: Problem, name: str) -> Solved:
    """All at once."""
    if not problem.planar or len(problem.landmarks):
        return Solved(fault="poses in the plane only")
    relative = problem.relative
    information = np.swapaxes(relative.root, 1, 2) @ relative.root
    begin = time.process_time()
    vertices = [Vertex(k, PoseSE2(pose[:2], pose[2])) for k, pose in enumerate(problem.poses)]
    edges = [
        EdgeOdometry(ends, weight, PoseSE2(measured[:2], measured[2]))
        for ends, weight, measured in zip(relative.ends.tolist(), information, relative.measured, strict=True)
    ]
    graph = Graph(edges, vertices)
    built = time.process_time()
    result = graph.optimize(tol=TOLERANCE, max_iter=MAX_ITERATIONS, verbose=False)
    done = time.process_time()
    fault = "" if result.converged else "not converged"
    poses = np.array([vertex.pose.to_array() for vertex in vertices])
    return Solved(built - begin, done - built, result.num_iterations, poses, np.empty((0, 2)), fault)
