"""Calibration of recorded robots: odometry, clock and mount that are wrong, and what comes back.

``python -m benchmarks.calibration [ROBOT ...]`` drives MR.CLAM set 7 (of GRAPH_SLAM_DATASETS), known ids, as it is and
*wrong*: odometry 5 % too long and 5 % too much turned, sightings 100 ms late, the mount turned by 5 degrees. Each
without calibration and with the settings that ``graph_slam calibrate`` prints. Printed are the error of positions at
the stamps of the sightings against motion capture, after alignment, and how much of what was put in did not come back:
the difference of the settings, where both print them.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks import judge
from benchmarks.fresh import ROOT
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.lie import se3
from graph_slam_ros.measurements.types import END
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.calibrate import calibrate
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.slam import Config, Counters, GraphSlam

WRONG = {
    "odometry.distance_factor": 1.05,
    "odometry.turn_factor": 1.05,
    "detections.offset_s": 0.1,
    "detections.mount_correction": f"0 0 0 0 0 {math.radians(5.0):.6f}",
}
_UNITS = {
    "odometry.distance_factor": (1.0, ""),
    "odometry.turn_factor": (1.0, ""),
    "detections.offset_s": (1e3, " ms"),
    "detections.mount_correction": (math.degrees(1.0), " deg"),
}


def drive(path: Path, settings: Mapping[str, object]) -> float:
    """The error of positions [m] of a replay in memory."""
    bag, config = open_bag(path), Config.from_mapping(settings)
    slam = GraphSlam(config)
    for _, several in RecordedRuns(bag, choose_inputs(bag, config), config, Counters()):
        for m in several:
            slam.process(m)
    for event in END:
        slam.process(event)
    seen = slam.view.sighting_poses
    truth = np.asarray(se3.in_plane(interpolated(read_truth(path).trajectory, seen.stamps_ns * 1e-9)))
    known = np.isfinite(truth).all(axis=1)
    return judge.position_error(slam.view.sighting_trajectory()[known], truth[known])


def not_back(clean: Mapping[str, float | str], wrong: Mapping[str, float | str]) -> str:
    """How much of what was put in did not come back."""
    words = []
    for name, (shown, unit) in _UNITS.items():
        if name in clean and name in wrong:
            a, b = (float(str(one[name]).split()[-1]) for one in (clean, wrong))
            words.append(f"{name} {shown * (b - a):.2g}{unit}")
    return ", ".join(words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a row for each robot."""
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("robots", nargs="*", type=int, default=[1, 2, 3, 4, 5], metavar="ROBOT", help="1 to 5")
    datasets = Path(os.environ.get("GRAPH_SLAM_DATASETS", ROOT.parent / "shared/datasets"))
    converter, set_7 = datasets.parent / "tools/mrclam_to_mcap.py", datasets / "recorded/mrclam7"
    for needed in (converter, set_7):
        if not needed.exists():
            print(f"benchmarks: no {needed}: set GRAPH_SLAM_DATASETS", file=sys.stderr)
            return 2
    print("| robot | as it is | calibrated | wrong | wrong, calibrated | over as it is | not come back |")
    print("|---|---|---|---|---|---|---|")
    for robot in options.parse_args(arguments).robots:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            words = [sys.executable, converter, set_7, str(robot), path]
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
            found = [calibrate(path, one).settings for one in ({}, WRONG)]
            errors = [drive(path, one) for one in ({}, found[0], WRONG, WRONG | found[1])]
        numbers = " | ".join(f"{one:.3f}" for one in errors)
        print(f"| {robot} | {numbers} | {errors[3] / errors[0]:.2f} | {not_back(*found)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
