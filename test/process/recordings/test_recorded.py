"""Real robots with motion-captured truth: five robots of UTIAS MR.CLAM set 7, one configuration for all."""

import numpy as np
import pytest
from places import HAS_MRCLAM, SET_7, WITHOUT_MRCLAM, mrclam
from reliability import times

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.path_error import alignment
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config

# Batch least squares with known ids reaches 0.107, 0.100, 0.089, 0.187, 0.094 m; robot 4's camera has a bias.
MOST_M = {1: 0.15, 2: 0.15, 3: 0.15, 4: 0.25, 5: 0.15}
# A robot and so many seconds of it (None: all); make soak has the whole of each.
ROBOTS = times([(3, 200.0)], [(robot, None) for robot in MOST_M])
LEAST_ODOMETRY_M, MOST_MAP_M = times((0.2, 0.2), (1.0, 0.12))


def poles_and_landmarks(robot, view):
    """Positions of the poles, and of the landmarks after the path was laid on the truth."""
    truth = np.loadtxt(SET_7 / f"Robot{robot}_Groundtruth.dat.gz")
    stamps_s, path = view.sighting_poses.stamps_ns * 1e-9, view.sighting_trajectory()[:, :2]
    known = (stamps_s > truth[0, 0]) & (stamps_s < truth[-1, 0])
    there = np.stack([np.interp(stamps_s[known], truth[:, 0], truth[:, k]) for k in (1, 2)], axis=1)
    landmarks = np.array([view.solver.estimate([mark.vertex])[0][:2] for mark in view.landmarks.values()])
    flat = np.column_stack([landmarks, np.zeros(len(landmarks))])
    moved = np.stack(se3.act(alignment(path[known], there), tuple(flat.T)), axis=1)[:, :2]
    return np.loadtxt(SET_7 / "Landmark_Groundtruth.dat")[:, 1:3], moved


@pytest.mark.skipif(not HAS_MRCLAM, reason=WITHOUT_MRCLAM)
@pytest.mark.parametrize("ids", ["number", "none"])
@pytest.mark.parametrize("robot, seconds", ROBOTS)
def test_a_recorded_robot_is_found_to_a_decimetre_and_so_are_its_landmarks(robot, seconds, ids, tmp_path):
    bag = mrclam(robot, tmp_path / "bag", *(("--ids", "none") if ids == "none" else ()), seconds=seconds)
    config = Config.from_mapping({"landmarks.association": "joint"} if ids == "none" else {})
    done = replay(bag, tmp_path / "run", config)
    scores = evaluate(tmp_path / "run", str(bag))
    assert scores.estimate.position_m["rmse"] <= MOST_M[robot]
    assert scores.odometry.position_m["rmse"] >= LEAST_ODOMETRY_M  # it is not the odometry that is this good
    if ids == "none":
        poles, landmarks = poles_and_landmarks(robot, done.slam.view)
        apart = np.linalg.norm(poles[:, None] - landmarks[None], axis=2)
        assert apart.min(axis=0).max() < 0.5, "a landmark is no pole"
        assert apart.min(axis=1).max() < 0.5, "a pole has no landmark"
    else:
        assert scores.map_rmse_m <= MOST_MAP_M
        assert len(done.slam.view.landmarks) == 15
    assert not done.losses
