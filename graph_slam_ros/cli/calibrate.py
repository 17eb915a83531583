"""The command ``calibrate``: what is wrong with odometry's scale, clocks and mounts, as settings."""

import argparse
import json
import shlex
import textwrap

from graph_slam_ros.cli import console
from graph_slam_ros.cli.recordings import config_of
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.runs.calibrate import Calibrated
from graph_slam_ros.runs.calibrate import calibrate as calibrated

_WIDTH = 100


def calibrate(args: argparse.Namespace) -> int:
    """Calibrate a recording; returns 4 where something is to be corrected, 3 where the data do not say all."""
    from graph_slam_ros.runs.folder import is_run

    if is_run(args.bag):
        raise GraphSlamError(f"{args.bag}: a run folder; calibrate its recording")
    if args.out:
        console.check_file(args.out, force=args.force)
    topics = {"odometry": args.odom, "landmarks": args.landmarks}
    done = calibrated(args.bag, config_of(args), **topics, progress=console.progress("calibrate"))
    if args.out:
        write_whole(args.out, _as_yaml(done).encode())
    if args.json:
        console.show(json.dumps({"settings": done.settings, "parameters": done.parameters, "rounds": done.rounds}))
    else:
        _show(args, done)
    lost = console.report_losses(done.losses, done.warnings)
    if lost or not done.is_complete:
        return console.LOSSES
    return console.FOUND if done.settings else console.DONE


def _show(args: argparse.Namespace, done: Calibrated) -> None:
    for name, value in done.settings.items():
        console.show(f"{name}={value}")
    for one in done.parameters:
        console.show(*textwrap.wrap(one["text"], _WIDTH, initial_indent="  ", subsequent_indent="    "))
    if not done.settings:
        console.show("nothing to correct")
    elif not done.is_complete:
        console.warn(f"after {done.rounds} replays something is still left: run it again with these settings")
    settings = [part for name, value in done.settings.items() for part in ("--set", f"{name}={value}")]
    given = [part for text in args.set if text.partition("=")[0] not in done.settings for part in ("--set", text)]
    console.then(" ".join(["graph_slam replay", *map(shlex.quote, [str(args.bag), *given, *settings])]) + " --out RUN")


def _as_yaml(done: Calibrated) -> str:
    from graph_slam_ros.formats.parameters import parameters_text

    sections: dict[str, dict[str, float | str]] = {}
    for name, value in done.settings.items():
        section, key = name.split(".")
        sections.setdefault(section, {})[key] = value
    return parameters_text(sections)
