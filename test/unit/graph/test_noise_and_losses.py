"""Noise models refuse what is not a covariance; losses are what they say and their weights are their slopes."""

import numpy as np
import pytest
from rows import each

from graph_slam_ros.errors import GraphSlamError, NoiseError
from graph_slam_ros.graph import CAUCHY, HUBER, NONE, Gaussian, Loss
from graph_slam_ros.graph.losses import weight_and_cost

GOOD = np.array([[4.0, 1.0, -0.5], [1.0, 2.0, 0.3], [-0.5, 0.3, 1.0]])
RANK_ONE = np.outer([0.1, 0.2, 0.3], [0.1, 0.2, 0.3])
BAD = {
    "zero": (np.zeros((3, 3)), "not positive definite"),
    "nan": (np.where(np.eye(3) > 0, np.nan, 0.0), "not finite"),
    "one nan beside the diagonal": (GOOD + np.array([[0, 0, np.nan], [0, 0, 0], [np.nan, 0, 0]]), "not finite"),
    "infinite": (np.diag([1.0, np.inf, 1.0]), "not finite"),
    "asymmetric": (GOOD + np.array([[0, 1e-3, 0], [0, 0, 0], [0, 0, 0]]), "not symmetric"),
    "huge": ([[1.0, 0.0, 1e308], [0.0, 1.0, 0.0], [1e308, 0.0, 1.0]], "not positive definite"),
    "rank one": (RANK_ONE, "not positive definite"),
    "negative": (-GOOD, "not positive definite"),
    "indefinite": (np.diag([1.0, -1e-9, 1.0]), "not positive definite"),
    "one zero variance": (np.diag([1.0, 0.0, 1.0]), "not positive definite"),
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


@each("shape", [(3,), (2, 3), (2, 2, 3), ()])
def test_what_is_not_square_is_refused_with_its_shape(shape):
    with pytest.raises(NoiseError, match="shape"):
        Gaussian.from_information(np.ones(shape))


def test_whitened_noise_has_unit_covariance():
    # R'R = Omega, so R Sigma R' = I: were R stored transposed, only diagonal matrices would pass
    for noise in (Gaussian.from_covariance(GOOD), Gaussian.from_information(np.linalg.inv(GOOD))):
        r = noise.sqrt_information
        assert r @ GOOD @ r.T == pytest.approx(np.eye(3), abs=1e-12)


@each("kind, scale", LOSSES)
def test_the_weight_is_the_slope_of_the_loss(kind, scale):
    for s in np.geomspace(1e-6, 1e6, 97).tolist():
        step = 1e-5 * s
        numeric = (weight_and_cost(kind, scale, s + step)[1] - weight_and_cost(kind, scale, s - step)[1]) / (2 * step)
        # at Huber's kink the slope is continuous but not smooth: first order in the step
        assert weight_and_cost(kind, scale, s)[0] == pytest.approx(numeric, rel=2e-5)


@each("kind, scale", LOSSES)
def test_a_loss_is_chi2_near_zero_and_never_above_it(kind, scale):
    assert weight_and_cost(kind, scale, 0.0) == (1.0, 0.0)
    s = np.geomspace(1e-9, 1e9, 200)
    weight, cost = np.array([weight_and_cost(kind, scale, x) for x in s]).T
    small = s < 1e-6 * scale**2
    assert cost[small] == pytest.approx(s[small], rel=1e-6)
    assert (cost <= s * (1 + 1e-15)).all()
    assert (np.diff(cost) > 0).all()
    assert (np.diff(weight) <= 0).all()
    assert (weight > 0).all()


@each("scale", [0.5, 1.0, 3.0])
def test_huber_is_continuous_at_its_scale_and_linear_beyond(scale):
    below, above = (weight_and_cost(HUBER, scale, scale**2 * (1 + e)) for e in (-1e-12, 1e-12))
    assert below == pytest.approx(above, rel=1e-11)
    # in the residual: 2 k |r| - k^2
    assert weight_and_cost(HUBER, scale, (5 * scale) ** 2) == pytest.approx((1 / 5, 9 * scale**2))


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
