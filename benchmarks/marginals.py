"""All marginals of a graph in one call: against the dense inverse, against GTSAM's, and against one batch iteration.

``python -m benchmarks.marginals [FILE ...]``. Covariances are of the file's graph at its optimum, the first pose held
by a prior of 1 mm and 1 mrad, and differences are parts of the largest variance of each vertex's block.

* ``dense`` : of graphs of up to 500 vertices, and the first poses of larger ones: from the inverse of H, all edges
  linearised anew. Rounding may cost 100 eps cond(H).
* ``gtsam`` : GTSAM minimises another error map, which has the same derivatives where residuals are zero; so for both
  the measurements are those that the optimum predicts, with the noise of the file. Its position and rotation of poses
  in space are put into our order. Times are CPU times of reading all covariances from what is factored already.
* ``iteration`` : the CPU time of one Gauss-Newton iteration over all, linearised, factored and solved anew.
"""

import argparse
from pathlib import Path

from benchmarks import covariances, fresh, options, table


def main() -> None:
    """The programme."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="graphs (default: all that are at hand)")
    parser.add_argument("--poses", type=int, metavar="N", help="the first N poses of each graph only")
    parser.add_argument(
        "--against", default="dense,gtsam,iteration", metavar="NAME,...", help="dense, gtsam, iteration"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the results there as well")
    args = parser.parse_args()
    functions = {"dense": covariances.dense, "gtsam": covariances.of_gtsam, "iteration": covariances.iteration}
    rows = []
    for problem in options.problems(args):
        for name in args.against.split(","):
            try:
                rows.append(fresh.call(functions[name], problem))
                options.say(f"{problem.name}: {rows[-1]}")
            except fresh.Crashed as error:
                options.say(f"{problem.name}, {name}: {error}")
    table.finish(table.results("marginals", rows), args.json)


if __name__ == "__main__":
    main()
