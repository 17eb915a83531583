"""What contenders are driven through among false measurements: a graph, and how far a path in it is off.

Recorded drives become graphs by the pipeline: its keyframes, odometry between them, and each sighting from its
keyframe, with the noise that it has there. MR.CLAM set 7 has five robots, and motion capture; Victoria Park has a car,
GPS, and trees without names, of which each gets that of the landmark that association takes it for.
"""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import contenders, datasets, fresh, judge, options, trials, victoria_park
from benchmarks.contenders import OURS
from benchmarks.drive import drive
from benchmarks.problem import Array, Index, Problem, landmark_problem
from benchmarks.trials import Trial
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.slam import Config, Control, GraphSlam, MapView


@dataclass(frozen=True, slots=True)
class Course:
    """What is driven through.

    Attributes
    ----------
    trial : with false measurements, of a policy, a rate and a seed
    error_m : position error of all poses, after the rigid motion that fits best
    clean_policy : one of which the trial at rate 0 has no false measurement
    """

    name: str
    trial: Callable[[str, float, int], Trial]
    error_m: Callable[[Array], float]
    clean_policy: str


def of_graph(problem: Problem) -> Course:
    """A graph, whose optimum is what there is to find.

    Raises
    ------
    GraphSlamError
        Some pose has no odometry to it.
    """
    odometry, closures = trials.split(problem)
    optimum = _optimum(replace(problem, poses=odometry.poses), problem)
    trial, error_m = partial(trials.trial, problem, optimum), partial(judge.position_error, truth=optimum)
    return Course(problem.name, trial, error_m, "random" if len(closures) else "wrong_ids")


def _optimum(driven: Problem, problem: Problem) -> Array:
    """The better of two: from where a drive through the graph ends, and from its own values."""
    online = fresh.call(drive, OURS, driven, False)
    starts = replace(problem, poses=online.poses, landmarks=online.landmarks), problem
    solved = [fresh.call(contenders.solve, OURS, start) for start in starts]
    costs = [judge.chi2(problem, one.poses, one.landmarks) for one in solved]
    return np.asarray(min(zip(costs, solved, strict=True), key=lambda one: one[0])[1].poses)


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
        problem = trials.in_order_of_sighting(landmark_problem(name, view.graph, view.trajectory()))
        seen = view.sighting_poses
        return cls(problem, seen.stamps_ns * 1e-9, seen.ids.copy(), seen.poses.copy())

    def course(self, at_sightings_m: Callable[[Array], float]) -> Course:
        """With the error of poses (n, 3) at the stamps of the sightings."""

        def error_m(poses: Array) -> float:
            at = se2.compose(tuple(poses[self.keyframe].T), tuple(self.T_keyframe_base.T))
            return at_sightings_m(np.column_stack(at))

        return Course(self.problem.name, partial(trials.trial, self.problem, self.problem.poses), error_m, "wrong_ids")


def recorded() -> Iterator[Course]:
    """All recordings that are at hand; what is not is said."""
    for course in (*(partial(of_robot, robot) for robot in range(1, 6)), of_park):
        try:
            yield course()
        except datasets.Absent as error:
            options.say(f"skipped: {error}")


def of_robot(robot: int) -> Course:
    """That of a robot of MR.CLAM set 7. Raises ``datasets.Absent``."""
    with tempfile.TemporaryDirectory() as folder:
        path = datasets.mrclam(robot, Path(folder) / "bag")
        bag, config = open_bag(path), Config.from_mapping({"map.condense": False})  # every sighting is wanted
        slam = GraphSlam(config)
        for _, several in RecordedRuns(bag, choose_inputs(bag, config), config):
            for m in several:
                slam.process(m)
        slam.process(Control("end"))
        drawn = Drawn.of(f"MR.CLAM 7, robot {robot}", slam.view)
        truth = np.asarray(se3.in_plane(interpolated(read_truth(path).trajectory, drawn.stamps_s)))
    known = np.isfinite(truth).all(axis=1)
    return drawn.course(lambda poses: judge.position_error(poses[known], truth[known]))


def of_park() -> Course:
    """That of Victoria Park, against GPS. Raises ``datasets.Absent``."""
    drive = victoria_park.read_drive(datasets.PARK)
    options.say("Victoria Park: telling which tree is which takes a quarter of an hour")
    graph, fixes = Drawn.of("Victoria Park", victoria_park.run(drive).view), drive.quiet_fixes()

    def error_m(poses: Array) -> float:
        return judge.rms(victoria_park.Track.of_laser(graph.stamps_s, poses).at(fixes.stamps_s), fixes.positions)

    return graph.course(error_m)
