"""The command ``calibrate``: estimates odometry's scale, clocks and mounts, and prints them as settings."""

import argparse
import json
import textwrap
from pathlib import Path

from graph_slam_ros.cli import console
from graph_slam_ros.cli.check import check_options, lines, settings_of
from graph_slam_ros.cli.usage import CODES, CommandParser
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.formats.parameters import parameters_text
from graph_slam_ros.runs.calibrate import Calibrated
from graph_slam_ros.runs.calibrate import calibrate as calibrated
from graph_slam_ros.slam.calibration.parameters import AUTO, GROUPS

_WIDTH = 100


def calibrate_options(sub: CommandParser) -> None:
    """Add the options of ``calibrate``."""
    check_options(sub, of_check=False)
    sub.codes = f"{CODES} 4: something is to be corrected."
    about = "auto (default: odometry's factors, clocks, yaws; of ranges alone their factor and offset), or some of "
    about += f"{', '.join(GROUPS)}: what is estimated"
    sub.add_argument("--groups", default=AUTO, help=about)
    sub.add_argument("--out", type=Path, metavar="FILE", help="write the settings as a parameter file, too")
    sub.add_argument("--force", action="store_true", help="replace an existing file")


def calibrate(args: argparse.Namespace) -> int:
    """Calibrate a recording; returns 4 if something is to be corrected, 3 if the data determine nothing."""
    from graph_slam_ros.runs.folder import is_run

    if is_run(args.bag):
        raise GraphSlamError(f"{args.bag}: a run folder; calibrate its recording")
    if args.out:
        console.check_file(args.out, force=args.force)
    settings = settings_of(args)
    topics = {"groups": args.groups, "odometry": args.odom, "landmarks": args.landmarks}
    done = calibrated(args.bag, settings, **topics, progress=console.progress("calibrate"))
    if args.out:
        write_whole(args.out, _as_yaml(done).encode())
    if args.json:
        console.show(
            json.dumps(
                {"settings": done.settings, "parameters": done.parameters, "rounds": done.rounds}
                | {"refused": done.refused, "fault": done.fault and done.fault.as_dict()}
            )
        )
    else:
        _show(done, args.bag)
    lost = console.report_losses(done.losses, done.warnings)
    if lost or not done.is_complete or not _is_determined(done):
        return console.LOSSES
    return console.FOUND if done.settings else console.DONE


def _show(done: Calibrated, bag: Path) -> None:
    for name, value in done.settings.items():
        console.show(f"{name}={value}")
    for one in done.parameters:
        console.show(*textwrap.wrap(one["text"], _WIDTH, initial_indent="  ", subsequent_indent="    "))
    if done.fault:
        console.show(*lines(done.fault))
    if done.refused:
        console.warn(done.refused, most=console.SENTENCE)
    elif not _is_determined(done):
        console.warn("this recording determines none of these parameters")
    elif not done.settings:
        console.show("nothing to correct")
    elif not done.is_complete:
        console.warn(f"after {done.rounds} replays something is still left: run it again with these settings")
    is_wrong = done.fault is not None and done.fault.severity == "error"
    console.then(console.command("check", bag) if is_wrong else done.command)


def _is_determined(done: Calibrated) -> bool:
    """Return whether anything is known of any parameter, be it that it is right."""
    return any(one["verdict"] in ("admitted", "nothing_to_correct") for one in done.parameters)


def _as_yaml(done: Calibrated) -> str:
    sections: dict[str, dict[str, float | str]] = {}
    for name, value in done.settings.items():
        section, key = name.split(".")
        sections.setdefault(section, {})[key] = value
    return parameters_text(sections)
