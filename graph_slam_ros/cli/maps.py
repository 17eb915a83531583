"""The commands on the maps of runs: ``export``, ``diff``."""

import argparse
import json

from graph_slam_ros.cli import console


def export(args: argparse.Namespace) -> int:
    """Write what a run knows in another format."""
    from graph_slam_ros.export import export as exported

    losses: list[str] = []
    files = exported(args.run_folder, args.out, args.to, losses)
    console.say(*(f"wrote {file}" for file in files))
    return console.told(losses)


def diff(args: argparse.Namespace) -> int:
    """Say what differs between two runs' maps."""
    from graph_slam_ros.diff import diff as compared

    losses: list[str] = []
    found = compared(args.a, args.b, losses)
    console.say(json.dumps(found.as_dict()) if args.json else str(found))
    return console.told(losses) or (console.DONE if found.is_same else console.DIFFERENT)
