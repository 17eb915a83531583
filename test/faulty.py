"""A drive with false closures and wrong ids among the true ones, replayed."""

import csv
import functools
import shutil
import tempfile
from pathlib import Path

from graph_slam_ros import cli
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config

CONFIG = Config.from_mapping(
    {
        "inputs.names": "odom detections closures",
        "closures.type": "vision_msgs/msg/Detection3DArray",
        "closures.use": "closure",
    }
)


def faulty_run(folder):
    """What was put wrong in it, its run folder, and what came of the replay, which all modules share."""
    made, wrong, replayed = _replayed()
    shutil.copytree(made.name, folder, dirs_exist_ok=True)
    return wrong, folder / "run", replayed


@functools.cache
def _replayed():
    made = tempfile.TemporaryDirectory()  # removed with the process
    bag, run = Path(made.name) / "drive.mcap", Path(made.name) / "run"
    city = ["--poses", "100", "--set", "blocks=4", "--seed", "4", "--closures", "20"]
    faults = ["--fault", "false_closures:rate=0.3", "--fault", "wrong_ids:rate=0.03"]
    assert cli.main(["simulate", "manhattan", "--out", str(bag), *city, *faults]) == 0
    with bag.with_suffix(".faults.csv").open(newline="") as stream:
        return made, list(csv.DictReader(stream)), replay(bag, run, CONFIG)
