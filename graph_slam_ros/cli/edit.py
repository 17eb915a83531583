"""The command ``map edit``: applies a plan of edits by hand to a run, and writes the result as a new run."""

import argparse
from pathlib import Path

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.usage import CODES, CommandParser
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.edit_actions import ACTIONS


def edit_options(sub: CommandParser) -> None:
    """Add the options of ``map edit``."""
    sub.codes = f"explain RUN prints the ids of edges and the names of landmarks; so does ledger.csv. {CODES}"
    sub.more = lambda: "\n".join(
        [
            "Kinds of edits, and their keys (docs/edits.md):",
            *(f"  {do:16s} {action.keys_text}" for do, action in ACTIONS.items()),
        ]
    )
    arguments.add_run(sub)
    sub.add_argument("--plan", type=Path, metavar="FILE", help="JSON file with the edits")
    sub.add_argument("--out", type=Path, metavar="DIR", help="new run folder for the result: nothing is replaced")
    sub.add_argument("--dry-run", action="store_true", help="print what the plan would change, and write nothing")
    sub.add_argument("--new-plan", type=Path, metavar="FILE", help="write a plan for this run, without edits, and end")


def edit(args: argparse.Namespace) -> int:
    """Apply a plan of edits to a run, or begin one."""
    from graph_slam_ros.maps.edit import edit as edited
    from graph_slam_ros.maps.edit import read_plan, write_empty_plan

    if args.new_plan is not None:
        write_empty_plan(args.run_folder, args.new_plan)
        console.show(f"wrote {args.new_plan}: a plan for {args.run_folder}, with no edits: docs/edits.md has the keys")
        console.then(f"{console.command('explain', args.run_folder)} (the ids of edges), then edit {args.new_plan}")
        return console.DONE
    if args.plan is None or (args.out is None) is not args.dry_run:
        raise GraphSlamError("map edit needs --plan FILE with --out DIR or --dry-run, or --new-plan FILE")
    done = edited(args.run_folder, read_plan(args.plan), args.out)
    console.show(*(one.text for one in done.edits))
    console.show(
        f"chi2       {done.chi2[0]:14.4f}  ->  {done.chi2[1]:14.4f}",
        f"last pose  moves by {done.final_m:.4f} m",
        f"most       keyframe {done.moved[0]}, by {done.moved[1]:.4f} m",
    )
    console.show(*(fit.text for fit in done.by_hand))
    if args.dry_run:
        console.show("nothing was written")
        console.then(console.command("map", "edit", args.run_folder, "--plan", args.plan, "--out", "NEW"))
    else:
        console.show(f"results in {args.out}; {args.run_folder} is as it was")
        console.then(f"{console.command('map', 'diff', args.run_folder, args.out)} (what the edits have changed)")
    return console.report_losses(done.losses, done.warnings)
