"""The four questions, on made-up outcomes of a trial fit."""

import numpy as np

from graph_slam_ros.slam.calibration.decision import decide
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import Parameter

CLOCK = Parameter("detections", "clock")


def fitted(value, sigma):
    one, variance = np.array([value]), np.array([[sigma**2]])
    outcome = one, np.array([0.5]), variance, variance, one, one, 0.0
    return TrialFit((CLOCK,), *outcome, np.zeros(0), np.zeros((0, 1)), np.zeros(0, dtype=np.int64))


def verdict(value, sigma, corrected=()):
    return decide(fitted(value, sigma), 10, corrected)[0].verdict


def test_a_value_that_is_not_determined_is_not_used():
    assert verdict(0.3, 0.035) == "not_determined"
    assert verdict(0.3, 0.025) == "admitted"


def test_what_was_corrected_is_followed_although_it_is_known_to_be_less_certain():
    """More of the drive shows that errors are alike: sigma grows, the estimate is better than the one before."""
    assert verdict(0.05, 0.035, (CLOCK,)) == "admitted"
    assert verdict(0.003, 0.035, (CLOCK,)) == "nothing_to_correct"
