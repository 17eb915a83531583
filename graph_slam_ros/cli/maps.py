"""The commands on the maps of runs: ``map diff``, ``map merge``, ``map edit``, ``map freeze``, ``map export``."""

import argparse
import json
from pathlib import Path

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.evaluate import suggest_next
from graph_slam_ros.errors import GraphSlamError

_FILES = ("tum", "g2o", "geojson", "mcap")
_PICTURES = ("png", "gif")


def diff_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``map diff``."""
    sub.codes = f"{arguments.CODES} 4: they differ."
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


def merge_options(sub: arguments.CommandParser) -> None:
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


def edit_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``map edit``."""
    sub.codes = f"explain RUN prints the ids of edges and the names of landmarks; so does ledger.csv. {arguments.CODES}"
    sub.more = _kinds_of_edits
    arguments.add_run(sub)
    sub.add_argument("--plan", type=Path, metavar="FILE", help="JSON file with the edits")
    sub.add_argument("--out", type=Path, metavar="DIR", help="new run folder for the result: nothing is replaced")
    sub.add_argument("--dry-run", action="store_true", help="print what the plan would change, and write nothing")
    sub.add_argument("--new-plan", type=Path, metavar="FILE", help="write a plan for this run, without edits, and end")


def _kinds_of_edits() -> str:
    from graph_slam_ros.measurements.edits import ACTIONS

    lines = [f"  {do:16s} {action.keys_text}" for do, action in ACTIONS.items()]
    return "\n".join(["Kinds of edits, and their keys (docs/edits.md):", *lines])


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


def freeze_options(sub: arguments.CommandParser) -> None:
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
    console.then(f"the node locates itself in it with output.load:={args.out.name}, beside output.folder")
    return console.report_losses(summary["losses"])


def export_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``map export``."""
    arguments.add_run(sub)
    about = (
        "output file; its ending says what: .tum the path; .g2o the graph, with stamps and names in a second file;"
        " .geojson path and landmarks on earth; .mcap both as ROS messages; .png a picture; .gif the drive corrected"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="FILE", help=about)
    sub.add_argument("--last-drive", action="store_true", help="tum: only the last drive, not those of the loaded map")
    arguments.add_truth(sub, required=False)
    arguments.add_force(sub)


def export(args: argparse.Namespace) -> int:
    """Write a run in another format."""
    from graph_slam_ros.formats.strict import ending
    from graph_slam_ros.maps.export import export as exported
    from graph_slam_ros.maps.export import files_of

    target = ending(args.out).removeprefix(".")
    if target in _PICTURES:
        return _draw(args)
    if target not in _FILES:
        raise GraphSlamError(f"{args.out}: its ending is none of .{', .'.join((*_FILES, *_PICTURES))}")
    if args.truth or args.topic or args.no_align:
        raise GraphSlamError(f"map export: no use for --truth, --topic or --no-align: .{target} is no picture")
    console.check_file(*files_of(args.out, target), force=args.force)
    losses: list[str] = []
    files = exported(args.run_folder, args.out, target, losses, last_drive=args.last_drive)
    console.show(*(f"wrote {file}" for file in files))
    use = {
        "tum": f"evo_traj tum {args.out} --plot, or any reader of TUM trajectories",
        "g2o": console.command("optimize", args.out),
        "geojson": f"open {args.out} in QGIS, or drop it on geojson.io",
        "mcap": f"open {args.out} in Foxglove, or ros2 bag play {args.out}",
    }
    console.then(use[target])
    return console.report_losses(losses)


def _draw(args: argparse.Namespace) -> int:
    from graph_slam_ros.analysis.animation import animate_run
    from graph_slam_ros.analysis.plots import draw_run
    from graph_slam_ros.runs.folder import changed_since
    from graph_slam_ros.warmup import compile_all

    arguments.check_truth(args, "map export")
    if args.last_drive:
        raise GraphSlamError("map export: no use for --last-drive in a picture")
    console.check_file(args.out, force=args.force)
    losses: list[str] = []
    if args.out.suffix == ".gif":
        compile_all()
        losses = animate_run(args.run_folder, args.out, truth=args.truth, topic=args.topic, align=not args.no_align)
    else:
        draw_run(args.run_folder, args.truth, args.out, args.topic, align=not args.no_align)
    console.show(f"picture in {args.out}")
    suggest_next(args.run_folder)
    return console.report_losses(losses, changed_since(args.run_folder))
