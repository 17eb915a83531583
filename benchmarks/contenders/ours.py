"""graph_slam_ros itself."""

import time

import numpy as np

from benchmarks.contenders import MAX_ITERATIONS, OURS_AS_G2O, TOLERANCE, Solved
from benchmarks.problem import Array, Edges, Index, Problem, Step
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import (
    LANDMARK_POSITION,
    R2,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    EdgeType,
    Gaussian,
    Graph,
)
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.warmup import warmup

_HALVED = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])  # of the rotation vector, in the quaternion's vector part


class Online:
    """The incremental solver, which is given one pose at a time."""

    def __init__(self, problem: Problem) -> None:
        warmup()
        self.graph = Graph()
        self.solver = Solver(self.graph)
        self.kind, self.edge = (SE2, RELATIVE_POSE) if problem.planar else (SE3, RELATIVE_POSE_3D)
        self.poses, self.points = (np.zeros(len(x), dtype=np.int64) for x in (problem.poses, problem.landmarks))
        self.known, self.seen = 0, 0

    def prepared(self, problem: Problem) -> Problem:
        """The problem with measurements and noise in the form the library takes; not timed."""
        return problem

    def take(self, step: Step, pose: Array, landmarks: Array) -> None:
        """Take a step's pose and new landmarks at their predicted values, and its edges; be up to date after it."""
        graph = self.graph
        new = self.poses[step.pose : step.pose + 1] = graph.add_vertices(self.kind, pose[None])
        edges = self._add(self.edge, self.poses[step.relative.ends], step.relative)
        if len(step.sightings):
            if len(landmarks):
                points = self.points[step.landmarks.start : step.landmarks.stop] = graph.add_vertices(R2, landmarks)
                new = np.concatenate([new, points])
            at, point = step.sightings.ends.T
            ends = np.column_stack([self.poses[at], self.points[point]])
            edges = np.concatenate([edges, self._add(LANDMARK_POSITION, ends, step.sightings)])
        self.solver.add(new, edges)
        self.known, self.seen = step.pose + 1, step.landmarks.stop
        if step.pose == 0:
            self.solver.hold(int(new[0]))
        self.solver.update()

    def path(self) -> Array:
        """All poses so far as an array, in whatever numbers the library has for a pose."""
        return self.solver.estimate(self.poses[: self.known])

    def pose(self, index: int) -> Array:
        """One pose, (3,) or (7,)."""
        return self.solver.estimate(self.poses[index : index + 1])[0]

    def estimate(self) -> tuple[Array, Array]:
        """All poses, (n, 3) or (n, 7), and all landmarks, (n, 2)."""
        return self.path(), self.solver.estimate(self.points[: self.seen])

    def _add(self, edge: EdgeType, ends: Index, edges: Edges) -> Index:
        if not len(edges):
            return np.empty(0, dtype=np.int64)
        return self.graph.add_edges(edge, ends, edges.measured, Gaussian(edges.root), "edges")


def graph_of(problem: Problem, scale: Array | float = 1.0) -> tuple[Graph, Index, Index]:
    """A problem as a graph, and its poses and landmarks in it; noise of relative poses scaled by component."""
    kind, edge = (SE2, RELATIVE_POSE) if problem.planar else (SE3, RELATIVE_POSE_3D)
    graph, relative, seen = Graph(), problem.relative, problem.sightings
    poses = graph.add_vertices(kind, problem.poses)
    points = graph.add_vertices(R2, problem.landmarks) if len(problem.landmarks) else np.empty(0, dtype=np.int64)
    graph.add_edges(edge, poses[relative.ends], relative.measured, Gaussian(relative.root * scale), "edges")
    if len(seen):
        ends = np.column_stack([poses[seen.ends[:, 0]], points[seen.ends[:, 1]]])
        graph.add_edges(LANDMARK_POSITION, ends, seen.measured, Gaussian(seen.root), "edges")
    return graph, poses, points


def solve(problem: Problem, name: str) -> Solved:
    """All at once; ``OURS_AS_G2O`` weighs rotations in space as g2o's error map does."""
    begin = time.process_time()
    graph, poses, points = graph_of(problem, _HALVED if name == OURS_AS_G2O and not problem.planar else 1.0)
    solver = Solver(graph)
    settings = Settings(max_iterations=MAX_ITERATIONS, step_tolerance=TOLERANCE, cost_tolerance=TOLERANCE)
    try:
        solver.add(np.arange(graph.vertex_count), np.arange(graph.edge_count))
        solver.hold(int(poses[0]))
        report = solver.optimize(settings)
    except GraphSlamError as error:
        return Solved([time.process_time() - begin], fault=f"refuses: {error}")
    cpu_s = time.process_time() - begin
    fault = "" if report.converged else f"not converged: {report.stop}"
    return Solved([cpu_s], solver.estimate(poses), solver.estimate(points), fault)
