"""One pose at a time: CPU time of every step and the final cost, for ours and for iSAM2.

``python -m benchmarks.online [FILE ...]``. After each pose both sides read the newest (``--path``: all of them, as an
array). New poses are predicted from the newest estimate and the odometry, landmarks from their first
sighting. Each repetition runs each contender in a fresh process, in turn.
"""

import numpy as np

from benchmarks import fresh, judge, options, table
from benchmarks.contenders import ISAM2, OURS, Solved
from benchmarks.drive import drive
from benchmarks.problem import Problem

_PARTS = ("part", "p99, part", "worst, part")


def race(problem: Problem, reps: int, read_path: bool) -> dict[str, list[Solved]]:
    """The drives of ours and of iSAM2."""
    options.say(problem.name)
    fresh.call(drive, OURS, problem.prefix(1000), read_path)  # not counted: what is not yet compiled is compiled
    return options.in_turn([OURS, ISAM2], reps, lambda name: fresh.call(drive, name, problem, read_path))


def times(drives: list[Solved]) -> tuple[float, float, float]:
    """Medians over the repetitions of the whole time, the 99th percentile of steps, and the worst."""
    steps = [np.asarray(one.step_s) for one in drives if len(one.step_s)]
    per_drive = [(s.sum(), np.percentile(s, 99), s.max()) for s in steps]
    whole, p99, worst = np.median(per_drive, axis=0).tolist() if per_drive else (0.0, 0.0, 0.0)
    return whole, p99, worst


def row(problem: Problem, drives: dict[str, list[Solved]]) -> table.Row:
    """A line of the table; *part* is our time over iSAM2's."""
    last = {name: several[-1] for name, several in drives.items()}
    spent = {name: times(several) for name, several in drives.items()}
    costs = [judge.chi2(problem, one.poses, one.landmarks) for one in last.values()]
    best = options.of_best(problem, costs)
    found: table.Row = {"graph": problem.name, "poses, edges": f"{len(problem.poses)}, {problem.edges}"}
    for name, cost in zip(drives, costs, strict=True):
        found[f"{name}, CPU s"] = options.told(spent[name][0], last[name].fault, cost)
    is_void = any(one.fault for one in last.values())
    for name, ours, theirs in zip(_PARTS, spent[OURS], spent[ISAM2], strict=True):
        found[name] = "" if is_void else f"{ours / theirs:.2f}"
    return found | {"of best, ours": best[0], ISAM2: best[1]}


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__)
    options.add_repetitions(parser)
    parser.add_argument("--path", action="store_true", help="read the whole path after each step, not the newest pose")
    args = parser.parse_args()
    rows = [row(problem, race(problem, args.reps, args.path)) for problem in options.problems(args)]
    table.finish(
        "online-path" if args.path else "online", rows, write=args.write, note="once" if args.reps == 1 else ""
    )


if __name__ == "__main__":
    main()
