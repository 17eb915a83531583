"""Calibration of recorded robots: odometry, clock and mount that are wrong, and what comes back.

``python -m benchmarks.calibration [ROBOT ...]`` drives MR.CLAM set 7 (of GRAPH_SLAM_DATASETS), known ids, as it is and
*wrong*: odometry 5 % too long and 5 % too much turned, sightings 100 ms late, the mount turned by 5 degrees. Each
without calibration and with the settings that ``graph_slam calibrate`` prints. Printed are the error of positions at
the stamps of the sightings against motion capture, after alignment, and how much of what was put in did not come back:
the difference of the settings, where both print them.
"""

import argparse
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import datasets, judge
from benchmarks.courses import driven, true_poses
from graph_slam_ros.measurements.types import END
from graph_slam_ros.runs.calibrate import calibrate

_WRONG: Mapping[str, Any] = {
    "odometry.distance_factor": 1.05,
    "odometry.turn_factor": 1.05,
    "detections.offset_s": 0.1,
    "detections.mount_correction": f"0 0 0 0 0 {math.radians(5.0):.6f}",
}
_UNITS = {"detections.offset_s": (1e3, " ms"), "detections.mount_correction": (math.degrees(1.0), " deg")}


def error_m(path: Path, settings: Mapping[str, Any]) -> float:
    """The error of positions of a replay in memory."""
    view = driven(path, dict(settings), END)
    truth = true_poses(path, view.sighting_poses.stamps_ns * 1e-9)
    known = np.isfinite(truth).all(axis=1)
    return judge.position_error(view.sighting_trajectory()[known], truth[known])


def not_back(clean: Mapping[str, float | str], wrong: Mapping[str, float | str]) -> str:
    """How much of what was put in did not come back."""
    words = []
    for name in _WRONG:
        if name in clean and name in wrong:
            factor, unit = _UNITS.get(name, (1.0, ""))
            a, b = (float(str(one[name]).split()[-1]) for one in (clean, wrong))
            words.append(f"{name} {factor * (b - a):.2g}{unit}")
    return ", ".join(words)


def main() -> None:
    """Print a row for each robot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robots", nargs="*", type=int, default=[1, 2, 3, 4, 5], metavar="ROBOT", help="1 to 5")
    robots = parser.parse_args().robots
    print("| robot | as it is | calibrated | wrong | wrong, calibrated | over as it is | not come back |")
    print("|---|---|---|---|---|---|---|")
    for robot in robots:
        with tempfile.TemporaryDirectory() as folder:
            path = datasets.mrclam(robot, Path(folder) / "bag")
            found = [calibrate(path, one).settings for one in ({}, _WRONG)]
            errors = [error_m(path, one) for one in ({}, found[0], _WRONG, {**_WRONG, **found[1]})]
        numbers = " | ".join(f"{one:.3f}" for one in errors)
        print(f"| {robot} | {numbers} | {errors[3] / errors[0]:.2f} | {not_back(*found)} |", flush=True)


if __name__ == "__main__":
    main()
