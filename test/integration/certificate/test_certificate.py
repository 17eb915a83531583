"""SE-Sync's certificate of the global optimum: its problem, its eigenvalue, and what it says of solved graphs."""

import json
from dataclasses import replace

import numpy as np
import pytest
from places import DATASETS
from reliability import times

from graph_slam_ros import certify, optimize, read_g2o, write_g2o
from graph_slam_ros.cli import main
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import (
    CAUCHY,
    COORDINATE_PRIOR,
    LANDMARK_POSITION,
    POSE_PRIOR,
    R2,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    Gaussian,
    Graph,
    Loss,
)
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver import Settings
from graph_slam_ros.tools.certificate import CERTIFIED, DOES_NOT_APPLY, NOT_CERTIFIED
from graph_slam_ros.tools.certificate.spectrum import least_eigenvalue, polish
from graph_slam_ros.tools.certificate.synchronization import Poses, Synchronization

GRAPHS = DATASETS / "pose_graphs"
public = pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
PLANE, SPACE = (SE2, RELATIVE_POSE, se2), (SE3, RELATIVE_POSE_3D, se3)
SIGMAS = {SE2: (0.05, 0.05, 0.02), SE3: (0.05, 0.05, 0.05, 0.02, 0.02, 0.02)}
both = pytest.mark.parametrize("world", [PLANE, SPACE], ids=["2D", "3D"])


def random_graph(world, noise=1.0, count=12, seed=3):
    """Random poses, a chain and some closures, with so many times their sigmas of noise; it starts at the truth."""
    kind, edge, group = world
    rng = np.random.default_rng(seed)
    truth = [group.exp(tuple(d)) for d in rng.normal(size=(count, kind.dof))]
    graph = Graph()
    graph.add_vertices(kind, truth)
    pairs = [(i, i + 1) for i in range(count - 1)] + [(0, 5), (7, 2), (11, 3), (1, 8)]
    for i, j in pairs:
        error = tuple(noise * np.array(SIGMAS[kind]) * rng.normal(size=kind.dof))
        measured = group.retract(group.between(truth[i], truth[j]), error)
        graph.add_edge(edge, [i, j], measured, Gaussian.from_sigmas(*SIGMAS[kind]), "odometry")
    return graph


def ring(world, windings, count=20, noise=1.0, stated=1.0):
    """Poses 1 m apart on a circle that the edges close once, and that start as if it went round so many times."""
    kind, edge, _ = world
    rng = np.random.default_rng(0)
    turn = 2.0 * np.pi / count
    graph, pose = Graph(), se2.IDENTITY
    for _ in range(count):
        graph.add_vertex(kind, se3.in_space(pose) if kind is SE3 else pose)
        pose = se2.retract(pose, (1.0, 0.0, windings * turn))
    step = np.array([1.0, 0.0, turn])
    for k in range(count):
        noisy = se2.retract(tuple(step), tuple(noise * np.array(SIGMAS[SE2]) * rng.normal(size=3)))
        measured = se3.in_space(noisy) if kind is SE3 else noisy
        sigmas = stated * np.array(SIGMAS[kind])
        graph.add_edge(edge, [k, (k + 1) % count], measured, Gaussian.from_sigmas(*sigmas), "odometry")
    return graph


def dense_certificate(problem, x):
    """``Q - Lambda`` as SE-Sync writes it, with the pseudo-inverse of the translations' Laplacian."""
    n, d = problem.poses, problem.dimensions
    m = problem.data_matrix().toarray()
    q = m[n:, n:] - m[n:, :n] @ np.linalg.pinv(m[:n, :n]) @ m[:n, n:]
    for i, block in enumerate(problem.multipliers(x)):
        q[d * i : d * (i + 1), d * i : d * (i + 1)] -= block
    return q


@both
def test_the_eigenvalue_is_that_of_the_dense_matrix_whichever_position_is_left_out(world):
    for made, sign in ((random_graph, 0.0), (ring, -1.0)):  # optimal, and wrapped wrongly
        graph = made(world, 2.0)
        problem = Synchronization.of(graph)
        there = polish(problem, Poses.of(graph.initial.values.reshape(graph.vertex_count, -1)), 0).poses
        dense = np.linalg.eigvalsh(dense_certificate(problem, there))
        scale = problem.data_matrix().diagonal().max()
        for root in (0, 7):
            found = least_eigenvalue(problem.certificate_matrix(there, root), problem.poses - 1, 1e-6)
            assert found == pytest.approx(dense[0], abs=1e-11 * scale)
        assert np.sign(np.round(dense[0], 6)) == sign
        if not sign:  # the d rows of R are null vectors, and there are no others
            assert np.abs(dense[: problem.dimensions]).max() < 1e-11 * scale
            assert dense[problem.dimensions] > 1e-3


