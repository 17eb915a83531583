"""Noise models refuse what is not a covariance; losses are what they say and their weights are their slopes."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import GraphSlamError, NoiseError
from graph_slam_ros.graph import CAUCHY, HUBER, NONE, Gaussian, Loss
from graph_slam_ros.graph.losses import weight_and_cost

GOOD = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]])

BAD = {
    "zero": (np.zeros((3, 3)), "not positive definite"),
    "one nan beside the diagonal": (GOOD + np.array([[0, 0, np.nan], [0, 0, 0], [np.nan, 0, 0]]), "not finite"),
    "infinite": (np.diag([1.0, np.inf, 1.0]), "not finite"),
    "asymmetric": (GOOD + np.array([[0, 1e-3, 0], [0, 0, 0], [0, 0, 0]]), "not symmetric"),
    "huge": ([[1.0, 0.0, 1e308], [0.0, 1.0, 0.0], [1e308, 0.0, 1.0]], "not positive definite"),
    "negative": (-GOOD, "not positive definite"),
    "indefinite": (np.diag([1.0, -1e-9, 1.0]), "not positive definite"),
}
LOSSES = [(NONE, 1.0), (HUBER, 1.0), (HUBER, 2.5), (CAUCHY, 1.0), (CAUCHY, 0.3)]


@each("build", [Gaussian.from_covariance, Gaussian.from_information])
@each("name", BAD)
def test_what_is_no_covariance_is_refused_with_its_row(build, name):
    matrix, why = BAD[name]
    with pytest.raises(NoiseError, match=why):
        build(matrix)
    with pytest.raises(NoiseError, match=f" 2 is {why}"):
        build(np.stack([GOOD, GOOD, matrix, np.zeros((3, 3))]))
    with pytest.raises(NoiseError, match="shape"):
        build(np.ones((2, 3)))


def test_no_singular_matrix_passes_by_rounding():
    rng = np.random.default_rng(5)
    for rank in (1, 2):
        for _ in range(300):
            a = rng.standard_normal((3, rank)) * 10.0 ** rng.uniform(-4, 4, (3, 1))
            with pytest.raises(NoiseError):
                Gaussian.from_covariance(a @ a.T)


def test_variances_of_very_different_size_are_no_fault():
    sigmas = np.array([1e-6, 1.0, 1e4])
    correlation = np.array([[1, 0.9, -0.5], [0.9, 1, -0.3], [-0.5, -0.3, 1]])
    covariance = correlation * np.outer(sigmas, sigmas)
    found = Gaussian.from_covariance(covariance).information / np.outer(1 / sigmas, 1 / sigmas)
    assert found == pytest.approx(np.linalg.inv(correlation), rel=1e-12)


def test_whitened_noise_has_unit_covariance():
    # R'R = Omega, so R Sigma R' = I: were R stored transposed, only diagonal matrices would pass
    for noise in (Gaussian.from_covariance(GOOD), Gaussian.from_information(np.linalg.inv(GOOD))):
        r = noise.sqrt_information
        assert r @ GOOD @ r.T == pytest.approx(np.eye(3), abs=1e-12)


@each("kind, scale", LOSSES)
def test_a_loss_is_that_of_the_literature_and_its_weight_is_its_slope(kind, scale):
    assert weight_and_cost(kind, scale, 0.0) == (1.0, 0.0)
    for s in np.geomspace(1e-6, 1e6, 97).tolist():
        step, r = 1e-5 * s, np.sqrt(s)
        numeric = (weight_and_cost(kind, scale, s + step)[1] - weight_and_cost(kind, scale, s - step)[1]) / (2 * step)
        # at Huber's kink the slope is continuous but not smooth: first order in the step
        weight, cost = weight_and_cost(kind, scale, s)
        assert weight == pytest.approx(numeric, rel=2e-5)
        huber = s if r <= scale else 2.0 * scale * r - scale**2
        assert cost == pytest.approx({NONE: s, HUBER: huber, CAUCHY: scale**2 * np.log1p(s / scale**2)}[kind], rel=1e-9)


def test_a_loss_that_cannot_be_is_refused():
    for bad in ((HUBER, 0.0), (CAUCHY, -1.0), (HUBER, np.nan), (HUBER, np.inf), (17, 1.0)):
        with pytest.raises(GraphSlamError):
            Loss(*bad)
    for sigma in (-0.1, 0.0, np.nan):
        with pytest.raises(GraphSlamError, match="must be > 0"):
            Gaussian.from_sigmas(0.1, sigma)
    with pytest.raises(GraphSlamError, match=r"'tukey'.*none, huber, cauchy"):
        Loss.named("tukey")
    assert Loss.named("cauchy", 2.0) == Loss(CAUCHY, 2.0)
