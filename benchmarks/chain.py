"""What an odometry step costs: a chain of poses in the plane with one edge each, the newest pose read; ours and iSAM2.

``python -m benchmarks.chain``. Contenders take turns, each in a fresh process.
"""

import sys
from pathlib import Path

import numpy as np

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import fresh, options, table
from benchmarks.contenders import ONLINE_PEERS, OURS
from benchmarks.drive import drive
from benchmarks.problem import Edges, Problem
from graph_slam_ros.cli import arguments as values
from graph_slam_ros.lie import se2

_SIGMAS = 0.1, 0.1, 0.02  # [m, m, rad]
_EARLY = 1000  # poses


def chain(poses: int) -> Problem:
    """A robot that goes a metre at a time and turns at random."""
    rng, count, start = np.random.default_rng(0), poses - 1, [(0.0, 0.0, 0.0)]
    measured = np.array([1.0, 0.0, 0.0]) + rng.normal(size=(count, 3)) * [0.02, 0.02, 0.1]
    for motion in measured.tolist():
        start.append(se2.compose(start[-1], tuple(motion)))
    ends = np.column_stack([np.arange(count), np.arange(1, poses)])
    relative = Edges(ends, measured, np.tile(np.diag(np.reciprocal(_SIGMAS)), (count, 1, 1)))
    nothing = Edges(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    return Problem(f"chain{poses}", np.array(start), np.zeros((0, 2)), relative, nothing)


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__, ONLINE_PEERS, ("isam2-10",))
    options.add_patience(parser)
    parser.add_argument("--poses", type=values.count, default=3000, metavar="N")
    parser.add_argument("--reps", type=values.count, default=3, metavar="N")
    args = parser.parse_args()
    problem, rows = chain(args.poses), list[table.Row]()
    for repetition in range(args.reps):
        for who in (OURS, *args.peers):
            done = fresh.call(drive, who, problem, False, args.patience)
            us = 1e6 * done.step_s
            figures = {"mean": us.mean(), "median": np.median(us), "mean of the first 1000": us[1:_EARLY].mean()}
            row = {f"{name}, us": round(float(figure), 1) for name, figure in figures.items()}
            rows.append({"repetition": repetition, "who": who, **row})
    table.finish(table.results("chain", rows), args.json)


if __name__ == "__main__":
    main()
