"""The commands on the maps of runs: ``export``, ``diff``, ``merge``, ``freeze``."""

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
    console.say(*([json.dumps(found.as_dict())] if args.json else found.lines()))
    return console.told(losses) or (console.DONE if found.is_same else console.DIFFERENT)


def merge(args: argparse.Namespace) -> int:
    """Make one map of two runs."""
    from graph_slam_ros import outcome
    from graph_slam_ros.merge import merge as merged

    done = merged(args.a, args.b, args.out)
    agree = done.shared - len(done.left_out)
    console.say(*outcome.text(done.summary), f"{agree} of {done.shared} landmarks of both lay B on A")
    console.say(f"results in {args.out}")
    moved = [
        f"landmark {name} is {metres:.2f} m ({sigmas:.0f} sigmas) elsewhere in B: what B saw of it is left out"
        for name, (metres, sigmas) in done.left_out.items()
    ]
    return console.told(done.losses, moved)


def freeze(args: argparse.Namespace) -> int:
    """Make a map in which to be located, and which nothing changes."""
    from graph_slam_ros import outcome
    from graph_slam_ros.run import freeze as frozen

    summary = frozen(args.run_folder, args.out)
    console.say(*outcome.text(summary), f"results in {args.out}: what is there now stays, whatever is seen from now on")
    return console.told(summary["losses"])
