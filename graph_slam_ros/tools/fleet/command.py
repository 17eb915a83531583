"""The commands ``fleet replay`` and ``fleet compare``: many recordings at once."""

import argparse
import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError

_NEEDED = ("dask", "distributed", "fsspec", "jinja2", "pyarrow")
_MIB = 2**20
_MOST_NAMED = 20


def _check_installed() -> None:
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise GraphSlamError(f"fleet needs {', '.join(missing)}: pip install 'graph_slam_ros[fleet]'")


def replay_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``fleet replay``."""
    about = "recordings, folders of them, s3:// or gs:// addresses"
    sub.add_argument("recordings", nargs="+", metavar="BAG", help=about)
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results of the fleet")
    about = "replay with each of these files"
    sub.add_argument("--config", type=Path, nargs="+", action="extend", default=[], metavar="YAML", help=about)
    about = "replay with each of these values of a parameter"
    sub.add_argument("--set", action="append", default=[], metavar="KEY=V1,V2", help=about)
    about = "truth of each recording: {path}, {folder} and {stem} are replaced"
    sub.add_argument("--truth", default="", metavar="PATTERN", help=about)
    sub.add_argument("--report", action="store_true", help="write a report on each run")
    about = "processes (default: one for each core)"
    sub.add_argument("--workers", type=arguments.count, default=0, metavar="N", help=about)
    sub.add_argument("--scheduler", default="", metavar="ADDRESS", help="Dask scheduler to use, as tcp://host:8786")
    about = "seconds for one run (default: 3600)"
    sub.add_argument("--limit", type=arguments.positive, default=3600.0, metavar="S", help=about)
    about = "memory for one run (default: any)"
    sub.add_argument("--memory", type=arguments.positive, default=0.0, metavar="MIB", help=about)


def compare_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``fleet compare``."""
    sub.codes = f"{arguments.CODES} 4: worse than --fail allows."
    sub.add_argument("old", type=Path, metavar="OLD", help="folder of the earlier fleet")
    sub.add_argument("new", type=Path, metavar="NEW", help="folder of the later fleet")
    about = "exit with 4 beyond it: METRIC>NUMBERx or METRIC>NUMBER"
    sub.add_argument("--fail", action="append", default=[], metavar="LIMIT", help=about)


def replay(args: argparse.Namespace) -> int:
    """Replay many recordings."""
    _check_installed()
    from graph_slam_ros.tools.fleet.page import write_page
    from graph_slam_ros.tools.fleet.replay import Fleet, replay_all

    if args.scheduler and args.workers:
        raise GraphSlamError("fleet replay: no use for --workers with --scheduler: its workers are there already")
    memory = int(args.memory * _MIB)
    work = Fleet(args.recordings, args.out, args.config, args.set, args.truth, args.limit, memory, args.report)
    try:
        rows, reused = replay_all(work, args.scheduler, args.workers, _progress)
    except KeyboardInterrupt:
        console.warn(f"stopped: what is done is in {args.out}, and the same command goes on from there")
        return console.INTERRUPTED
    page = write_page(args.out, rows)
    failed, incomplete = ([row for row in rows if row["state"] == state] for state in ("failed", "incomplete"))
    for row in failed[:_MOST_NAMED]:
        console.warn(f"failed: {row['recording']} ({row['setting']}): {row['reason']}", most=console.SENTENCE)
    if len(failed) > _MOST_NAMED:
        console.warn(f"failed: {len(failed) - _MOST_NAMED} more: {page} has them")
    console.show(
        f"runs       {len(rows):8d}   of them {reused} were there",
        f"incomplete {len(incomplete):8d}   the table says why",
        f"failed     {len(failed):8d}",
        f"results in {args.out}: {page.name}, table.parquet",
    )
    console.then(f"open {page} in a browser: the worst run first")
    return console.LOSSES if failed or incomplete else console.DONE


def _progress(rows: Iterable[Any], total: int) -> Iterator[Any]:
    """Yield rows below a progress bar, which counts failed ones."""
    failed, shown = 0, console.progress("replay", " runs")(rows, total)
    for row in shown:
        if row["state"] == "failed":
            failed += 1
            shown.set_postfix_str(f"{failed} failed")
        yield row


def compare(args: argparse.Namespace) -> int:
    """Compare two fleets."""
    _check_installed()
    from graph_slam_ros.tools.fleet.compare import EXCEEDED, LOST, markdown, parse_limit
    from graph_slam_ros.tools.fleet.compare import compare as compared

    done = compared(args.old, args.new, [parse_limit(text) for text in args.fail])
    console.show(*markdown(done).splitlines())
    wrong = [f"{title.lower()}: {name}" for title in (LOST, EXCEEDED) for name in done.notes[title]]
    for line in wrong:
        console.warn(line, most=console.SENTENCE)
    return console.DIFFERENT if wrong else console.DONE
