"""Peak resident memory of a drive through our simulator's Manhattan: ours and iSAM2.

``python -m benchmarks.memory``. In the plane, and half as far in space. Counted from before the first pose, when all
code and the problem's arrays are loaded.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import fresh, options, table
from benchmarks.contenders import ONLINE_PEERS, OURS
from benchmarks.drive import Drive, drive
from benchmarks.problem import Problem, city_problem


def measure(poses: int, peers: Sequence[str], patience_s: float) -> list[table.Row]:
    """In each world one row for ours and each peer."""
    return [
        _one(problem, name, patience_s)
        for problem in (city_problem(poses), city_problem(poses // 2, dimensions=3))
        for name in (OURS, *peers)
    ]


def _one(problem: Problem, name: str, patience_s: float) -> table.Row:
    try:
        done = fresh.call(drive, name, problem, False, patience_s)
    except fresh.Crashed as error:
        done = Drive(np.zeros(0), fault=f"crashes: {error}")
    options.say(f"{problem.name}: {name} {done.peak_bytes / 1e6:.1f} MB {done.fault}")
    reached = problem.prefix(max(1, len(done.step_s)))
    sizes = {"poses": len(reached.poses), "edges": len(reached.relative)}
    return {"graph": problem.name, "who": name, **sizes, "peak_bytes": done.peak_bytes, "fault": done.fault}


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__, ONLINE_PEERS, ("isam2-10",))
    options.add_patience(parser)
    parser.add_argument("--poses", type=int, default=20_000, metavar="N")
    args = parser.parse_args()
    table.finish(table.results("memory", measure(args.poses, args.peers, args.patience)), args.json)


if __name__ == "__main__":
    main()
