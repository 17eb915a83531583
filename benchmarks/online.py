"""One pose at a time: CPU time of every step and the final cost, for ours and for iSAM2.

``python -m benchmarks.online [FILE ...]``. After each pose both sides read the whole path as an array (``--no-path``:
the newest pose alone). New poses are predicted from the newest estimate and the odometry, landmarks from their first
sighting. Each repetition runs each contender in a fresh process, in turn.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import contenders, fresh, judge, options, table
from benchmarks.contenders import ONLINE_PEERS, OURS
from benchmarks.drive import Drive, drive
from benchmarks.problem import Problem


def race(problem: Problem, peers: Sequence[str], reps: int, read_path: bool, patience_s: float) -> list[table.Row]:
    """One row for ours and each peer."""
    names = [OURS, *peers]
    drives: dict[str, list[Drive]] = {name: [] for name in names}
    _one(OURS, problem.prefix(1000), read_path, patience_s)  # not counted: what is not yet compiled is compiled
    for _ in range(reps):
        for name in names:
            if not drives[name] or drives[name][0].step_s.sum() < options.SLOW_S:
                drives[name].append(_one(name, problem, read_path, patience_s))
                options.say(f"{problem.name}: {name} {drives[name][-1].step_s.sum():.2f} s {drives[name][-1].fault}")
    return [_row(problem, name, drives[name]) for name in names]


def _one(name: str, problem: Problem, read_path: bool, patience_s: float) -> Drive:
    try:
        return fresh.call(drive, name, problem, read_path, patience_s)
    except fresh.Crashed as error:
        return Drive(np.zeros(0), fault=f"crashes: {error}")


def _row(problem: Problem, name: str, drives: Sequence[Drive]) -> table.Row:
    """Medians over the repetitions; the estimate is the same in all of them."""
    last = drives[-1]
    reached = problem.prefix(len(last.step_s))
    steps = [one.step_s if len(one.step_s) else np.zeros(1) for one in drives]
    return {
        "graph": problem.name,
        "poses": len(problem.poses),
        "edges": len(problem.relative) + len(problem.sightings),
        "who": name,
        "reps": len(drives),
        "total_s": float(np.median([s.sum() for s in steps])),
        "median_s": float(np.median([np.median(s) for s in steps])),
        "p99_s": float(np.median([np.percentile(s, 99) for s in steps])),
        "worst_s": float(np.median([s.max() for s in steps])),
        "chi2": judge.all_costs(reached, last.poses, last.landmarks),
        "error_map": contenders.error_map(name, problem.planar),
        "fault": last.fault,
        "reached": len(reached.poses),
        "whole": reached.whole,
    }


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__, ONLINE_PEERS, ONLINE_PEERS)
    options.add_files(parser)
    options.add_patience(parser)
    parser.add_argument("--no-path", action="store_true", help="read the newest pose after each step, not the path")
    args = parser.parse_args()
    rows = []
    for problem in options.problems(args):
        rows += race(problem, args.peers, args.reps, not args.no_path, args.patience)
    programme, read = ("update", "the newest pose") if args.no_path else ("online", "the whole path")
    table.finish(table.results(programme, rows, f"{read} is read after each step"), args.json)


if __name__ == "__main__":
    main()
