"""SE(2) and SE(3): maps and Jacobians against matrices and numeric derivatives, and the noise that moves through."""

import numpy as np
import pytest
from rows import each
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se2, se3, so3

GROUPS = [(se2, 3), (se3, 6)]
NEAR_PI = np.pi - 1e-7


def samples(kind="all", count=40):
    """Tangent vectors (count, 3) of the plane; of all kinds 3 count."""
    if kind == "all":
        return np.vstack([samples(kind, count) for kind in ("uniform", "identity", "pi")])
    rng = np.random.default_rng(7)
    if kind == "uniform":
        return np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.uniform(-np.pi, np.pi, count)])
    if kind == "identity":
        return 1e-7 * rng.standard_normal((count, 3))
    return np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.choice([-1, 1], count) * NEAR_PI])


def tangents(dof, count=20):
    """Of all sizes that matter: next to zero, ordinary, and rotations next to pi."""
    if dof == 3:
        return samples(count=count)
    rng, out = np.random.default_rng(1), []
    for angle in (1e-9, 1e-5, 1e-2, 0.1, 1.0, 3.1):
        for d in rng.normal(size=(count, 6)):
            d[3:] *= angle / np.linalg.norm(d[3:])
            out.append(d)
    return np.array(out)


def matrix(a):
    return (se3 if len(a) == 7 else se2).to_matrix(a)


def hat(d):
    if len(d) == 6:
        out = np.zeros((4, 4))
        out[:3, :3], out[:3, 3] = so3.hat(tuple(d[3:])), d[:3]
        return out
    return np.array([[0, -d[2], d[0]], [d[2], 0, d[1]], [0, 0, 0.0]])


def gap(a, b):
    """Largest difference of two poses, angles compared on the circle."""
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(se2.wrap(a[2] - b[2])))


@each("group, dof", GROUPS)
def test_the_group_is_that_of_the_matrices(group, dof):
    poses = [group.exp(tuple(d)) for d in tangents(dof)]
    for d, a, b in zip(tangents(dof), poses, poses[::-1], strict=True):
        point, rounding = (1.0, -2.0, 3.0)[: len(matrix(a)) - 1], 1e-12
        assert matrix(a) == pytest.approx(expm(hat(d)), abs=rounding)
        assert matrix(group.compose(a, b)) == pytest.approx(matrix(a) @ matrix(b), abs=rounding)
        assert matrix(group.inverse(a)) == pytest.approx(np.linalg.inv(matrix(a)), abs=rounding)
        assert matrix(group.between(a, b)) == pytest.approx(np.linalg.solve(matrix(a), matrix(b)), abs=1e-11)
        assert group.act(a, point) == pytest.approx((matrix(a) @ [*point, 1.0])[:-1], abs=rounding)
        # near pi the axis in space comes from a cosine near zero, and a tangent is sensitive to the angle
        assert np.array(group.log(a)) == pytest.approx(d, rel=1e-9, abs=1e-9)
        assert np.array(group.local(group.retract(b, tuple(d)), b)) == pytest.approx(d, rel=1e-9, abs=1e-9)
        if dof == 3 and abs(d[2]) < 3.0:
            assert hat(se2.log(a)) == pytest.approx(logm(matrix(a)).real, abs=1e-11)
            assert np.array(se2.log(a)) == pytest.approx(d, rel=1e-13, abs=1e-13 * np.abs(d).max())


def test_wrap_gives_the_same_direction_within_half_a_turn():
    for angle in np.random.default_rng(1).uniform(-1e4, 1e4, 2000).tolist():
        assert -np.pi <= se2.wrap(angle) <= np.pi
        assert abs(np.exp(1j * se2.wrap(angle)) - np.exp(1j * angle)) < 1e-11  # 1e4 / 2 pi turns, each rounded
    for angle in (0.0, 1e-300, -1e-17, 3.0, -3.1, -np.pi):
        assert se2.wrap(angle) == angle
    assert se2.wrap(np.pi) == -np.pi


def test_the_perturbation_of_retract_is_in_the_frame_of_the_body():
    assert se2.retract((3.0, 4.0, np.pi / 2), (1.0, 0.0, 0.0)) == pytest.approx((3.0, 5.0, np.pi / 2))
    for a, d in zip(np.vstack([samples("uniform")] * 3), samples(), strict=True):
        left = se2.compose(se2.exp(se2.adjoint(a) @ d), a)
        assert gap(se2.compose(a, se2.exp(d)), left) < 1e-12  # coordinates up to 50


def numeric(function, dof, step=1e-5):
    """Derivative of a function of a tangent vector at zero, by central differences."""
    moved = [[np.array(function(sign * e)) for sign in (1, -1)] for e in step * np.eye(dof)]
    return np.stack([(plus - minus) / (2.0 * step) for plus, minus in moved], axis=1)


