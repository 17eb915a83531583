"""How the time of an update grows with the graph, in our simulator's Manhattan: ours and iSAM2.

``python -m benchmarks.growth``. Streets of 60 by 60 blocks are driven without end, a closure per three poses once they
are revisited. The path is not read: what is measured is the update and the newest pose.
"""

import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

if not __package__:  # run as a script: what it imports is in the repository, not in its folder
    sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks import fresh, options, table
from benchmarks.contenders import ONLINE_PEERS, OURS
from benchmarks.drive import Drive, drive
from benchmarks.fresh import ROOT
from benchmarks.problem import Problem, city_problem
from graph_slam_ros.colours import LIGHT

PICTURE = ROOT / "docs/growth.png"
COLOURS = [LIGHT[name] for name in ("estimate", "odometry", "truth", "landmarks", "closures")]  # ours is the first
_WINDOWS_PER_DECADE = 6
_SMALLEST = 300


def measure(poses: int, peer_poses: int, peers: Sequence[str], patience_s: float) -> list[table.Row]:
    """Rows of all contenders in all windows."""
    rows: list[table.Row] = []
    problem = city_problem(poses)
    for name in (OURS, *peers):
        mine = problem if name == OURS else problem.prefix(peer_poses)
        try:
            done = fresh.call(drive, name, mine, False, patience_s)
        except fresh.Crashed as error:
            done = Drive(np.zeros(0), fault=f"crashes: {error}")
        options.say(f"{mine.name}: {name} {len(done.step_s)} poses in {done.step_s.sum():.1f} s {done.fault}")
        rows += _windows(mine, name, done)
    return rows


def _windows(problem: Problem, name: str, done: Drive) -> Iterator[table.Row]:
    """Mean CPU time of steps without and with a closure, over sizes of the graph evenly spaced on a log axis."""
    if len(done.step_s) <= _SMALLEST:
        return
    edges = np.bincount(problem.relative.ends.max(axis=1), minlength=len(problem.poses))[: len(done.step_s)]
    decades = np.log10(len(done.step_s) / _SMALLEST)
    bounds = np.geomspace(_SMALLEST, len(done.step_s), max(2, round(_WINDOWS_PER_DECADE * decades) + 1)).astype(int)
    for start, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        seconds, closes = done.step_s[start:stop], edges[start:stop] > 1
        yield {
            "who": name,
            "from": start,
            "to": stop,
            "odometry_s": float(seconds[~closes].mean()) if (~closes).any() else None,
            "closure_s": float(seconds[closes].mean()) if closes.any() else None,
        }


def draw(rows: Sequence[table.Row], picture: Path = PICTURE) -> None:
    """Time per update over the size of the graph."""
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for colour, name in zip(COLOURS, dict.fromkeys(row["who"] for row in rows), strict=False):
        for key, style, about in (("closure_s", "o-", "with a closure"), ("odometry_s", "o:", "odometry alone")):
            mine = [row for row in rows if row["who"] == name and row[key] is not None]
            size = [np.sqrt(row["from"] * row["to"]) for row in mine]
            time_ms = [1e3 * row[key] for row in mine]
            axes.loglog(size, time_ms, style, color=colour, markersize=3, label=f"{name}, {about}")
    axes.set(xlabel="poses", ylabel="CPU time per update [ms]")
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    figure.savefig(picture, dpi=120)


def recorded() -> list[table.Row]:
    """The rows of the table in docs/benchmarks.md."""
    lines = re.findall(r"^\| (\d+) to (\d+) \| (\S+) \| (\S+) \| (\S+) \|$", table.DOCUMENT.read_text("utf-8"), re.M)

    def seconds(text: str) -> float | None:
        return None if text == "-" else 1e-6 * float(text)

    return [
        {"who": who, "from": int(low), "to": int(high), "odometry_s": seconds(plain), "closure_s": seconds(closure)}
        for low, high, who, plain, closure in lines
    ]


def main() -> None:
    """The programme."""
    parser = options.parser(__doc__, ONLINE_PEERS, ("isam2-10",))
    parser.add_argument("--redraw", action="store_true", help="only draw the table of docs/benchmarks.md again")
    options.add_patience(parser)
    parser.add_argument("--poses", type=int, default=100_000, metavar="N", help="for ours")
    parser.add_argument("--peer-poses", type=int, default=20_000, metavar="N", help="for the peers")
    parser.add_argument("--picture", type=Path, default=PICTURE, metavar="FILE.png")
    args = parser.parse_args()
    if args.redraw:
        return draw(recorded(), args.picture)
    rows = measure(args.poses, args.peer_poses, args.peers, args.patience)
    draw(rows, args.picture)
    table.finish(table.results("growth", rows), args.json)


if __name__ == "__main__":
    main()
