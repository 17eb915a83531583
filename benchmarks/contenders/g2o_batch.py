"""g2o's Gauss-Newton on sparse Cholesky factors, ended by its own action of the same rule."""

import time

import g2o
import numpy as np

from benchmarks.contenders import MAX_ITERATIONS, TOLERANCE, Solved
from benchmarks.problem import Array, Problem


def solve(problem: Problem, name: str) -> Solved:
    """All at once."""
    information = np.swapaxes(problem.relative.root, 1, 2) @ problem.relative.root
    of_sightings = np.swapaxes(problem.sightings.root, 1, 2) @ problem.sightings.root
    begin = time.process_time()
    optimizer = g2o.SparseOptimizer()
    optimizer.set_algorithm(_algorithm(problem))
    pose_vertex, pose_edge = (g2o.VertexSE2, g2o.EdgeSE2) if problem.planar else (g2o.VertexSE3, g2o.EdgeSE3)
    poses = [_vertex(optimizer, pose_vertex, k, _pose(values)) for k, values in enumerate(problem.poses)]
    points = [
        _vertex(optimizer, g2o.VertexPointXY, len(poses) + k, values) for k, values in enumerate(problem.landmarks)
    ]
    poses[0].set_fixed(True)
    relative, seen = problem.relative, problem.sightings
    for (i, j), measured, weight in zip(relative.ends.tolist(), relative.measured, information, strict=True):
        _edge(optimizer, pose_edge, poses[i], poses[j], _pose(measured), weight)
    for (i, j), measured, weight in zip(seen.ends.tolist(), seen.measured, of_sightings, strict=True):
        _edge(optimizer, g2o.EdgeSE2PointXY, poses[i], points[j], measured, weight)
    action = g2o.SparseOptimizerTerminateAction()
    action.set_gain_threshold(TOLERANCE)
    optimizer.add_post_iteration_action(action)
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    start = optimizer.active_chi2()
    iterations = optimizer.optimize(MAX_ITERATIONS)
    optimizer.compute_active_errors()
    end = optimizer.active_chi2()
    cpu_s = time.process_time() - begin
    fault = "" if end < start else "diverged"
    if iterations in (0, MAX_ITERATIONS):
        fault = fault or "not converged"
    landmarks = np.array([point.estimate() for point in points]).reshape(-1, 2)
    return Solved([cpu_s], _numbers(poses, problem.planar), landmarks, fault)


def _algorithm(problem: Problem) -> g2o.OptimizationAlgorithm:
    if len(problem.landmarks):
        blocks = g2o.BlockSolverX(g2o.LinearSolverEigenX())
    elif problem.planar:
        blocks = g2o.BlockSolverSE2(g2o.LinearSolverEigenSE2())
    else:
        blocks = g2o.BlockSolverSE3(g2o.LinearSolverEigenSE3())
    return g2o.OptimizationAlgorithmGaussNewton(blocks)


def _vertex(optimizer: g2o.SparseOptimizer, kind: type, index: int, value: object) -> "g2o.Vertex":
    vertex = kind()
    vertex.set_id(index)
    vertex.set_estimate(value)
    optimizer.add_vertex(vertex)
    return vertex


def _edge(
    optimizer: g2o.SparseOptimizer, kind: type, one: "g2o.Vertex", two: "g2o.Vertex", measured: object, weight: Array
) -> None:
    edge = kind()
    edge.set_vertex(0, one)
    edge.set_vertex(1, two)
    edge.set_measurement(measured)
    edge.set_information(weight)
    optimizer.add_edge(edge)


def _pose(values: Array) -> g2o.SE2 | g2o.Isometry3d:
    if len(values) == 3:
        return g2o.SE2(*values)
    x, y, z, w = values[3:]
    return g2o.Isometry3d(g2o.Quaternion(w, x, y, z), values[:3])


def _numbers(poses: "list[g2o.Vertex]", planar: bool) -> Array:
    if planar:
        return np.array([pose.estimate().to_vector() for pose in poses])
    found = [pose.estimate() for pose in poses]
    turned = [g2o.Quaternion(pose.rotation_matrix()) for pose in found]
    return np.array([[*p.position(), q.x(), q.y(), q.z(), q.w()] for p, q in zip(found, turned, strict=True)])
