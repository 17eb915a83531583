"""All marginals of one graph in one call, and what they are compared with; see ``marginals``."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import table
from benchmarks.problem import Array, Edges, Index, Problem
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import (
    LANDMARK_POSITION,
    POSE_PRIOR,
    POSE_PRIOR_3D,
    R2,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    Gaussian,
    Graph,
)
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver import Settings, Solver

MOST_DENSE = 500  # vertices
BOUND_DENSE, BOUND_GTSAM, BOUND_TIME = 1e-9, 1e-6, 3.0
_ANCHOR = 1e-3  # sigma [m, rad] of the prior on the first pose
_TO_CONVERGE = Settings(max_iterations=100, step_tolerance=1e-10, cost_tolerance=1e-14)
_REPETITIONS = 5
_OUR_ORDER = [3, 4, 5, 0, 1, 2]  # of GTSAM's rotation and position


@dataclass(slots=True)
class Ours:
    """A graph of ours that is solved."""

    solver: Solver
    poses: Index
    points: Index

    @property
    def all(self) -> Index:
        """Its vertices: poses, then landmarks."""
        return np.concatenate([self.poses, self.points])


def solved(problem: Problem) -> Ours:
    """At the optimum, with a prior on the first pose."""
    planar = problem.planar
    kind, edge, prior = (SE2, RELATIVE_POSE, POSE_PRIOR) if planar else (SE3, RELATIVE_POSE_3D, POSE_PRIOR_3D)
    graph = Graph()
    poses = graph.add_vertices(kind, problem.poses)
    points = graph.add_vertices(R2, problem.landmarks) if len(problem.landmarks) else np.empty(0, dtype=np.int64)
    graph.add_edges(edge, poses[problem.relative.ends], problem.relative.measured, Gaussian(problem.relative.root), "e")
    if len(problem.sightings):
        ends = np.column_stack([poses[problem.sightings.ends[:, 0]], points[problem.sightings.ends[:, 1]]])
        graph.add_edges(LANDMARK_POSITION, ends, problem.sightings.measured, Gaussian(problem.sightings.root), "e")
    sigmas = [_ANCHOR] * kind.dof
    graph.add_edge(prior, poses[:1], tuple(problem.poses[0].tolist()), Gaussian.from_sigmas(*sigmas), "anchor")
    solver = Solver(graph)
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    if not solver.optimize(_TO_CONVERGE).converged:
        raise GraphSlamError(f"{problem.name}: not converged")
    return Ours(solver, poses, points)


def consistent(problem: Problem, ours: Ours) -> Problem:
    """The problem at our optimum, with measurements that agree with it; the noise stays."""
    group = se2 if problem.planar else se3
    poses, points = ours.solver.estimate(ours.poses), problem.landmarks
    i, j = (tuple(poses[ends].T) for ends in problem.relative.ends.T)
    relative = replace(problem.relative, measured=np.stack(group.between(i, j), axis=1))
    seen = problem.sightings
    if len(seen):
        points = ours.solver.estimate(ours.points)
        at = se2.act(se2.inverse(tuple(poses[seen.ends[:, 0]].T)), tuple(points[seen.ends[:, 1]].T))
        seen = Edges(seen.ends, np.stack(at, axis=1), seen.root)
    return replace(problem, poses=poses, landmarks=points, relative=relative, sightings=seen)


def dense(problem: Problem) -> table.Row:
    """Against the inverse of H."""
    problem = first_vertices(problem, MOST_DENSE)
    ours = solved(problem)
    h = ours.solver.information_matrix()
    inverse = np.linalg.inv(h)
    largest = _largest_difference(ours.solver.marginal(range(len(ours.all))), _blocks(inverse, ours.solver.graph))
    bound = max(BOUND_DENSE, 100.0 * float(np.finfo(float).eps * np.linalg.cond(h)))
    return _row(problem, "dense", difference=largest, bound=bound, fulfilled=largest <= bound)


def first_vertices(problem: Problem, most: int) -> Problem:
    """As many of the first poses as make so many vertices with the landmarks they see."""
    poses = min(len(problem.poses), most)
    while len(problem.prefix(poses).poses) + len(problem.prefix(poses).landmarks) > most:
        poses -= 1
    return problem.prefix(poses)


def of_gtsam(problem: Problem) -> table.Row:
    """Against GTSAM's Marginals, and the time that it takes."""
    import gtsam

    from benchmarks.contenders import gtsam_words as words

    alike = consistent(problem, solved(problem))
    ours = solved(alike)
    reading, found = _timed(lambda: ours.solver.marginal(ours.all))
    given = words.prepared(alike)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(given.poses.tolist()):
        values.insert(k, words.pose(pose))
    for k, point in enumerate(given.landmarks):
        values.insert(words.landmark(k), point)
    words.add_anchor(graph, given.poses[0])
    words.add_relative(graph, given.relative)
    words.add_sightings(graph, given.sightings)
    keys = [*range(len(given.poses)), *map(words.landmark, range(len(given.landmarks)))]
    begin = time.process_time()
    marginals = gtsam.Marginals(graph, values)
    made = time.process_time()
    theirs = [marginals.marginalCovariance(key) for key in keys]
    read = time.process_time()
    if not given.planar:
        theirs = [covariance[np.ix_(_OUR_ORDER, _OUR_ORDER)] for covariance in theirs]
    largest = _largest_difference(found, theirs)
    seconds = {"ours_s": reading, "gtsam_s": read - made, "gtsam_factored_s": made - begin}
    return _row(problem, "gtsam", difference=largest, bound=BOUND_GTSAM, fulfilled=largest <= BOUND_GTSAM) | seconds