@both
def test_with_noise_the_optimum_is_certified_and_bounds_chi2_from_below(world):
    certificate = certify(optimize(random_graph(world)))
    assert certificate.verdict == CERTIFIED
    assert 0.0 <= certificate.cost - certificate.cost_bound < 1e-5 * certificate.cost
    assert certificate.chi2_bound == pytest.approx(certificate.cost_bound, rel=1e-9)  # isotropic
    assert 0.99 * certificate.chi2 < certificate.chi2_bound <= certificate.chi2
    assert 0.0 < certificate.moved_rms_m < certificate.moved_max_m < 0.01
    assert 0.0 < certificate.moved_sigmas < 0.1
    exact = certify(optimize(random_graph(world, 0.0)))
    assert exact.verdict == CERTIFIED
    assert exact.cost == pytest.approx(0.0, abs=1e-15) and exact.moved_max_m < 1e-9
    assert abs(exact.lambda_min) < exact.tolerance < 1e-6


@both
def test_a_ring_wrapped_wrongly_is_not_certified_and_from_a_chordal_start_it_is(world):
    graph = ring(world, 2, noise=0.0)
    wrong = optimize(graph, init="file")
    assert wrong.report.converged
    certificate = certify(wrong)
    assert certificate.verdict == NOT_CERTIFIED
    assert certificate.lambda_min < -10.0
    assert certificate.moved_max_m < 1e-6  # it is a critical point of both costs
    assert certificate.cost_bound == pytest.approx(0.0, abs=1e-9)
    right = optimize(graph, init="chordal")
    assert right.report.chi2_final < 1e-9 < wrong.report.chi2_final
    assert certify(right).verdict == CERTIFIED


def with_edge(edge, vertices, measured, sigmas):
    def change(graph, file):
        graph.add_edge(edge, vertices, measured, Gaussian.from_sigmas(*sigmas), "more")

    return change


def with_landmark(graph, file):
    point = graph.add_vertex(R2, [0.0, 0.0])
    file.ids.append(point)
    graph.add_edge(LANDMARK_POSITION, [0, point], [1.0, 0.0], Gaussian.from_sigmas(0.1, 0.1), "landmarks")


def test_where_it_does_not_apply_it_says_why():
    for change, why in (
        (with_landmark, "there are landmarks: vertices of kind R2"),
        (with_edge(COORDINATE_PRIOR, [3], [1.0, 0.0, 1.0], [0.1]), "1 edges of type 'coordinate prior'"),
        (with_edge(POSE_PRIOR, [3], [0, 0, 0], [1, 1, 1]), ""),
        (lambda graph, file: file.fixed.extend([3, 3]), ""),
        (lambda graph, file: file.fixed.extend([3, 4]), "the graph has 2 anchors"),
        (with_edge(RELATIVE_POSE, [3, 9], [0, 0, 0], [1, 1.2, 1]), ""),
        (
            with_edge(RELATIVE_POSE, [3, 9], [0, 0, 0], [10, 12.5, 10]),
            "1 of 16 edges have anisotropic translations (information up to 1.56 to 1, between vertices 3 and 9;",
        ),
    ):
        graph = random_graph(PLANE)
        file = G2oFile(graph, list(range(graph.vertex_count)))
        change(graph, file)
        certificate = certify(optimize(file))
        assert certificate.verdict == (DOES_NOT_APPLY if why else CERTIFIED), why
        assert why in certificate.reason
        assert certificate.computed is (not why)
        known = {k: v for k, v in certificate.as_dict().items() if k not in ("verdict", "reason")}
        assert set(known.values()) == {None} if why else None not in known.values()
    settings = Settings(losses={"odometry": [Loss(CAUCHY, 1.0)]})
    assert certify(optimize(random_graph(PLANE), settings)).reason == "a robust loss was minimised"
    assert certify(optimize(random_graph(PLANE, 0.0), settings)).verdict == CERTIFIED, "it has not counted"


