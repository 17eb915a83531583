"""All marginals of a graph in one call: against GTSAM's, and the time that both take.

``python -m benchmarks.marginals [FILE ...]``. Covariances are of the file's graph at its optimum, the first pose held
by a prior of 1 mm and 1 mrad, and differences are parts of the largest variance of each vertex's block. GTSAM minimises
another error map, which has the same derivatives where residuals are zero; so for both the measurements are those that
the optimum predicts, with the noise of the file. Times are CPU times of reading all covariances from what is factored
already.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import fresh, marginals, options, table
from benchmarks.contenders.ours import graph_of
from benchmarks.problem import Array, Edges, Index, Problem
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import POSE_PRIOR, POSE_PRIOR_3D, Gaussian
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver import Settings, Solver

_BOUND = 1e-6  # of a difference
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

    @classmethod
    def of(cls, problem: Problem) -> "Ours":
        """At the optimum, with a prior on the first pose."""
        graph, poses, points = graph_of(problem)
        prior, dof = (POSE_PRIOR, 3) if problem.planar else (POSE_PRIOR_3D, 6)
        noise = Gaussian.from_sigmas(*[_ANCHOR] * dof)
        graph.add_edge(prior, poses[:1], tuple(problem.poses[0].tolist()), noise, "anchor")
        solver = Solver(graph)
        solver.add(range(graph.vertex_count), range(graph.edge_count))
        if not solver.optimize(_TO_CONVERGE).converged:
            raise GraphSlamError(f"{problem.name}: not converged")
        return cls(solver, poses, points)

    def read(self) -> tuple[float, list[Array]]:
        """Median CPU time of all marginals, poses before landmarks, after a rehearsal; and what came out."""
        vertices = np.concatenate([self.poses, self.points])
        out, taken = self.solver.marginal(vertices), []
        for _ in range(_REPETITIONS):
            begin = time.process_time()
            out = self.solver.marginal(vertices)
            taken.append(time.process_time() - begin)
        return float(np.median(taken)), out

    def predicted(self, problem: Problem) -> Problem:
        """The problem at this optimum, with measurements that agree with it; the noise stays."""
        group = se2 if problem.planar else se3
        poses, points, seen = self.solver.estimate(self.poses), problem.landmarks, problem.sightings
        i, j = (tuple(poses[ends].T) for ends in problem.relative.ends.T)
        relative = replace(problem.relative, measured=np.stack(group.between(i, j), axis=1))
        if len(seen):
            points = self.solver.estimate(self.points)
            at = se2.act(se2.inverse(tuple(poses[seen.ends[:, 0]].T)), tuple(points[seen.ends[:, 1]].T))
            seen = Edges(seen.ends, np.stack(at, axis=1), seen.root)
        return replace(problem, poses=poses, landmarks=points, relative=relative, sightings=seen)


def row(problem: Problem) -> table.Row:
    """A line of the table."""
    import gtsam

    from benchmarks.contenders import gtsam_words as words

    alike = Ours.of(problem).predicted(problem)
    ours_s, ours = Ours.of(alike).read()
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
        "ours, CPU ms": f"{1e3 * ours_s:.2f}",
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
