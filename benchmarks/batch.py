"""The whole graph at once, from arrays in memory to convergence: ours, GTSAM and g2o.

``python -m benchmarks.batch [FILE ...]``. All start from the file's values (along a tree where it has none) and end
when the cost changes by less than a millionth. Making the library's own graph, ordering and symbolic analysis are
included, parsing is not.
"""

from collections.abc import Sequence

import numpy as np

from benchmarks import contenders, fresh, judge, options, table
from benchmarks.contenders import BATCH_PEERS, OURS, OURS_AS_G2O, Solved
from benchmarks.problem import Problem


def race(problem: Problem, peers: Sequence[str], reps: int) -> table.Row:
    """A line of the table: CPU seconds, and in brackets what part of a peer's ours takes."""

    def solve(name: str) -> Solved:
        return fresh.call(contenders.solve, name, problem, python=contenders.python_of(name))

    names = [OURS, *peers]
    if not problem.planar and "g2o-gn" in peers:
        names.append(OURS_AS_G2O)  # the problem that g2o solves
    options.say(problem.name)
    solved = options.in_turn(names, reps, solve)
    spent = {name: float(np.median([one.cpu_s for one in several])) for name, several in solved.items()}
    last = {name: several[-1] for name, several in solved.items()}
    costs = {name: judge.chi2(problem, one.poses, one.landmarks) for name, one in last.items()}
    row: table.Row = {"graph": problem.name}
    for name in (OURS, *peers):
        row[name] = options.told(spent[name], last[name].fault, costs[name])
        ours = OURS_AS_G2O if name == "g2o-gn" and OURS_AS_G2O in spent else OURS
        if name != OURS and not (last[ours].fault or last[name].fault):
            row[name] += f" ({spent[ours] / spent[name]:.2f})"
    return row | {"of best, ours": options.of_best(problem, list(costs.values()))[0]}


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__)
    options.add_repetitions(parser)
    options.add_peers(parser, BATCH_PEERS)
    args = parser.parse_args()
    rows = [race(problem, args.peers, args.reps) for problem in options.problems(args)]
    table.finish("batch", rows, write=args.write, note="once" if args.reps == 1 else "")


if __name__ == "__main__":
    main()
