"""Thresholds of relinearisation follow what linearisation neglects, where noise is much smaller than stated."""

import numpy as np

from graph_slam_ros.graph import POSE_PRIOR_3D, RELATIVE_POSE_3D, SE3, Gaussian, Graph
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.solver import Solver

STEP_M, RING, POSES = 8.0, 30, 600


def truth():
    """Poses of a robot that circles a sphere from south to north."""
    radius = STEP_M * RING / (2.0 * np.pi)
    for k in range(POSES):
        around, up = 2.0 * np.pi * k / RING, 0.8 * np.pi * (k / POSES - 0.5)
        at = radius * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        turn = so3.compose(so3.exp((0.0, 0.0, around)), so3.exp((0.0, up, 0.0)))
        yield (*map(float, at), *map(float, turn))


def test_the_estimate_is_at_the_optimum_although_noise_is_a_thirtieth_of_what_is_stated():
    rng, noise, poses = np.random.default_rng(0), Gaussian.from_sigmas(*[1.0] * 6), list(truth())
    graph = Graph()
    solver = Solver(graph)

    def seen(i, j):
        error = se3.exp(tuple(rng.normal(0.0, 0.03, 6)))
        return se3.compose(se3.between(poses[i], poses[j]), error)

    for k in range(POSES):
        if k:
            z = seen(k - 1, k)
            start = se3.compose(tuple(solver.estimate([k - 1])[0]), z)
            graph.add_vertex(SE3, (*start[:3], *so3.normalize(start[3:])))
            edges = [graph.add_edge(RELATIVE_POSE_3D, [k - 1, k], z, noise, "odometry")]
        else:
            graph.add_vertex(SE3, poses[0])
            edges = [graph.add_edge(POSE_PRIOR_3D, [0], poses[0], noise, "anchor")]
        if k >= RING:
            edges.append(graph.add_edge(RELATIVE_POSE_3D, [k - RING, k], seen(k - RING, k), noise, "closures"))
        solver.add([k], edges)
        solver.update()
    now = solver.evaluate().chi2_final
    assert now - solver.optimize().chi2_final < 5e-4 * now
