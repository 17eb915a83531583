"""The whole graph at once, from arrays in memory to convergence: ours, GTSAM, g2o and python-graphslam.

``python -m benchmarks.batch [FILE ...]``. All start from the file's values (along a tree where it has none) and end
when the cost changes by less than a millionth. Ordering and symbolic analysis are included, parsing is not; making the
library's own graph from arrays is, and is told apart, because the peers have to do it edge by edge from Python.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import contenders, fresh, judge, options, table
from benchmarks.contenders import BATCH_PEERS, OURS, OURS_AS_G2O, Solved
from benchmarks.problem import Problem


def race(problem: Problem, peers: Sequence[str], reps: int) -> list[table.Row]:
    """One row for ours and each peer."""
    names = [OURS, *peers]
    if not problem.planar and any(name.startswith("g2o") for name in peers):
        names.insert(1, OURS_AS_G2O)  # the problem that g2o solves
    solved: dict[str, list[Solved]] = {name: [] for name in names}
    for _ in range(reps):
        for name in names:
            if not solved[name] or _seconds(solved[name][0]) < options.SLOW_S:
                solved[name].append(_one(name, problem))
                options.say(f"{problem.name}: {name} {_seconds(solved[name][-1]):.3f} s {solved[name][-1].fault}")
    return [_row(problem, name, solved[name]) for name in names]


def _one(name: str, problem: Problem) -> Solved:
    try:
        return fresh.call(contenders.solve, name, problem, python=contenders.python_of(name))
    except fresh.Crashed as error:
        return Solved(fault=f"crashes: {error}")


def _seconds(solved: Solved) -> float:
    return solved.build_s + solved.solve_s


def _row(problem: Problem, name: str, solved: Sequence[Solved]) -> table.Row:
    last = solved[-1]
    return {
        "graph": problem.name,
        "poses": len(problem.poses),
        "edges": len(problem.relative) + len(problem.sightings),
        "who": name,
        "reps": len(solved),
        "total_s": float(np.median([_seconds(one) for one in solved])),
        "build_s": float(np.median([one.build_s for one in solved])),
        "solve_s": float(np.median([one.solve_s for one in solved])),
        "iterations": last.iterations,
        "chi2": judge.all_costs(problem, last.poses, last.landmarks),
        "error_map": contenders.error_map(name, problem.planar),
        "fault": last.fault,
        "reached": len(problem.poses),
        "whole": problem.whole,
    }


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__, BATCH_PEERS, ("gtsam-gn", "gtsam-lm", "g2o-gn"))
    options.add_files(parser)
    args = parser.parse_args()
    rows = []
    for problem in options.problems(args):
        rows += race(problem, args.peers, args.reps)
    table.finish(table.results("batch", rows), args.json)


if __name__ == "__main__":
    main()
