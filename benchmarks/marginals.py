"""All marginals of a graph in one call: against GTSAM's, and the time that both take.

``python -m benchmarks.marginals [FILE ...]``. Covariances are of the file's graph at its optimum, the first pose held
by a prior of 1 mm and 1 mrad, and differences are parts of the largest variance of each vertex's block. GTSAM minimises
another error map, which has the same derivatives where residuals are zero; so for both the measurements are those that
the optimum predicts, with the noise of the file. Times are CPU times of reading all covariances from what is factored
already.
"""

import time
from dataclasses import replace

import numpy as np

from benchmarks import fresh, marginals, options, table
from benchmarks.contenders.ours import graph_of
from benchmarks.problem import Edges, Index, Problem
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import POSE_PRIOR, POSE_PRIOR_3D, Gaussian
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver import Settings, Solver

_BOUND = 1e-6  # of a difference
_ANCHOR = 1e-3  # sigma [m, rad] of the prior on the first pose
_TO_CONVERGE = Settings(max_iterations=100, step_tolerance=1e-10, cost_tolerance=1e-14)
_REPETITIONS = 5
_OUR_ORDER = [3, 4, 5, 0, 1, 2]  # of GTSAM's rotation and position


def solved(problem: Problem) -> tuple[Solver, Index, Index]:
    """A graph of ours at its optimum, with a prior on the first pose; its poses and landmarks."""
    graph, poses, points = graph_of(problem)
    prior, dof = (POSE_PRIOR, 3) if problem.planar else (POSE_PRIOR_3D, 6)
    noise = Gaussian.from_sigmas(*[_ANCHOR] * dof)
    graph.add_edge(prior, poses[:1], tuple(problem.poses[0].tolist()), noise, "anchor")
    solver = Solver(graph)
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    if not solver.optimize(_TO_CONVERGE).converged:
        raise GraphSlamError(f"{problem.name}: not converged")
    return solver, poses, points


def predicted(problem: Problem) -> Problem:
    """The problem at its optimum, with measurements that agree with it; the noise stays."""
    solver, of_poses, of_points = solved(problem)
    group = se2 if problem.planar else se3
    poses, points, seen = solver.estimate(of_poses), problem.landmarks, problem.sightings
    i, j = (tuple(poses[ends].T) for ends in problem.relative.ends.T)
    relative = replace(problem.relative, measured=np.stack(group.between(i, j), axis=1))
    if len(seen):
        points = solver.estimate(of_points)
        at = se2.act(se2.inverse(tuple(poses[seen.ends[:, 0]].T)), tuple(points[seen.ends[:, 1]].T))
        seen = Edges(seen.ends, np.stack(at, axis=1), seen.root)
    return replace(problem, poses=poses, landmarks=points, relative=relative, sightings=seen)


def row(problem: Problem) -> table.Row:
    """A line of the table."""
    import gtsam

    from benchmarks.contenders import gtsam_words as words

    alike = predicted(problem)
    solver, *vertices = solved(alike)
    taken = []
    for _ in range(1 + _REPETITIONS):  # the first is a rehearsal
        begin = time.process_time()
        ours = solver.marginal(np.concatenate(vertices))
        taken.append(time.process_time() - begin)
    given = words.prepared(alike)
    marginals = gtsam.Marginals(*words.graph_of(given))
    keys = [*range(len(given.poses)), *map(words.landmark, range(len(given.landmarks)))]
    begin = time.process_time()
    theirs = [marginals.marginalCovariance(key) for key in keys]
    gtsam_s = time.process_time() - begin
    if not given.planar:
        theirs = [covariance[np.ix_(_OUR_ORDER, _OUR_ORDER)] for covariance in theirs]
    largest = max(float(np.abs(a - b).max() / b.diagonal().max()) for a, b in zip(ours, theirs, strict=True))
    return {
        "graph": problem.name,
        "largest difference": f"{largest:.1e}" + ", too large" * (largest > _BOUND),
        "ours, CPU ms": f"{1e3 * float(np.median(taken[1:])):.2f}",
        "gtsam, ms": f"{1e3 * gtsam_s:.2f}",
    }


def main() -> None:
    """The programme."""
    args, rows = options.parser(__doc__).parse_args(), list[table.Row]()
    for problem in options.problems(args):
        try:
            rows.append(fresh.call(marginals.row, problem))
            options.say(str(rows[-1]))
        except fresh.Crashed as error:
            options.say(f"{problem.name}: {error}")
    table.finish("marginals", rows, write=args.write)


if __name__ == "__main__":
    main()
