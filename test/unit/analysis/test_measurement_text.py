"""Sigmas of information matrices, of which some determine not every number."""

import numpy as np
import pytest

from graph_slam_ros.analysis.measurement_text import sigmas_of


def test_sigmas_are_the_roots_of_the_diagonal_of_the_inverse():
    root = np.random.default_rng(0).normal(size=(5, 3, 3))
    information = root @ root.swapaxes(1, 2) + 0.1 * np.eye(3)
    wanted = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
    assert sigmas_of(information) == pytest.approx(wanted)


def test_a_number_that_is_not_determined_has_an_infinite_sigma():
    along = np.array([1.0, 1.0, 0.0])
    assert sigmas_of(np.diag([4.0, 0.0, 25.0])) == pytest.approx([0.5, np.inf, 0.2])
    assert sigmas_of(np.outer(along, along) + np.diag([0.0, 0.0, 4.0])) == pytest.approx([np.inf, np.inf, 0.5])
