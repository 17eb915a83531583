"""The four questions, on made-up outcomes of a trial fit."""

from dataclasses import replace

import numpy as np

from graph_slam_ros.slam.calibration.decision import decide, is_certain
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import Parameter

CLOCK = Parameter("detections", "clock")


def fitted(value, sigma):
    one, variance = np.array([value]), np.array([[sigma**2]])
    outcome = one, np.array([0.5]), variance, variance, one, one, 0.0
    return TrialFit((CLOCK,), *outcome, np.zeros(0), np.zeros((0, 1)), np.zeros(0), np.zeros(0, dtype=np.int64), 0.0)


def verdict(value, sigma):
    return decide(fitted(value, sigma), 10)[0].verdict


def test_a_value_that_is_not_determined_is_not_used():
    assert verdict(0.3, 0.035) == "not_determined"
    assert verdict(0.3, 0.025) == "admitted"


def test_what_is_off_by_four_sigmas_is_certain_however_large_they_are():
    assert is_certain(fitted(0.3, 0.035), CLOCK)
    assert not is_certain(fitted(0.1, 0.035), CLOCK)
    assert not is_certain(fitted(1.6, 0.035), CLOCK), "beyond its prior"
    assert not is_certain(replace(fitted(0.3, 0.035), second=np.array([-0.1])), CLOCK), "not in either half"


def test_a_yaw_is_not_measured_by_a_robot_that_only_turns():
    """By what a wrong track width does to its place, it seemed to be off by 10 degrees, at four sigmas."""
    yaw = replace(fitted(-0.17, 0.038), parameters=(Parameter("detections", "yaw"),))
    (one,) = decide(yaw, 10, sigma_per_m=float("inf"))
    assert one.verdict == "refused"
    assert "odometry does not move: drive " in one.text
    assert decide(yaw, 10)[0].verdict != "refused"
    assert decide(fitted(0.3, 0.025), 10, sigma_per_m=float("inf"))[0].verdict == "admitted", "a clock"


def test_factors_are_refused_where_odometry_told_the_landmarks_apart():
    distance = Parameter("odom", "distance")
    found = replace(fitted(-0.11, 0.01), parameters=(distance,))
    assert decide(found, 10)[0].verdict == "admitted"
    (one,) = decide(found, 10, by_association={})
    assert one.verdict == "refused"
    assert one.text.endswith("Use ids, or ask for it: graph_slam calibrate --groups factors")
    assert decide(fitted(0.3, 0.025), 10, by_association={})[0].verdict == "admitted", "a clock shows in turns"
    for there, expected in ((-0.10, "admitted"), (-0.03, "refused"), (0.11, "refused")):  # it leaves scales open
        assert decide(found, 10, by_association={"distance": (there, 0.01)})[0].verdict == expected
