"""Clocks of two topics by the times at which their messages were received."""

import itertools

import numpy as np
import pytest
from rows import each

from graph_slam_ros.messages.receive_times import clock_offset_s

ODOMETRY_S, LANDMARKS_S = np.arange(0.0, 60.0, 0.05), np.arange(30.0, 60.0, 0.3)


def ns(seconds):
    return np.round(seconds * 1e9).astype(np.int64)


@each("late_s, rate", [*itertools.product([0.0, 0.4, -20.0], [0.5, 1.0, 1.2, 5.0])])
def test_a_recording_that_is_played_fast_or_slow_shows_the_offset_of_the_clock_and_no_other(rate, late_s):
    """The landmarks begin later than odometry, so their lags have grown by more."""
    received_s, other_s = 1.7e9 + LANDMARKS_S / rate, 1.7e9 + ODOMETRY_S / rate
    lag_s, other_lag_s = received_s - (LANDMARKS_S + late_s), other_s - ODOMETRY_S
    found = clock_offset_s(ns(received_s), lag_s, ns(other_s), other_lag_s)
    assert found == pytest.approx(-late_s, abs=1e-6)


def test_times_that_do_not_run_with_the_stamps_say_nothing():
    received_s, other_s = 0.06 + 1e-4 * LANDMARKS_S, 1e-3 * ODOMETRY_S
    lag_s = received_s - LANDMARKS_S - 3.0
    assert clock_offset_s(ns(received_s), lag_s, ns(other_s), other_s - ODOMETRY_S) == 0.0
    assert clock_offset_s([], [], ns(other_s), other_s) == 0.0
