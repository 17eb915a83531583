"""The command ``report``: one HTML file on a run."""

import argparse
import gc
from pathlib import Path

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError


def report_options(sub: arguments.CommandParser) -> None:
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
    from graph_slam_ros.tools.report.contents import read_contents
    from graph_slam_ros.tools.report.page import plotly, write_report

    arguments.check_truth(args, "report")
    out = args.out or args.run_folder / REPORT
    if out.suffix != ".html":
        raise GraphSlamError(f"{out}: a report is a .html file")
    try:
        console.check_file(out, force=args.force or is_own_page(out, args.run_folder))
    except OSError as error:
        raise GraphSlamError(f"{out}: {error.strerror}") from None
    script = plotly()  # or it is refused, before the run is read
    gc.disable()  # a map is a million small objects that all stay: to look through them is a sixth of the time
    made = read_contents(args.run_folder, args.truth, args.compare, args.plan, args.topic, align=not args.no_align)
    write_report(made, script, out)
    gc.freeze()  # nor at the end of the process
    console.show(*made.data["sentences"] or (), f"report in {out}")
    console.then(f"open {out} in a browser: it needs no network")
    return console.report_losses(made.losses, made.beware)
