"""Space: SO(3) and SE(3) against matrix exponentials, edges against numeric derivatives, public graphs."""

import numpy as np
import pytest
from places import DATASETS
from scipy.linalg import expm

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.graph import LANDMARK_POSITION_3D, POSE_PRIOR_3D, RELATIVE_POSE_3D, numeric_jacobian
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.solver import Solver

GRAPHS = DATASETS
GRAPHS = GRAPHS / "pose_graphs"


def tangents(seed, count=40):
    """Of all sizes that matter: next to zero, ordinary, and rotations next to pi."""
    rng = np.random.default_rng(seed)
    for angle in (1e-9, 1e-5, 1e-2, 0.1, 1.0, 3.1):
        for _ in range(count):
            d = rng.normal(size=6)
            d[3:] *= angle / np.linalg.norm(d[3:])
            yield d


def homogeneous(p):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = so3.matrix(se3.rotation(p)), se3.position(p)
    return out


def test_exp_is_the_matrix_exponential():
    for d in tangents(1):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = so3.hat(tuple(d[3:])), d[:3]
        assert np.abs(homogeneous(se3.exp(tuple(d))) - expm(generator)).max() < 1e-12


def test_log_inverts_exp():
    for d in tangents(2):
        # near pi the rotation axis comes from a cosine near zero: digits are lost there
        assert np.abs(np.array(se3.log(se3.exp(tuple(d)))) - d).max() < 1e-9


def test_composition_inverse_and_action_are_those_of_matrices():
    poses = [se3.exp(tuple(d)) for d in tangents(3, 5)]
    for a, b in zip(poses, poses[::-1], strict=True):
        A, B = homogeneous(a), homogeneous(b)
        assert np.abs(homogeneous(se3.compose(a, b)) - A @ B).max() < 1e-12
        assert np.abs(homogeneous(se3.between(a, b)) - np.linalg.solve(A, B)).max() < 1e-12
        assert np.abs(homogeneous(se3.inverse(a)) - np.linalg.inv(A)).max() < 1e-12
        assert np.abs(np.array(se3.act(a, (1.0, -2.0, 3.0))) - (A @ [1.0, -2.0, 3.0, 1.0])[:3]).max() < 1e-12


def test_whole_arrays_give_what_single_poses_give():
    d = np.array(list(tangents(4, 3)))
    together = np.stack(se3.local(se3.exp(tuple(d.T)), se3.exp(tuple(d[::-1].T))), axis=-1)
    one_by_one = [se3.local(se3.exp(tuple(a)), se3.exp(tuple(b))) for a, b in zip(d, d[::-1], strict=True)]
    assert np.abs(together - np.array(one_by_one)).max() < 1e-12


def test_the_inverse_right_jacobian_is_the_derivative_of_the_logarithm():
    h = 1e-6
    for d in tangents(5, 10):
        w = tuple(d[3:])
        moved = [[so3.log(so3.compose(so3.exp(w), so3.exp(tuple(s * e)))) for s in (h, -h)] for e in np.eye(3)]
        numeric = np.stack([np.subtract(plus, minus) / (2.0 * h) for plus, minus in moved], axis=1)
        if np.linalg.norm(w) < 3.0:  # beyond, the two sides fall on different sheets
            ours = np.stack([so3.right_jacobian_inverse(w, tuple(e)) for e in np.eye(3)], axis=1)
            assert np.abs(ours - numeric).max() < 1e-7


