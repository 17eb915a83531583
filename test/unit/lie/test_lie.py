"""SE(2): the group axioms, its maps and Jacobians, and the noise that moves through it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se2, se3

NEAR_PI = np.pi - 1e-7


def samples(kind, count=40):
    """Tangent vectors (count, 3)."""
    rng = np.random.default_rng(7)
    if kind == "uniform":
        return np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.uniform(-np.pi, np.pi, count)])
    if kind == "identity":
        return 1e-7 * rng.standard_normal((count, 3))
    return np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.choice([-1, 1], count) * NEAR_PI])


KINDS = pytest.mark.parametrize("kind", ["uniform", "identity", "pi"])
coordinate = st.floats(-1e3, 1e3)
poses = st.tuples(coordinate, coordinate, st.floats(-20.0, 20.0))


def matrix(a):
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([[c, -s, a[0]], [s, c, a[1]], [0, 0, 1.0]])


def hat(d):
    return np.array([[0, -d[2], d[0]], [d[2], 0, d[1]], [0, 0, 0.0]])


def gap(a, b):
    """Largest difference of two poses, angles compared on the circle."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(se2.wrap(a[2] - b[2])))


@KINDS
def test_compose_inverse_and_act_are_those_of_the_matrices(kind):
    first, second = samples(kind), samples("uniform")
    for a, b in zip(first, second, strict=True):
        # matrices of entries up to 20: a few roundings
        assert matrix(se2.compose(a, b)) == pytest.approx(matrix(a) @ matrix(b), abs=1e-13)
        assert matrix(se2.inverse(a)) == pytest.approx(np.linalg.inv(matrix(a)), abs=1e-13)
        assert se2.act(a, b[:2]) == pytest.approx((matrix(a) @ [b[0], b[1], 1.0])[:2], abs=1e-13)


@given(poses, poses, poses)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_the_group_axioms_hold(a, b, c):
    tolerance = 1e-11  # coordinates to 3e3, angles to 60: their rounding times the lever
    assert gap(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c))) < tolerance
    assert gap(se2.compose(a, se2.inverse(a)), se2.IDENTITY) < tolerance
    assert se2.compose(a, se2.IDENTITY) == a
    assert gap(se2.between(a, b), se2.compose(se2.inverse(a), b)) < tolerance
    assert gap(se2.inverse(se2.between(a, b)), se2.between(b, a)) < tolerance


@given(st.floats(-1e4, 1e4))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_wrap_gives_the_same_direction_within_half_a_turn(angle):
    wrapped = se2.wrap(angle)
    assert -np.pi <= wrapped <= np.pi
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-11  # 1e4 / 2 pi turns, each rounded


def test_wrap_keeps_small_angles_to_the_bit_and_takes_pi_to_minus_pi():
    for angle in (0.0, 1e-300, -1e-17, 3.0, -3.1, -np.pi):
        assert se2.wrap(angle) == angle
    assert se2.wrap(np.pi) == -np.pi


@KINDS
def test_exp_and_log_are_those_of_the_matrices(kind):
    for d in samples(kind):
        assert matrix(se2.exp(d)) == pytest.approx(expm(hat(d)), abs=1e-12)
        if kind != "pi":  # logm has no accuracy of its own there
            assert hat(se2.log(se2.exp(d))) == pytest.approx(logm(matrix(se2.exp(d))).real, abs=1e-11)


@KINDS
def test_log_undoes_exp_and_local_undoes_retract(kind):
    for a, d in zip(samples("uniform"), samples(kind), strict=True):
        # relative to the vector: nothing cancels near the identity
        assert np.array(se2.log(se2.exp(d))) == pytest.approx(d, rel=1e-13, abs=1e-13 * np.abs(d).max())
        # the tangent near pi is sensitive to the angle (factor v), coordinates up to 20
        assert np.array(se2.local(se2.retract(a, d), a)) == pytest.approx(d, rel=1e-9, abs=1e-13)


def test_the_perturbation_of_retract_is_in_the_frame_of_the_body():
    assert se2.retract((3.0, 4.0, np.pi / 2), (1.0, 0.0, 0.0)) == pytest.approx((3.0, 5.0, np.pi / 2))


@KINDS
def test_the_adjoint_moves_a_perturbation_from_right_to_left(kind):
    for a, d in zip(samples("uniform"), samples(kind), strict=True):
        left = se2.compose(se2.exp(se2.adjoint(a) @ d), a)
        assert gap(se2.compose(a, se2.exp(d)), left) < 1e-12  # coordinates up to 50


def test_the_adjoint_is_a_homomorphism():
    for a, b in zip(samples("uniform"), samples("pi"), strict=True):
        product = se2.adjoint(a) @ se2.adjoint(b)
        assert se2.adjoint(se2.compose(a, b)) == pytest.approx(product, abs=1e-13)
        assert se2.adjoint(se2.inverse(a)) @ se2.adjoint(a) == pytest.approx(np.eye(3), abs=1e-13)


