"""The commands on the maps of runs: ``map diff``, ``map merge``, ``map freeze``."""

import argparse
import json
from pathlib import Path

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.usage import CODES, CommandParser


def diff_options(sub: CommandParser) -> None:
    """Add the options of ``map diff``."""
    sub.codes = f"{CODES} 4: they differ."
    sub.add_argument("a", type=Path, metavar="A", help="run folder")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    arguments.add_json(sub)


def diff(args: argparse.Namespace) -> int:
    """Print the differences between two runs' maps."""
    from graph_slam_ros.maps.diff import diff as compared

    losses: list[str] = []
    found = compared(args.a, args.b, losses)
    console.show(*([json.dumps(found.as_dict())] if args.json else found.lines()))
    if not args.json:
        merged = f"{console.command('map', 'merge', args.a, args.b, '--out', 'MERGED')} (one map of both)"
        cannot = f"nothing: they cannot be merged: {found.merge_trouble}" if found.merge_trouble else ""
        console.then("nothing: they are the same" if found.is_same else cannot or merged)
    return console.report_losses(losses) or (console.DONE if found.is_same else console.DIFFERENT)


def merge_options(sub: CommandParser) -> None:
    """Add the options of ``map merge``."""
    sub.add_argument("a", type=Path, metavar="A", help="run folder; the result has its map frame and configuration")
    sub.add_argument("b", type=Path, metavar="B", help="run folder")
    arguments.add_out(sub)


def merge(args: argparse.Namespace) -> int:
    """Make one map of two runs."""
    from graph_slam_ros.maps.merge import merge as merged
    from graph_slam_ros.runs import outcome

    done = merged(args.a, args.b, args.out, force=args.force)
    agree = done.shared - len(done.left_out)
    console.show(*outcome.text(done.summary), f"{agree} of {done.shared} landmarks of both lay B on A")
    if done.is_repeated:
        console.show("the drive of B was repeated from its journal, because its visits are condensed")
    console.show(f"results in {args.out}")
    console.then(f"{console.command('map', 'freeze', args.out, '--out', 'SITE')} (a map that stays as it is)")
    moved = [
        f"landmark {name} is {metres:.2f} m ({sigmas:.0f} sigmas) elsewhere in B: what B saw of it is left out"
        for name, (metres, sigmas) in done.left_out.items()
    ]
    return console.report_losses(done.losses, moved)


def freeze_options(sub: CommandParser) -> None:
    """Add the options of ``map freeze``."""
    arguments.add_run(sub)
    arguments.add_out(sub)


def freeze(args: argparse.Namespace) -> int:
    """Make a map for localization that never changes."""
    from graph_slam_ros.runs import outcome
    from graph_slam_ros.runs.restore import freeze as frozen

    summary = frozen(args.run_folder, args.out, force=args.force)
    console.show(
        *outcome.text(summary), f"results in {args.out}: what is there now stays, whatever is seen from now on"
    )
    console.then(
        f"the node locates itself in it with output.load:={args.out.name}, its folder in the directory of output.folder"
    )
    return console.report_losses(summary["losses"])
