"""The command ``warmup``: compiles the kernels."""

import argparse

from graph_slam_ros.cli import console
from graph_slam_ros.cli.usage import CommandParser


def warmup_options(_: CommandParser) -> None:
    """Add no option."""


def warmup(args: argparse.Namespace) -> int:
    """Compile the kernels."""
    from graph_slam_ros.warmup import warmup as compiled

    console.warn(f"kernels ready after {compiled():.1f} s")
    console.then(console.command("info", "RECORDING"))
    return console.DONE
