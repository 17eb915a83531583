"""The command ``report``: one HTML file on a run."""

import argparse
import gc
from pathlib import Path

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.usage import CommandParser
from graph_slam_ros.errors import GraphSlamError


def report_options(sub: CommandParser) -> None:
    """Add the options of ``report``."""
    arguments.add_run(sub)
    sub.add_argument(
        "--out", type=Path, metavar="FILE.html", help="file of the report (default: report.html in the run folder)"
    )
    arguments.add_shown(sub)
    arguments.add_force(sub)


def report(args: argparse.Namespace) -> int:
    """Write the report on a run."""
    from graph_slam_ros.runs.folder import REPORT, is_own_page
    from graph_slam_ros.tools.report import write_report

    if not args.truth and (args.topic or args.no_align):
        raise GraphSlamError("report: no use for --topic or --no-align without --truth")
    out = args.out or args.run_folder / REPORT
    try:
        console.check_file(out, force=args.force or is_own_page(out, args.run_folder))
    except OSError as error:
        raise GraphSlamError(f"{out}: {error.strerror}") from None
    gc.disable()  # a map is a million small objects that all stay: to look through them is a sixth of the time
    made = write_report(args.run_folder, out, args.truth, args.compare, args.plan, args.topic, align=not args.no_align)
    gc.freeze()  # nor at the end of the process
    console.show(*made.data["sentences"] or (), f"report in {out}")
    console.then(f"open {out} in a browser: it needs no network")
    return console.report_losses(made.losses, made.beware)
