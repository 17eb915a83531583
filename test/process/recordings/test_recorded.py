"""Real robots with motion-captured truth: five robots of UTIAS MR.CLAM set 7, one configuration for all."""

import pytest
from places import HAS_MRCLAM, WITHOUT_MRCLAM, mrclam
from reliability import times

from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.runs.replay import replay

# Batch least squares with known ids reaches 0.107, 0.100, 0.089, 0.187, 0.094 m; robot 4's camera has a bias.
MOST_M = {1: 0.15, 2: 0.15, 3: 0.15, 4: 0.25, 5: 0.15}
MOST_MAP_M = 0.12
ROBOTS = times([4], list(MOST_M))


@pytest.mark.skipif(not HAS_MRCLAM, reason=WITHOUT_MRCLAM)
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_recorded_robot_is_found_to_a_decimetre_and_so_are_its_landmarks(robot, tmp_path):
    bag = mrclam(robot, tmp_path / "bag")
    done = replay(bag, tmp_path / "run")
    scores = evaluate(tmp_path / "run", str(bag))
    assert scores.estimate.position_m["rmse"] <= MOST_M[robot]
    assert scores.odometry.position_m["rmse"] >= 1.0  # it is not the odometry that is this good
    assert scores.map_rmse_m <= MOST_MAP_M
    assert len(done.slam.landmarks) == 15
    assert not done.losses
