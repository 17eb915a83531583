"""The commands on what a run has decided: ``explain``, ``solve`` and ``influence``."""

import argparse

from graph_slam_ros.cli import console


def explain(args: argparse.Namespace) -> int:
    """Say why."""
    from graph_slam_ros.explain import explain_edge, explain_run

    console.say(*(explain_edge(args.run_folder, args.edge) if args.edge else explain_run(args.run_folder)))
    return console.DONE
