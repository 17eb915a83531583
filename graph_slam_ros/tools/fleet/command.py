"""The command ``fleet``: many recordings at once. Replays them, shows their table, compares two fleets."""

import argparse
import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from graph_slam_ros.cli import console, values
from graph_slam_ros.cli.usage import CODES, CommandParser
from graph_slam_ros.errors import GraphSlamError

_NEEDED = ("dask", "distributed", "fsspec", "pyarrow", "duckdb")
_MIB = 2**20
_MOST_NAMED = 20


def fleet(args: argparse.Namespace) -> int:
    """Run the command of ``fleet`` that was given."""
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise GraphSlamError(f"fleet needs {', '.join(missing)}: pip install 'graph_slam_ros[fleet]'")
    done: int = args.of_fleet(args)
    return done


def add_options(sub: CommandParser) -> None:
    """Add the commands of ``fleet`` and their options."""
    sub.codes = f"{CODES} 4: worse than --fail allows."
    commands = sub.add_subparsers(
        required=True, metavar="COMMAND", parser_class=CommandParser, help="fleet COMMAND --help has its options"
    )
    _add_replay(commands)
    _add_table(commands)
    _add_compare(commands)


def _command(commands: Any, name: str, run: Any, about: str, *examples: str) -> CommandParser:
    sub: CommandParser = commands.add_parser(
        name,
        help=about,
        description=f"{about[0].upper()}{about[1:]}.",
        examples=[f"graph_slam fleet {name} {one}" for one in examples],
    )
    sub.set_defaults(of_fleet=run)
    return sub


def _add_replay(commands: Any) -> None:
    sub = _command(
        commands,
        "replay",
        _replay,
        "replay many recordings with one or more configurations, on all cores; what is done is not done again",
        "drives/ --out fleet",
        "drives/ --out fleet --truth '{path}:/ground_truth' --set robust.noise_scale=configured,estimated",
    )
    sub.add_argument(
        "recordings", nargs="+", metavar="BAG", help="recordings, folders of them, s3:// or gs:// addresses"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results of the fleet")
    sub.add_argument(
        "--config",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        metavar="YAML",
        help="replay with each of these files",
    )
    sub.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=V1,V2",
        help="replay with each of these values of a parameter",
    )
    sub.add_argument(
        "--truth",
        default="",
        metavar="PATTERN",
        help="truth of each recording: {path}, {folder} and {stem} are replaced",
    )
    sub.add_argument("--report", action="store_true", help="write a report on each run")
    sub.add_argument(
        "--workers", type=values.count, default=0, metavar="N", help="processes (default: one for each core)"
    )
    sub.add_argument("--scheduler", default="", metavar="ADDRESS", help="Dask scheduler to use, as tcp://host:8786")
    sub.add_argument(
        "--limit", type=values.positive, default=3600.0, metavar="S", help="seconds for one run (default: 3600)"
    )
    sub.add_argument(
        "--memory", type=values.positive, default=0.0, metavar="MIB", help="memory for one run (default: any)"
    )


def _add_table(commands: Any) -> None:
    sub = _command(
        commands,
        "table",
        _table,
        "print the table of a fleet, or a part of it",
        "fleet",
        "fleet --where 'rmse_m > 0.1' --order 'rmse_m DESC'",
    )
    sub.add_argument("folder", type=Path, metavar="DIR", help="folder of the fleet")
    sub.add_argument("--where", default="", metavar="SQL", help="condition on the columns")
    sub.add_argument("--order", default="", metavar="SQL", help="columns to sort by")
    sub.add_argument("--most", type=values.count, default=1000, metavar="N", help="rows to print (default: 1000)")
    sub.add_argument("--columns", default="", metavar="A,B", help="columns to print; all prints all")


def _add_compare(commands: Any) -> None:
    sub = _command(
        commands,
        "compare",
        _compare,
        "compare two fleets recording by recording, and fail where the new one is worse",
        "last_week fleet",
        "last_week fleet --fail 'rmse>1.02x' --fail 'cpu>1.2x' --markdown summary.md",
    )
    sub.add_argument("old", type=Path, metavar="OLD", help="folder of the earlier fleet")
    sub.add_argument("new", type=Path, metavar="NEW", help="folder of the later fleet")
    sub.add_argument(
        "--fail",
        action="append",
        default=[],
        metavar="LIMIT",
        help="exit with 4 beyond it: METRIC>NUMBERx or METRIC>NUMBER",
    )
    sub.add_argument("--markdown", type=Path, metavar="FILE", help="write the comparison as Markdown")


