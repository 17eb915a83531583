"""The four questions, on made-up outcomes of a trial fit."""

from dataclasses import replace

import numpy as np
import pytest

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.slam.calibration.decision import decide, is_certain
from graph_slam_ros.slam.calibration.drift import WINDOW, DriftWindows
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import Parameter

CLOCK = Parameter("detections", "clock")


def fitted(value, sigma):
    one, variance = np.array([value]), np.array([[sigma**2]])
    outcome = one, np.array([0.5]), variance, variance, one, one, 0.0
    return TrialFit((CLOCK,), *outcome, np.zeros(0), np.zeros((0, 1)), np.zeros(0), np.zeros(0, dtype=np.int64), 0.0)


def verdict(value, sigma, corrected=()):
    return decide(fitted(value, sigma), 10, corrected)[0].verdict


def test_a_value_that_is_not_determined_is_not_used():
    assert verdict(0.3, 0.035) == "not_determined"
    assert verdict(0.3, 0.025) == "admitted"


def test_what_is_off_by_four_sigmas_is_certain_however_large_they_are():
    assert is_certain(fitted(0.3, 0.035), CLOCK)
    assert not is_certain(fitted(0.1, 0.035), CLOCK)
    assert not is_certain(fitted(1.6, 0.035), CLOCK), "beyond its prior"
    assert not is_certain(replace(fitted(0.3, 0.035), second=np.array([-0.1])), CLOCK), "not in either half"


def test_what_was_corrected_is_followed_although_it_is_known_to_be_less_certain():
    """More of the drive shows that errors are alike: sigma grows, the estimate is better than the one before."""
    assert verdict(0.05, 0.035, (CLOCK,)) == "admitted"
    assert verdict(0.003, 0.035, (CLOCK,)) == "nothing_to_correct"


def test_a_window_goes_on_from_the_one_before():
    windows, stamps_ns = DriftWindows(0.2, 7), np.arange(3 * WINDOW) * 10**9
    assert windows.prior(CLOCK, 0.5, 10**9) == 0.5
    (found,) = decide(fitted(0.003, 0.004), 10)
    windows.close_if_full(WINDOW - 2, stamps_ns, 90, [found], {})
    assert (windows.first_edge, windows.closed) == (7, []), "it is not full"
    windows.close_if_full(WINDOW + 19, stamps_ns, 100, [found], {"detections.offset_s": 0.1})
    assert (windows.first_edge, windows.closed) == (100, [(0, {"detections.offset_s": 0.1})])
    at_once, later = (windows.prior(CLOCK, 0.5, seconds * 10**9) for seconds in (0, 1800))
    assert at_once == pytest.approx(0.005)
    assert later == pytest.approx(np.hypot(0.005, 0.2 * 0.5 * 0.5))
    assert windows.prior(CLOCK, 0.01, 10**16) == 0.01, "never vaguer than the configuration"


def test_without_drift_all_of_the_drive_is_one_window():
    windows = DriftWindows(0.0, 7)
    windows.close_if_full(5 * WINDOW, np.arange(6 * WINDOW), 100, [], {})
    assert (windows.first_edge, windows.next_trial(400)) == (7, 800)


def test_a_change_beyond_the_prior_names_what_mends_it():
    (one,) = decide(fitted(2.0, 0.01), 10, drifts=True)
    assert one.text.endswith("raise calibrate.drift, or correct the configuration first")


def test_nothing_is_let_in_where_odometry_states_less_noise_than_any_wheels_have():
    """The drift of a heading would pass for a wrong track width."""
    (one,) = decide(fitted(0.3, 0.025), 10, sigma_per_m=4e-4)
    assert one.verdict == "refused"
    assert one.text.endswith("no wheels are so good: set odometry.noise=motion")
    assert decide(fitted(0.3, 0.025), 10, sigma_per_m=2e-3)[0].verdict == "admitted"


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
    assert one.text.endswith("Use ids, or ask for it: calibrate.groups=factors")
    assert decide(fitted(0.3, 0.025), 10, by_association={})[0].verdict == "admitted", "a clock shows in turns"


@pytest.mark.parametrize(("found_there", "verdict"), [(-0.10, "admitted"), (-0.03, "refused"), (0.11, "refused")])
def test_a_factor_that_the_association_found_as_well_is_let_in(found_there, verdict):
    """The association leaves odometry's scales open, so it does not merely confirm them."""
    found = replace(fitted(-0.11, 0.01), parameters=(Parameter("odom", "distance"),))
    (one,) = decide(found, 10, by_association={"distance": (found_there, 0.01)})
    assert one.verdict == verdict


def test_windows_of_a_loaded_map_begin_with_the_drive():
    windows, stamps_ns = DriftWindows(0.2, 7, 500), np.arange(900) * 10**9
    windows.close_if_full(520, stamps_ns, 90, [], {})
    assert windows.closed == []
    windows.close_if_full(500 + WINDOW, stamps_ns, 90, [], {})
    assert windows.closed == [(500, {})]


def test_the_factors_of_an_association_are_used_by_default_where_there_is_one():
    assert not Config().uses_found_factors
    assert Config.from_mapping({"landmarks.association": "joint"}).uses_found_factors
    for other in ({"landmarks.association": "id"}, {"calibrate.groups": "none"}, {"calibrate.groups": "auto"}):
        assert not Config.from_mapping({"landmarks.association": "joint"} | other).uses_found_factors
    with pytest.raises(ConfigError, match="is association and some"):
        Config.from_mapping({"calibrate.groups": "association clock"})


def test_a_window_begins_at_its_keyframe_where_the_first_have_left_the_map():
    windows, stamps_ns = DriftWindows(0.2, 7, 700), np.arange(600, 700 + WINDOW + 1) * 10**9
    windows.close_if_full(700 + WINDOW, stamps_ns, 90, decide(fitted(0.003, 0.004), 10), {}, 600)
    hour_ns = 3600 * 10**9
    assert windows.prior(CLOCK, 0.5, 700 * 10**9 + hour_ns) == pytest.approx(np.hypot(0.005, 0.2 * 0.5 * np.sqrt(0.5)))
