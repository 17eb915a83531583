"""Where a score is least, what determines it, and what does not."""

import numpy as np
import pytest

from graph_slam_ros.tools.fleet.surface import LONGEST, Surface, design, held_out_of, interval

H = np.array([[60.0, 20.0], [20.0, 40.0]])
LEAST = np.array([0.2, -0.3])


def scores(curvature, least, recordings=1, spread=0.0, seed=0):
    """Scores of recordings at the points of the design, each with its own least value."""
    at, rng = design(len(least)), np.random.default_rng(seed)
    own = [np.asarray(least) + spread * rng.standard_normal(len(least)) for _ in range(recordings)]
    return np.array([[0.5 * (x - one) @ curvature @ (x - one) + 7.0 for x in at] for one in own])


def test_a_quadratic_function_is_found_from_as_many_points_as_it_has_coefficients():
    assert len(design(3)) == 1 + 2 * 3 + 3
    surface = Surface.through(scores(H, LEAST), is_likelihood=True)
    both = np.array([True, True])
    assert surface.determined().all()
    assert surface.offset(both) == pytest.approx(LEAST)
    assert surface.sigmas(both) == pytest.approx(np.sqrt(np.diag(np.linalg.inv(H))))
    alone = surface.offset(np.array([True, False]))
    assert alone == pytest.approx([0.2 + 20.0 / 60.0 * -0.3, 0.0]), "the other stays at the centre"


def test_what_is_flat_is_named_and_the_rest_is_determined():
    flat = np.diag([60.0, 0.5, 0.0])
    surface = Surface.through(scores(flat, [0.1, 0.3, 0.0]), is_likelihood=True)
    assert surface.determined().tolist() == [True, False, False]
    assert not np.isfinite(surface.sigmas(np.array([False, False, True]))[2])


def test_of_two_that_only_their_sum_is_known_one_is_left():
    together = 100.0 * np.ones((2, 2))
    surface = Surface.through(scores(together, [0.1, 0.1]), is_likelihood=True)
    assert surface.determined().sum() == 1


def test_another_score_is_as_sure_as_recordings_agree():
    alike = Surface.through(scores(np.diag([1.0, 1.0]), [0.1, 0.0], 8, spread=0.05), is_likelihood=False)
    both = np.array([True, True])
    # The spread of the mean of eight least values, each with 0.05.
    assert alike.sigmas(both) == pytest.approx([0.05 / 8**0.5] * 2, rel=0.6)
    unlike = Surface.through(scores(np.diag([1.0, 1.0]), [0.1, 0.0], 8, spread=3.0), is_likelihood=False)
    assert not unlike.determined().any()
    few = Surface.through(scores(np.diag([1.0, 1.0]), [0.1, 0.0], 2, spread=0.05), is_likelihood=False)
    assert not few.determined().any(), "two recordings have no spread to speak of"


def test_without_a_recording_the_others_decide():
    values = np.concatenate([scores(H, LEAST), scores(H, -LEAST)])
    surface = Surface.through(values, is_likelihood=True)
    both = np.array([True, True])
    assert surface.offset(both) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert surface.offset(both, without=0) == pytest.approx(-LEAST)


def test_it_does_not_go_farther_than_it_knows():
    surface = Surface.through(scores(np.eye(1), [50.0]), is_likelihood=True)
    assert surface.offset(np.array([True])) == pytest.approx([LONGEST])
    hill = Surface.through(-scores(np.eye(1), [-1.0]), is_likelihood=True)
    assert hill.offset(np.array([True])) == pytest.approx([LONGEST]), "downhill"


def test_an_interval_is_a_factor_to_both_sides():
    low, high = interval(2.0, 0.1)
    assert low * high == pytest.approx(4.0)
    assert high / 2.0 == pytest.approx(np.exp(0.196))


def test_a_third_is_held_out_by_hash_and_none_of_a_few():
    names = [f"{k * 7919 % 101:03d}" for k in range(9)]
    assert len(held_out_of(names)) == 3
    assert {names[k] for k in held_out_of(names)} == {names[::-1][k] for k in held_out_of(names[::-1])}
    assert held_out_of(names[:5]) == []