def iteration(problem: Problem) -> table.Row:
    """All marginals against one iteration: two solves from one start, one of which makes two more iterations."""
    ours = solved(problem)
    start = ours.solver.graph.initial.values.copy()

    def batch(iterations: int) -> float:
        ours.solver.start_at(start)
        begin = time.process_time()
        ours.solver.optimize(replace(_TO_CONVERGE, max_iterations=iterations))
        return time.process_time() - begin

    batch(3)
    two_more = [batch(3) - batch(1) for _ in range(3 * _REPETITIONS)]
    one = float(np.median(two_more)) / 2.0
    ours.solver.start_at(start)
    ours.solver.optimize(_TO_CONVERGE)
    reading, _ = _timed(lambda: ours.solver.marginal(ours.all))
    times = {"ours_s": reading, "iteration_s": one}
    return _row(problem, "iteration", difference=None, bound=BOUND_TIME, fulfilled=reading <= BOUND_TIME * one) | times


def _timed(call: Callable[[], list[Array]]) -> tuple[float, list[Array]]:
    """Median CPU time after a rehearsal, and what came out."""
    out, taken = call(), []
    for _ in range(_REPETITIONS):
        begin = time.process_time()
        out = call()
        taken.append(time.process_time() - begin)
    return float(np.median(taken)), out


def _blocks(covariance: Array, graph: Graph) -> list[Array]:
    out, at = [], 0
    for vertex in range(graph.vertex_count):
        dof = graph.kind_of(vertex).dof
        out.append(covariance[at : at + dof, at : at + dof])
        at += dof
    return out


def _largest_difference(ours: Sequence[Array], theirs: Sequence[Array]) -> float:
    """Of any two entries, as a part of the largest variance of their block."""
    return max(float(np.abs(a - b).max() / b.diagonal().max()) for a, b in zip(ours, theirs, strict=True))


def _row(problem: Problem, against: str, **found: object) -> table.Row:
    size = {"poses": len(problem.poses), "edges": len(problem.relative) + len(problem.sightings)}
    return {"graph": problem.name, **size, "against": against, **found}