def numeric_right_jacobian(d, step=1e-5):
    columns = []
    for e in step * np.eye(3):
        plus, minus = (se2.local(se2.exp(d + sign * e), se2.exp(d)) for sign in (1, -1))
        columns.append((np.array(plus) - np.array(minus)) / (2 * step))
    return np.stack(columns, axis=1)


@KINDS
def test_the_right_jacobian_is_the_numeric_one(kind):
    for d in samples(kind):
        # central differences: step^2 times a third derivative (up to 10), and rounding / step
        assert se2.right_jacobian(tuple(d)) == pytest.approx(numeric_right_jacobian(d), abs=2e-9)


def test_the_right_jacobian_is_smooth_where_its_series_ends():
    below, above = (se2.right_jacobian((8.0, -5.0, w)) for w in (1e-3 * (1 - 1e-9), 1e-3 * (1 + 1e-9)))
    assert below == pytest.approx(above, abs=1e-11)  # 2e-12 apart, times 8


@KINDS
def test_the_right_jacobian_is_the_integral_of_the_adjoint(kind):
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for d in samples(kind, 10):
        parts = [se2.adjoint(se2.exp(-0.5 * (node + 1) * d)) for node in nodes]
        integral = sum(0.5 * weight * part for weight, part in zip(weights, parts, strict=True))
        assert se2.right_jacobian(tuple(d)) == pytest.approx(integral, abs=1e-12)


def test_interpolation_runs_at_constant_velocity_from_one_pose_to_the_other():
    for a, d in zip(samples("uniform"), samples("pi"), strict=True):
        d = 0.9 * d  # short of half a turn, where the geodesic is not unique
        b = se2.retract(a, d)
        assert gap(se2.interpolate(a, b, 0.0), a) < 1e-12
        assert gap(se2.interpolate(a, b, 1.0), b) < 1e-12
        assert gap(se2.interpolate(a, b, 0.3), se2.compose(a, se2.exp(0.3 * d))) < 1e-12


def test_interpolation_takes_the_short_way_across_half_a_turn():
    middle = se2.interpolate((0.0, 0.0, 3.0), (0.0, 0.0, -3.0), 0.5)
    assert abs(se2.wrap(middle[2] - np.pi)) < 1e-12


@pytest.mark.parametrize("name", ["compose", "between", "retract", "local", "act"])
def test_arrays_and_floats_give_the_same(name):
    function = getattr(se2, name)
    a, b = (np.vstack([samples(kind) for kind in ("uniform", "identity", "pi")]) for _ in range(2))
    b = b[::-1]
    whole = np.stack(function(tuple(a.T), tuple(b.T)), axis=1)
    one_by_one = np.array([function(tuple(p), tuple(q)) for p, q in zip(a.tolist(), b.tolist(), strict=True)])
    assert whole == pytest.approx(one_by_one, rel=1e-14, abs=1e-14)  # vector sines may differ in the last bit


@pytest.mark.parametrize("name", ["inverse", "exp", "log", "wrap"])
def test_arrays_and_floats_give_the_same_for_one_argument(name):
    a = np.vstack([samples(kind) for kind in ("uniform", "identity", "pi")])
    if name == "wrap":
        whole, single = se2.wrap(4 * a), np.array([[se2.wrap(x) for x in row] for row in (4 * a).tolist()])
    else:
        function = getattr(se2, name)
        whole = np.stack(function(tuple(a.T)), axis=1)
        single = np.array([function(tuple(p)) for p in a.tolist()])
    assert whole == pytest.approx(single, rel=1e-14, abs=1e-14)


def a_covariance(scale, seed=3):
    a = np.random.default_rng(seed).standard_normal((3, 3))
    return scale**2 * (a @ a.T + 0.2 * np.eye(3))


@KINDS
def test_propagate_is_the_first_order_formula_with_numeric_derivatives(kind):
    before, added, start = a_covariance(1.0), a_covariance(0.5, 4), (3.0, -2.0, 0.7)
    for step in samples(kind, 10):
        end = se2.compose(start, step)
        columns = []
        for e in 1e-5 * np.eye(3):
            plus, minus = (se2.local(se2.compose(se2.retract(start, s * e), step), end) for s in (1, -1))
            columns.append((np.array(plus) - np.array(minus)) / 2e-5)
        j = np.stack(columns, axis=1)
        expected = j @ before @ j.T + added
        assert se2.propagate(before, tuple(step), added) == pytest.approx(expected, rel=1e-7, abs=1e-7)


