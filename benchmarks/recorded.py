"""Recorded drives among landmarks as graphs, which all contenders can be given; errors are against the truth.

The pipeline makes the graph: its keyframes, odometry between them, and each sighting from its keyframe, with the noise
that it has there. MR.CLAM set 7 has five robots, and motion capture; Victoria Park has a car, GPS, and trees without
names, of which each gets that of the landmark that association takes it for.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import judge, options, trials, victoria_park
from benchmarks.contenders import OURS
from benchmarks.courses import Course
from benchmarks.fresh import ROOT
from benchmarks.kept import Kept, code_of, digest
from benchmarks.problem import Array, Index, Problem, landmark_problem
from benchmarks.trials import in_order_of_sighting
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.slam import Config, Control, Counters, GraphSlam, MapView

_ROBOTS = range(1, 6)


@dataclass(frozen=True, slots=True)
class Drawn:
    """The graph of a drive, and where it was seen from.

    Attributes
    ----------
    stamps_s : (n,) of the sightings
    keyframe : (n,) that is before each
    T_keyframe_base : (n, 3) the motion since
    """

    problem: Problem
    stamps_s: Array
    keyframe: Index
    T_keyframe_base: Array

    @classmethod
    def of(cls, name: str, view: MapView) -> "Drawn":
        """What the pipeline made of a drive."""
        problem = in_order_of_sighting(landmark_problem(name, view.graph, view.trajectory()))
        seen = view.sighting_poses
        return cls(problem, seen.stamps_ns * 1e-9, seen.ids.copy(), seen.poses.copy())

    def course(self, at_sightings_m: Callable[[Array], float]) -> Course:
        """With the error of poses (n, 3) at the stamps of the sightings."""

        def error_m(poses: Array) -> float:
            at = se2.compose(tuple(poses[self.keyframe].T), tuple(self.T_keyframe_base.T))
            return at_sightings_m(np.column_stack(at))

        bare = replace(self.problem, sightings=self.problem.sightings[:0], landmarks=self.problem.landmarks[:0])
        trial = partial(trials.trial, self.problem, self.problem.poses)
        return Course(self.problem.name, trial, error_m, error_m(trials.chained(bare).poses), None, "wrong_ids")


def courses(kept: Kept) -> Iterator[Course]:
    """All that are at hand; what is not is said."""
    datasets = Path(os.environ.get("GRAPH_SLAM_DATASETS", ROOT.parent / "shared/datasets"))
    converter, set_7 = datasets.parent / "tools/mrclam_to_mcap.py", datasets / "recorded/mrclam7"
    park = datasets / "recorded/victoria_park"
    for path in (converter, set_7, park):
        if not path.exists():
            options.say(f"skipped: no {path}: set GRAPH_SLAM_DATASETS")
    if converter.exists() and set_7.exists():
        for robot in _ROBOTS:
            yield of_robot(kept, robot, converter, set_7)
    if park.exists():
        drive = victoria_park.read_drive(park)
        drawn = kept.ask(digest(park.name, code_of(OURS), victoria_park.SETTINGS), partial(_victoria_park, drive))
        yield drawn.course(partial(_against_gps, drive, drawn.stamps_s))


def of_robot(kept: Kept, robot: int, converter: Path, set_7: Path) -> Course:
    """That of a robot of MR.CLAM set 7."""
    name = f"MR.CLAM 7, robot {robot}"
    drawn, truth = kept.ask(digest(name, code_of(OURS)), partial(_mrclam, name, converter, set_7, robot))
    return drawn.course(partial(_against_truth, truth))


def _mrclam(name: str, converter: Path, set_7: Path, robot: int) -> tuple[Drawn, Array]:
    """And the true poses (n, 3) at the stamps of the sightings, NaN where they are not known."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        words = [sys.executable, converter, set_7, str(robot), path, "--map"]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        bag, config = open_bag(path), Config.from_mapping({"map.condense": False})  # every sighting is wanted
        slam = GraphSlam(config)
        for _, several in RecordedRuns(bag, choose_inputs(bag, config), config, Counters()):
            for m in several:
                slam.process(m)
        slam.process(Control("end"))
        drawn = Drawn.of(name, slam.view)
        return drawn, np.asarray(se3.in_plane(interpolated(read_truth(path).trajectory, drawn.stamps_s)))


def _against_truth(truth: Array, poses: Array) -> float:
    known = np.isfinite(truth).all(axis=1)
    return judge.position_error(poses[known], truth[known])


def _victoria_park(drive: victoria_park.Drive) -> Drawn:
    options.say("Victoria Park: telling which tree is which takes a quarter of an hour")
    slam, _ = victoria_park.run(drive, victoria_park.SETTINGS)
    return Drawn.of("Victoria Park", slam.view)


def _against_gps(drive: victoria_park.Drive, stamps_s: Array, poses: Array) -> float:
    odometry = victoria_park.Track.of_laser(drive.odometry[:, 0], drive.odometry[:, 1:])
    good = victoria_park.quiet(drive.gps, odometry)
    fixes = victoria_park.Track(drive.gps.stamps_s[good], drive.gps.positions[good])
    error = victoria_park.distances(victoria_park.Track.of_laser(stamps_s, poses), fixes)
    return float(np.sqrt(np.mean(np.square(error))))
