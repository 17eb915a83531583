"""The command ``map export``: a run's path, graph or map in another format, or as a picture."""

import argparse
from pathlib import Path

from graph_slam_ros.cli import arguments, console
from graph_slam_ros.cli.results import suggest_next
from graph_slam_ros.cli.usage import CommandParser
from graph_slam_ros.errors import GraphSlamError

_FILES = ("tum", "g2o", "mcap")
_PICTURES = ("png", "svg", "pdf", "gif")


def export_options(sub: CommandParser) -> None:
    """Add the options of ``map export``."""
    arguments.add_run(sub)
    about = (
        "output file; its ending says what: .tum the path; .g2o the graph, with stamps and names in a second file;"
        " .mcap both as ROS messages; .png, .svg, .pdf a picture; .gif the drive and its correction"
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
        "mcap": f"open {args.out} in Foxglove, or ros2 bag play {args.out}",
    }
    console.then(use[target])
    return console.report_losses(losses)


def _draw(args: argparse.Namespace) -> int:
    from graph_slam_ros.analysis.animation import animate_run
    from graph_slam_ros.analysis.plots import draw_run
    from graph_slam_ros.runs.folder import changed_since
    from graph_slam_ros.warmup import compile_all

    if args.last_drive or (not args.truth and (args.topic or args.no_align)):
        raise GraphSlamError("map export: no use for --last-drive in a picture, or --topic, --no-align without --truth")
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