def test_right_jacobians_are_the_numeric_ones():
    for d in samples():
        # central differences: step^2 times a third derivative (up to 10), and rounding / step
        found = numeric(lambda e, d=d: se2.local(se2.exp(d + e), se2.exp(d)), 3)
        assert se2.right_jacobian(tuple(d)) == pytest.approx(found, abs=2e-9)
    for d in tangents(6):
        w = tuple(d[3:])
        if np.linalg.norm(w) < 3.0:  # beyond, the two sides fall on different sheets
            found = numeric(lambda e, w=w: so3.log(so3.compose(so3.exp(w), so3.exp(tuple(e)))), 3, 1e-6)
            ours = np.stack([so3.right_jacobian_inverse(w, tuple(e)) for e in np.eye(3)], axis=1)
            assert ours == pytest.approx(found, abs=1e-7)


def test_interpolation_runs_at_constant_velocity_from_one_pose_to_the_other():
    for a, d in zip(samples("uniform"), samples("pi"), strict=True):
        d = 0.9 * d  # short of half a turn, where the geodesic is not unique
        b = se2.retract(a, d)
        assert gap(se2.interpolate(a, b, 0.0), a) < 1e-12
        assert gap(se2.interpolate(a, b, 1.0), b) < 1e-12
        assert gap(se2.interpolate(a, b, 0.3), se2.compose(a, se2.exp(0.3 * d))) < 1e-12
    middle = se2.interpolate((0.0, 0.0, 3.0), (0.0, 0.0, -3.0), 0.5)
    assert abs(se2.wrap(middle[2] - np.pi)) < 1e-12, "the short way across half a turn"


@each("group, dof", GROUPS)
def test_arrays_and_floats_give_the_same(group, dof):
    a = np.stack(group.exp(tuple(tangents(dof).T)), axis=1)
    b, d = a[::-1], tangents(dof)[::-1]
    others = {"compose": b, "between": b, "local": b, "retract": d, "act": b[:, : len(matrix(a[0])) - 1]}
    for name, other in others.items():
        function = getattr(group, name)
        whole = np.stack(function(tuple(a.T), tuple(other.T)), axis=1)
        one_by_one = [function(tuple(p), tuple(q)) for p, q in zip(a.tolist(), other.tolist(), strict=True)]
        assert whole == pytest.approx(np.array(one_by_one), rel=1e-13, abs=1e-12), name  # sines of a vector may differ
    for name, argument in (("inverse", a), ("exp", d), ("log", a)):
        function = getattr(group, name)
        one_by_one = np.array([function(tuple(p)) for p in argument.tolist()])
        assert np.stack(function(tuple(argument.T)), axis=1) == pytest.approx(one_by_one, rel=1e-13, abs=1e-12), name
    for p, q in zip(map(tuple, a.tolist()), map(tuple, b.tolist()), strict=True):
        assert group.between_one(p, q) == pytest.approx(group.between(p, q), rel=1e-14, abs=1e-12)
        assert group.compose_one(p, q) == pytest.approx(group.compose(p, q), rel=1e-14, abs=1e-12)


def a_covariance(scale, seed=3):
    a = np.random.default_rng(seed).standard_normal((3, 3))
    return scale**2 * (a @ a.T + 0.2 * np.eye(3))


def test_propagate_is_the_first_order_formula_with_numeric_derivatives():
    before, added, start = a_covariance(1.0), a_covariance(0.5, 4), (3.0, -2.0, 0.7)
    for step in samples(count=10):
        end = se2.compose(start, step)
        j = numeric(lambda e, step=step, end=end: se2.local(se2.compose(se2.retract(start, e), step), end), 3)
        expected = j @ before @ j.T + added
        assert se2.propagate(before, tuple(step), added) == pytest.approx(expected, rel=1e-7, abs=1e-7)


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
    assert np.stack(se2.from_matrix(se2.to_matrix(tuple(planar.T))), axis=-1) == pytest.approx(planar, abs=1e-14)


@each(
    "wrong",
    [np.eye(3) * 2.0, np.diag([1.0, -1.0, 1.0]), np.eye(4), [[1, 0, 0], [0, 1, 0], [0, 1, 1]], np.full((3, 3), np.nan)],
)
def test_what_is_no_rigid_motion_is_refused(wrong):
    with pytest.raises(GraphSlamError, match=r"not a rigid motion|has the shape \(3, 3\)"):
        se2.from_matrix(wrong)


def test_the_plane_lies_in_space_level_and_at_height_zero_and_its_motions_stay_its_motions():
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-3.0, 3.0, (2, 20, 3))
    together = np.stack(se2.compose(tuple(a.T), tuple(b.T)), axis=1)
    raised = np.stack(se3.compose(tuple(se3.in_space(a).T), tuple(se3.in_space(b).T)), axis=1)
    assert raised[:, 2:5].tolist() == [[0.0] * 3] * 20
    back = se3.in_plane(raised)
    assert back[:, :2] == pytest.approx(together[:, :2])
    assert back[:, 2] == pytest.approx(se2.wrap(together[:, 2]))
    assert se3.in_space((1.0, 2.0, np.pi)) == pytest.approx([1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    rolled = so3.compose(so3.exp((0.0, 0.0, 2.5)), so3.compose(so3.exp((0.0, -0.6, 0.0)), so3.exp((0.9, 0.0, 0.0))))
    assert se3.in_plane((1.0, 2.0, 9.0, *rolled)) == pytest.approx([1.0, 2.0, 2.5]), "the heading of its x axis"