@pytest.fixture
def run(tmp_path, told):
    def run(graph, *words):
        path = tmp_path / "graph.g2o"
        write_g2o(path, G2oFile(graph, list(range(graph.vertex_count)), [0]))
        code, out, err = told("optimize", path, "--certify", *words)
        assert (err == "") == (code != 3) and err.count("is far above its") <= 1, err
        return code, json.loads(out)["certificate"] if "--json" in words else out

    return run


def test_the_command_says_certified_and_ends_with_0_or_not_certified(run):
    code, out = run(ring(PLANE, 1))
    assert code == 0 and "\ncertified\n" in out and "--init" not in out
    code, answer = run(ring(PLANE, 1), "--json")
    assert (code, answer["verdict"]) == (0, CERTIFIED)
    assert answer["lambda_min"] >= -answer["tolerance"]
    code, out = run(ring(PLANE, 2), "--init", "file")
    assert code == 3, "its chi2 is in doubt, too"
    assert "\nnot certified\n" in out and "\nanother start may lead to a lower optimum: --init chordal\n" in out
    code, answer = run(ring(PLANE, 2), "--init", "file", "--json")
    assert (code, answer["verdict"]) == (3, NOT_CERTIFIED)
    assert run(ring(PLANE, 2, noise=0.0, stated=40.0), "--init", "file")[0] == 4, "its chi2 is not in doubt"
    assert run(ring(PLANE, 2), "--init", "chordal")[0] == 0
    code, out = run(ring(PLANE, 2))
    assert code == 0 and "\ncertified\n" in out
    assert "the answer is from the chordal relaxation: chi2 " in out, "by itself it tries another start"


def test_the_command_says_why_it_does_not_apply_and_what_was_lost_goes_first(run, tmp_path, capsys):
    graph = random_graph(PLANE)
    with_landmark(graph, G2oFile(graph, []))
    code, out = run(graph)
    assert code == 5
    *_, told, after = out.splitlines()
    assert told == "does not apply: there are landmarks: vertices of kind R2"
    assert after.startswith("next: graph_slam optimize ")
    path = tmp_path / "graph.g2o"
    write_g2o(path, ring(PLANE, 2))
    path.write_text(path.read_text() + "VERTEX_SE2 99 nan 0 0\n")
    assert main(["optimize", str(path), "--init", "file", "--certify", "--lenient"]) == 3
    assert "\nnot certified\n" in capsys.readouterr().out


@public
@pytest.mark.parametrize("start", times(["chordal"], ["file", "chordal", "online"]))
def test_half_the_rotation_vector_and_g2os_half_sine_have_optima_of_their_own(start):
    solution = optimize(GRAPHS / "smallGrid3D.g2o", init=start)
    certificate = certify(solution)
    assert certificate.verdict == CERTIFIED
    assert solution.report.chi2_final == pytest.approx(462.4825, abs=1e-3), "in our residual"
    assert certificate.chi2_bound == pytest.approx(458.1538, abs=1e-3), "the chordal cost, which is g2o's chi2 here"


@public
@pytest.mark.parametrize(("name", "optimal"), [("parking-garage", 1.263), ("input_INTEL", 393.7)])
def test_public_graphs_come_to_the_optimal_value_in_se_syncs_weights(name, optimal):
    """These weights count rotations twice in the plane: Rosen et al. 2019 in space; those in the plane are proved."""
    solution = optimize(read_g2o(GRAPHS / f"{name}.g2o", raw=True), init="chordal")
    problem = Synchronization.of(solution.file.graph)
    if problem.dimensions == 2:
        problem = replace(problem, kappa=2.0 * problem.kappa)
    there = polish(problem, Poses.of(solution.poses), 0)
    matrix = problem.certificate_matrix(there.poses, 0)
    assert least_eigenvalue(matrix, problem.poses - 1, 1e-9) > -1e-9
    assert there.cost == pytest.approx(optimal, rel=6e-4)


@public
@pytest.mark.parametrize("name", ["ring", "intel_943", *times([], ["M3500", "sphere2500", "parking-garage"])])
def test_public_graphs_are_certified(name):
    certificate = certify(optimize(GRAPHS / f"{name}.g2o", init="chordal"))
    assert certificate.verdict == CERTIFIED
    assert certificate.moved_sigmas < 0.5
    if name not in ("sphere2500", "parking-garage"):  # whose rotations are anisotropic
        assert 0.0 <= certificate.chi2 - certificate.chi2_bound < 1e-4 * certificate.chi2