def test_propagate_agrees_with_drawn_motions():
    rng, count, step = np.random.default_rng(1), 20000, (2.0, -1.0, 0.8)
    before, added = a_covariance(0.003), a_covariance(0.002, 4)
    drawn = (rng.multivariate_normal(np.zeros(3), c, count) for c in (before, added))
    first, second = (tuple(d.T) for d in drawn)
    ends = se2.compose(se2.exp(first), se2.retract(step, second))
    errors = np.stack(se2.local(ends, step), axis=1)
    expected = se2.propagate(before, step, added)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # 20,000 samples: an entry is known to sqrt(2 / 20000) = 1 %, here 4 sigma
    assert np.abs((np.cov(errors.T) - expected) / scale).max() < 0.04


def test_noise_during_agrees_with_drawn_velocities():
    rng, velocity = np.random.default_rng(2), np.array([1.5, 0.2, 1.1])
    of_twist = a_covariance(0.003)
    drawn = velocity + rng.multivariate_normal(np.zeros(3), of_twist, 20000)
    errors = np.stack(se2.local(se2.exp(tuple(drawn.T)), se2.exp(tuple(velocity))), axis=1)
    expected = se2.noise_during(se2.exp(tuple(velocity)), of_twist)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((np.cov(errors.T) - expected) / scale).max() < 0.04  # as above


@KINDS
def test_noise_during_is_the_plain_formula(kind):
    of_twist = a_covariance(1.0)
    for d in samples(kind, 10):
        step = se2.exp(tuple(d))
        j = se2.right_jacobian(se2.log(step))
        assert se2.noise_during(step, of_twist) == pytest.approx(j @ of_twist @ j.T, rel=1e-12, abs=1e-12)
        both = se2.propagate_during(a_covariance(0.5, 4), step, of_twist)
        assert both == pytest.approx(se2.propagate(a_covariance(0.5, 4), step, j @ of_twist @ j.T), rel=1e-12)


@pytest.mark.parametrize("group", [se2, se3])
def test_single_poses_are_computed_alike_compiled_and_not(group):
    rng, size = np.random.default_rng(3), len(group.IDENTITY)
    for _ in range(200):
        a, b = (tuple(rng.normal(0.0, 5.0, size).tolist()) for _ in range(2))
        assert group.between_one(a, b) == pytest.approx(group.between(a, b), rel=1e-14, abs=1e-12)
        assert group.compose_one(a, b) == pytest.approx(group.compose(a, b), rel=1e-14, abs=1e-12)


def test_the_noise_of_a_step_is_that_of_its_parts_fully_correlated():
    whole, of_twist, count = (1.0, 0.3, 0.5), np.diag([0.04, 0.01, 0.02]), 400
    part, j = tuple(np.array(whole) / count), np.zeros((3, 3))
    for _ in range(count):  # one error of velocity all through: what it did so far is carried on, and it adds the same
        j = se2.adjoint(se2.inverse(se2.exp(part))) @ j + se2.right_jacobian(part) / count
    assert se2.noise_during(se2.exp(whole), of_twist) == pytest.approx(j @ of_twist @ j.T, rel=1e-10)


def test_matrices_of_poses_are_those_of_scipy_and_lead_back():
    rng = np.random.default_rng(3)
    turns = Rotation.random(200, random_state=4)
    half = Rotation.from_rotvec(np.pi * np.vstack([np.eye(3), [[0.6, 0.8, 0.0]]]))  # where w is zero
    quaternions = np.vstack([turns.as_quat(), half.as_quat()])
    path = np.hstack([rng.uniform(-5, 5, (204, 3)), quaternions])
    matrices = se3.to_matrix(tuple(path.T))
    assert matrices.shape == (204, 4, 4)
    assert matrices[:, :3, :3] == pytest.approx(Rotation.from_quat(quaternions).as_matrix(), abs=1e-14)
    back = np.stack(se3.from_matrix(matrices), axis=-1)
    assert back[:, :3] == pytest.approx(path[:, :3])
    assert np.abs((back[:, 3:] * quaternions).sum(axis=1)) == pytest.approx(1.0, abs=1e-14)
    assert (back[:, 6] >= 0.0).all()
    one = se3.from_matrix(se3.to_matrix(tuple(path[7])))
    assert se3.to_matrix(one) == pytest.approx(matrices[7], abs=1e-14)

    planar = samples("uniform")
    assert se2.to_matrix(tuple(planar.T))[5] == pytest.approx(matrix(planar[5]), abs=1e-15)
    assert np.stack(se2.from_matrix(se2.to_matrix(tuple(planar.T))), axis=-1) == pytest.approx(planar, abs=1e-14)


@pytest.mark.parametrize(
    "wrong",
    [np.eye(3) * 2.0, np.diag([1.0, -1.0, 1.0]), np.eye(4), [[1, 0, 0], [0, 1, 0], [0, 1, 1]], np.full((3, 3), np.nan)],
    ids=["scaled", "mirrored", "of space", "projective", "nan"],
)
def test_what_is_no_rigid_motion_is_refused(wrong):
    with pytest.raises(GraphSlamError, match=r"not a rigid motion|has the shape \(3, 3\)"):
        se2.from_matrix(wrong)
