"""The commands on the maps of runs: ``export``."""

import argparse

from graph_slam_ros.cli import console


def export(args: argparse.Namespace) -> int:
    """Write what a run knows in another format."""
    from graph_slam_ros.export import export as exported

    losses: list[str] = []
    files = exported(args.run_folder, args.out, args.to, losses)
    console.say(*(f"wrote {file}" for file in files))
    return console.told(losses)
