"""The command ``evaluate``, and what commands show of a run beside their answer: its picture, and the next command."""

import argparse
import importlib.util
import json
from pathlib import Path
from typing import Any

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.errors import GraphSlamError


def evaluate_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``evaluate``."""
    arguments.add_run(sub)
    arguments.add_truth(sub, required=True)
    about = "trajectory to evaluate (default: sightings.tum; path.tum without observations)"
    sub.add_argument("--estimate", default="", metavar="FILE", help=about)
    arguments.add_json(sub, "the numbers")
    about = "file of the picture (default: path.png in the run folder)"
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help=about)
    arguments.add_force(sub)


def evaluate(args: argparse.Namespace) -> int:
    """Compare a run with the truth."""
    from graph_slam_ros.analysis.evaluation import evaluate as compared
    from graph_slam_ros.analysis.evaluation import input_topics
    from graph_slam_ros.analysis.trajectories import read_truth
    from graph_slam_ros.runs.folder import changed_since, summary_of
    from graph_slam_ros.runs.outcome import findings

    console.check_file(args.plot, force=args.force)
    truth = read_truth(args.truth, args.topic, input_topics(args.run_folder))
    scores = compared(args.run_folder, truth, args.estimate, align=not args.no_align)
    console.show(*([json.dumps(scores.as_dict())] if args.json else str(scores).split("\n")))
    draw(args.run_folder, truth, args.plot, align=not args.no_align, quiet=args.json)
    found = [str(one) for one in findings(summary_of(args.run_folder))[:1]]
    lost = console.report_losses(scores.losses, [*found, *scores.warnings, *changed_since(args.run_folder)])
    if not args.json:
        same = [*(("--topic", args.topic) if args.topic else ()), *(("--no-align",) if args.no_align else ())]
        with_truth = console.command("report", args.run_folder, "--truth", args.truth, *same)
        console.then(f"{with_truth} (one page: the map, its errors, and why each edge is in or out)")
    return console.LOSSES if scores.warnings else lost


def draw(run: Path, truth: Any = None, out: Path | None = None, *, align: bool = True, quiet: bool = False) -> None:
    """Draw a run in addition to other output. A failure to draw does not fail the command."""
    from graph_slam_ros.analysis.plots import draw_run
    from graph_slam_ros.runs.folder import PICTURE

    picture = out or run / PICTURE
    try:
        draw_run(run, truth, picture, align=align)
    except GraphSlamError as error:
        if out is not None:  # it was asked for
            raise
        return console.warn(f"no picture: {error}")
    if not quiet:
        console.show(f"picture in {picture}")


def suggest_next(run: Path, doubtful: Path | None = None, *same: str) -> None:
    """Name the next command. ``doubtful``: a recording with a warning, or incomplete; ``same``: its options."""
    if doubtful is not None:
        what = f"{console.command('check', doubtful, *same)} (what is wrong with the recording, and the remedy)"
        return console.then(what)
    if importlib.util.find_spec("plotly") is None:
        what = f"{console.command('explain', run)} (which measurements are believed, and why)"
    else:
        what = f"{console.command('report', run)} (one page: the map, and why each edge is in or out)"
    console.then(f"{what}; with a ground truth: {console.command('evaluate', run, '--truth', 'TRUTH')}")
