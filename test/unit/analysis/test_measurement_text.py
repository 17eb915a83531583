"""Sigmas of information matrices, of which some determine not every number."""

import numpy as np
import pytest

from graph_slam_ros.analysis.measurement_text import sigmas_of


def test_sigmas_are_the_roots_of_the_diagonal_of_the_inverse_and_infinite_where_nothing_is_determined():
    assert sigmas_of(np.array([[2.0, 1.0], [1.0, 2.0]])) == pytest.approx(np.sqrt([2.0 / 3.0] * 2))
    along = np.array([1.0, 1.0, 0.0])
    assert sigmas_of(np.diag([4.0, 0.0, 25.0])) == pytest.approx([0.5, np.inf, 0.2])
    assert sigmas_of(np.outer(along, along) + np.diag([0.0, 0.0, 4.0])) == pytest.approx([np.inf, np.inf, 0.5])