def _replay(args: argparse.Namespace) -> int:
    from graph_slam_ros.tools.fleet.engine import Workers
    from graph_slam_ros.tools.fleet.page import write_page
    from graph_slam_ros.tools.fleet.replay import Fleet, replay_all

    if args.scheduler and args.workers:
        raise GraphSlamError("fleet replay: no use for --workers with --scheduler: its workers are there already")
    work = Fleet(
        args.recordings,
        args.out,
        args.config,
        args.set,
        args.truth,
        args.limit,
        int(args.memory * _MIB),
        args.report,
    )
    try:
        done = replay_all(work, Workers(args.scheduler, args.workers), _progress)
    except KeyboardInterrupt:
        console.warn(f"stopped: what is done is in {args.out}, and the same command goes on from there")
        return console.INTERRUPTED
    page = write_page(args.out, done.rows)
    for name in done.unreadable:
        console.warn(f"lost: {name}: cannot be read")
    for line in done.unreported:
        console.warn(f"no report: {line}", most=console.SENTENCE)
    for name, first in done.copies.items():
        console.warn(f"not replayed: {name}: a copy of {first}, which has the row")
    failed = [row for row in done.rows if row["state"] == "failed"]
    for row in failed[:_MOST_NAMED]:
        console.warn(f"failed: {row['recording']} ({row['setting']}): {row['reason']}", most=console.SENTENCE)
    if len(failed) > _MOST_NAMED:
        console.warn(f"failed: {len(failed) - _MOST_NAMED} more: graph_slam fleet table --where \"state = 'failed'\"")
    incomplete = [row for row in done.rows if row["state"] == "incomplete"]
    console.show(
        f"runs       {len(done.rows):8d}   of them {done.reused} were there",
        f"incomplete {len(incomplete):8d}   the table says why",
        f"failed     {len(failed):8d}",
        f"results in {args.out}: {page.name}, table.parquet",
    )
    console.then(f"{console.command('fleet', 'table', args.out, '--order', 'rmse_m DESC')} (the worst first)")
    return console.LOSSES if failed or incomplete or done.unreadable else console.DONE


def _progress(label: str) -> Any:
    """Return what wraps hashes or rows in a progress bar, which counts failed ones."""

    def bar(items: Iterable[Any], total: int) -> Iterator[Any]:
        failed, shown = 0, console.progress(label, " recordings" if label == "hash" else " runs")(items, total)
        for item in shown:
            if isinstance(item, dict) and item["state"] == "failed":
                failed += 1
                shown.set_postfix_str(f"{failed} failed")
            yield item

    return bar


def _table(args: argparse.Namespace) -> int:
    from graph_slam_ros.tools.fleet.store import Store
    from graph_slam_ros.tools.fleet.table import FIRST, read_table

    Store(args.folder)
    names = () if args.columns == "all" else args.columns.split(",") if args.columns else FIRST
    rows = read_table(args.folder, args.where, args.order, names, args.most + 1)
    if len(rows) > args.most:
        rows.pop()
        console.warn(f"these are {args.most} rows, and there are more: --most N prints N")
    if not rows:
        console.show("no rows")
        return console.DONE
    cells = [list(rows[0]), *([_cell(value) for value in row.values()] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(cells[0]))]
    for line in cells:
        console.show("  ".join(f"{cell:{width}s}" for cell, width in zip(line, widths, strict=True)).rstrip())
    return console.DONE


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else console.escaped(str(value))


def _compare(args: argparse.Namespace) -> int:
    from graph_slam_ros.formats.durable import write_whole
    from graph_slam_ros.tools.fleet.compare import compare, markdown, parse_limit

    console.check_file(args.markdown, force=False)
    done = compare(args.old, args.new, [parse_limit(text) for text in args.fail])
    text = markdown(done)
    if args.markdown is not None:
        write_whole(args.markdown, text.encode())
    console.show(f"{'metric':14s}{'runs':>6s}{'old':>10s}{'new':>10s}{'ratio':>8s}   95 %")
    for one in done.changes:
        low, high = one.interval
        numbers = f"{one.count:6d}{one.old:10.4g}{one.new:10.4g}{one.ratio:8.3f}   {low:.3f} to {high:.3f}"
        console.show(f"{one.metric:14s}{numbers}   {one.verdict}; most {one.worst[1]:.2f}x: {one.worst[0]}")
    for what, names in (("only in the old table", done.only_old), ("only in the new table", done.only_new)):
        if names:
            console.warn(f"not compared: {len(names)} {what}, as {names[0]}")
    for name in done.lost:
        console.warn(f"failed now, and not before: {name}", most=console.SENTENCE)
    for limit in done.exceeded:
        console.warn(f"exceeded: {limit}", most=console.SENTENCE)
    return console.DIFFERENT if done.lost or done.exceeded else console.DONE
