"""The demonstration: the recording that comes with the source, through a live ROS graph into the node."""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.plots import draw_run
from graph_slam_ros.cli import arguments, console
from graph_slam_ros.formats.files import read_text
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.folder import SUMMARY, check_room
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag
from graph_slam_ros.warmup import compile_all

_BAG = Path(__file__).resolve().parents[2] / "data" / "demo.mcap"


def demo_options(sub: arguments.CommandParser) -> None:
    """Add the options of ``demo``."""
    sub.add_argument(
        "--out", type=Path, default=Path("runs/demo"), metavar="DIR", help="folder for the results (default: runs/demo)"
    )
    arguments.add_force(sub)


def demo(args: argparse.Namespace) -> int:
    """Run the demonstration and print the outcome; returns the exit code (3 if messages were lost)."""
    out, live = args.out, console.has_ros()
    check_room(out, force=args.force)
    with tempfile.TemporaryDirectory() as scratch:
        recording = _BAG
        if not recording.is_file():  # installed without the source tree
            recording = Path(scratch) / "demo.mcap"
            write_bag(simulate("warehouse", 8, aisle_m=9.0), recording)
        compile_all(dimensions=2)  # before it: a live node would miss messages meanwhile
        start = time.perf_counter()
        if live:
            lost = _live(recording, out, console.progress)
        else:
            lost = len(replay(recording, out, force=True, progress=console.progress("replay")).losses)
        elapsed_s = time.perf_counter() - start
        scores = evaluate(out, str(recording))
        draw_run(out, str(recording), out / "path.png")
    summary = json.loads(read_text(out / SUMMARY))
    through = "a live ROS graph (rclpy)" if live else "the pipeline directly: no ROS 2 here"
    console.show(f"replayed {recording.name} through {through} in {elapsed_s:.1f} s of wall time")
    console.show(f"  keyframes        {summary['keyframes']}")
    console.show(f"  landmarks        {summary['landmarks']}, from {summary['sightings']} sightings")
    console.show(f"  edges            {summary['edges']}")
    console.show(f"  chi2             {summary['chi2']:.1f}")
    if scores.odometry is not None:
        console.show(f"  position error   {scores.odometry.position_m['rmse']:.3f} m before (odometry)")
    console.show(f"                   {scores.estimate.position_m['rmse']:.3f} m after")
    console.show(f"  messages lost    {lost}")
    console.show(f"path, graph and picture: {out}/path.tum, graph.g2o, path.png (run.mcap opens in Foxglove)")
    console.then(f"a recording of your own: {console.command('info', 'RECORDING')}")
    return console.LOSSES if lost else console.DONE


def _live(recording: Path, out: Path, progress: Callable[[str], Any]) -> int:
    from graph_slam_ros.node.player import own_node, play

    bag = open_bag(recording)
    inputs = choose_inputs(bag, Config())
    with own_node(out, inputs, Config()) as own:
        return play(bag, inputs, own=own, progress=progress("play")).lost