@pytest.mark.parametrize("spread", [1e-3, 0.8])
@pytest.mark.parametrize("edge", [RELATIVE_POSE_3D, POSE_PRIOR_3D, LANDMARK_POSITION_3D], ids=lambda e: e.name)
def test_jacobians_in_space_are_the_numeric_ones(edge, spread):
    rng = np.random.default_rng(6)
    for _ in range(30):
        poses = [np.array(se3.exp(tuple(rng.normal(size=6)))) for _ in range(2)]
        error = se3.exp(tuple(spread * rng.normal(size=6)))
        if edge is LANDMARK_POSITION_3D:
            values, measured = (poses[0], rng.normal(size=3)), rng.normal(size=3)
        elif edge is POSE_PRIOR_3D:
            values, measured = (poses[0],), np.array(se3.compose(tuple(poses[0]), error))
        else:
            values, measured = tuple(poses), np.array(se3.compose(se3.between(*map(tuple, poses)), error))
        at = np.cumsum([0, *(len(v) for v in values[:-1])])[None, :]
        _, analytic = edge.linearize(np.concatenate(values), at, measured[None, :])
        numeric = numeric_jacobian(edge, values, measured)
        assert np.abs(analytic[0] - numeric).max() < 2e-7 * (1.0 + np.abs(numeric).max())


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
@pytest.mark.parametrize(
    ("name", "optimum"), [("smallGrid3D", 1033.9), ("parking-garage", 1.26838), ("sphere2500", 1351.36)]
)
def test_public_graphs_in_space_reach_their_optimum(name, optimum):
    file = read_g2o(GRAPHS / f"{name}.g2o", raw=True)
    assert solved(file).chi2_final == pytest.approx(optimum, rel=1e-4)


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
def test_the_information_of_rotations_is_scaled_when_read_and_back_when_written(tmp_path):
    original = (GRAPHS / "tinyGrid3D.g2o").read_text().splitlines()
    file = read_g2o(GRAPHS / "tinyGrid3D.g2o")
    write_g2o(tmp_path / "again.g2o", file, lambda ids: initial(file.graph, ids))
    again = (tmp_path / "again.g2o").read_text().splitlines()
    of = [
        [list(map(float, line.split()[3:])) for line in lines if line.startswith("EDGE")] for lines in (original, again)
    ]
    assert np.abs(np.sort(of[0], axis=0) - np.sort(of[1], axis=0)).max() < 1e-5  # quaternions come back normalised
    raw = read_g2o(GRAPHS / "tinyGrid3D.g2o", raw=True)
    information = [f.graph.tables[RELATIVE_POSE_3D].sqrt_information.values for f in (file, raw)]
    scaled, plain = (np.swapaxes(r, 1, 2) @ r for r in information)
    assert np.allclose(4.0 * scaled[:, 3:, 3:], plain[:, 3:, 3:])
    assert np.allclose(scaled[:, :3, :3], plain[:, :3, :3])


def solved(file):
    solver = Solver(file.graph)
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    solver.hold(0)
    return solver.optimize()


def initial(graph, ids):
    size = graph.kind_of(ids[0]).size
    return graph.initial.values[graph.offset.values[np.asarray(ids)][:, None] + np.arange(size)]


def test_the_plane_lies_in_space_level_and_at_height_zero_and_its_motions_stay_its_motions():
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-3.0, 3.0, (2, 20, 3))
    together = np.stack(se2.compose(tuple(a.T), tuple(b.T)), axis=1)
    raised = np.stack(se3.compose(tuple(se3.in_space(a).T), tuple(se3.in_space(b).T)), axis=1)
    assert raised[:, 2:5].tolist() == [[0.0] * 3] * 20
    back = se3.in_plane(raised)
    assert back[:, :2] == pytest.approx(together[:, :2])
    assert back[:, 2] == pytest.approx(se2.wrap(together[:, 2]))
    assert se3.in_space(raised) is raised
    assert se3.in_space((1.0, 2.0, np.pi)) == pytest.approx([1.0, 2.0, 0.0, 0.0, 0.0, 1.0, 0.0])


def test_a_pose_in_space_leaves_the_heading_of_its_x_axis_in_the_plane():
    rolled = so3.compose(so3.exp((0.0, 0.0, 2.5)), so3.compose(so3.exp((0.0, -0.6, 0.0)), so3.exp((0.9, 0.0, 0.0))))
    assert se3.in_plane((1.0, 2.0, 9.0, *rolled)) == pytest.approx([1.0, 2.0, 2.5])
