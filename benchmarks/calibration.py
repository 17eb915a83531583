"""Calibration of recorded robots: odometry, clock and mount that are wrong, and what comes back.

``python -m benchmarks.calibration [ROBOT ...]`` drives MR.CLAM set 7 (of GRAPH_SLAM_DATASETS), known ids, as it is and
*wrong*: odometry 5 % too long and 5 % too much turned, sightings 100 ms late, the mount turned by 5 degrees. Each
without calibration and with ``calibrate.groups=auto``. Printed are the error of positions at the stamps of the
sightings against motion capture, after alignment, and how much of what was put in did not come back: the difference of
the corrected settings of the two runs with calibration, where both correct that parameter.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import judge
from benchmarks.fresh import ROOT
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.lie import se3
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.chosen_inputs import choose_inputs
from graph_slam_ros.runs.replay import measurements
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam

WRONG = {
    "odometry.distance_factor": 1.05,
    "odometry.turn_factor": 1.05,
    "detections.offset_s": 0.1,
    "detections.mount_correction": f"0 0 0 0 0 {math.radians(5.0):.6f}",
}
AUTO = {"calibrate.groups": "auto"}
_UNITS = {"distance": (1.0, ""), "turn": (1.0, ""), "clock": (1e3, " ms"), "yaw": (math.degrees(1.0), " deg")}


@dataclass(frozen=True, slots=True)
class Driven:
    """One drive of a robot.

    Attributes
    ----------
    error_m : of positions
    cpu_s : of the pipeline, reading left out
    found : corrected settings by parameter, of those that were corrected
    """

    error_m: float
    cpu_s: float
    found: Mapping[str, float]


def drive(path: Path, settings: Mapping[str, object]) -> Driven:
    """Replay a recording in memory."""
    bag, config = open_bag(path), Config.from_mapping(settings)
    ingested = [m for several in measurements(bag, choose_inputs(bag, config), config, Counters()) for m in several]
    begin_s, slam = time.process_time(), GraphSlam(config)
    for m in (*ingested, Control("end"), Control("optimize")):
        slam.process(m)
    cpu_s, seen = time.process_time() - begin_s, slam.sighting_poses
    truth = np.asarray(se3.in_plane(interpolated(read_truth(path).trajectory, seen.stamps_ns * 1e-9)))
    known = np.isfinite(truth).all(axis=1)
    error_m = judge.position_error(slam.sighting_trajectory()[known], truth[known])
    found = {name: value for (_, name), value in slam.calibration.items()}
    return Driven(error_m, cpu_s, found)


def not_back(clean: Mapping[str, float], wrong: Mapping[str, float]) -> str:
    """How much of what was put in did not come back."""
    words = []
    for name, (shown, unit) in _UNITS.items():
        if name in clean and name in wrong:
            words.append(f"{name} {shown * (wrong[name] - clean[name]):.2g}{unit}")
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
    print("| robot | as it is | with auto | wrong | wrong, with auto | over as it is | CPU of auto | not come back |")
    print("|---|---|---|---|---|---|---|---|")
    for robot in options.parse_args(arguments).robots:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "bag"
            words = [sys.executable, converter, set_7, str(robot), path]
            subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
            clean, auto, wrong, mended = (drive(path, one) for one in ({}, AUTO, WRONG, WRONG | AUTO))
        errors = " | ".join(f"{one.error_m:.3f}" for one in (clean, auto, wrong, mended))
        ratios = f"{mended.error_m / clean.error_m:.2f} | {auto.cpu_s / clean.cpu_s:.2f}"
        print(f"| {robot} | {errors} | {ratios} | {not_back(auto.found, mended.found)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
