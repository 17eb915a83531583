"""The worked examples and public graphs this package grew from, at their published values."""

import os
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from rows import each

from graph_slam_ros.errors import GaugeError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import (
    DIFFERENCE,
    POINT_PRIOR,
    POSE_PRIOR,
    R1,
    RELATIVE_POSE,
    SE2,
    Gaussian,
    Graph,
)
from graph_slam_ros.lie import se2
from graph_slam_ros.solver import Settings, Solver

GRAPHS = Path(os.environ.get("GRAPH_SLAM_DATASETS", ROOT / "../shared/datasets")) / "pose_graphs"

ODOMETRY, AHEAD = np.array([0.0, 1.5, 2.4]), np.array([2.9, 2.0, 1.0])  # truth: 0, 1, 2 and a landmark at 3
VARIANCE = 0.2  # of one sighting


def with_all(graph):
    solver = Solver(graph)
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    return solver


def poses_on_a_line(*, anchored):
    """Each pair of poses that saw the landmark gets an edge of its own; two sightings, so twice the variance."""
    graph = Graph()
    graph.add_vertices(R1, ODOMETRY)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        noise = Gaussian.from_covariance([[2 * VARIANCE]])
        graph.add_edge(DIFFERENCE[R1], [i, j], [AHEAD[i] - AHEAD[j]], noise, "sightings")
    if anchored:
        graph.add_edge(POINT_PRIOR[R1], [0], [0.0], Gaussian.from_information([[1.0]]), "anchor")
    return with_all(graph)


def test_on_a_line_nothing_is_determined_without_an_anchor():
    solver = poses_on_a_line(anchored=False)
    assert solver.information_matrix() == pytest.approx(2.5 * np.array([[2, -1, -1], [-1, 2, -1], [-1, -1, 2]]))
    assert np.linalg.det(solver.information_matrix()) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(GaugeError, match="vertex 0"):
        solver.optimize()


def test_on_a_line_the_poses_come_to_where_the_sightings_put_them():
    solver = poses_on_a_line(anchored=True)
    assert np.linalg.det(solver.information_matrix()) == pytest.approx(18.75, rel=1e-12)
    report = solver.optimize()
    assert report.converged
    assert solver.estimate(range(3)).ravel() == pytest.approx([0.0, 0.9, 1.9], abs=1e-12)
    assert report.chi2_final == pytest.approx(0.0, abs=1e-12)  # three edges from three sightings never disagree


def test_on_a_line_the_landmark_as_a_vertex_uses_odometry_too_and_counts_each_sighting_once():
    graph = Graph()
    graph.add_vertices(R1, ODOMETRY)
    landmark = graph.add_vertex(R1, [ODOMETRY[0] + AHEAD[0]])
    graph.add_edge(POINT_PRIOR[R1], [0], [0.0], Gaussian.from_information([[1.0]]), "anchor")
    noise = Gaussian.from_covariance([[VARIANCE]])
    for i in range(2):
        graph.add_edge(DIFFERENCE[R1], [i, i + 1], [ODOMETRY[i + 1] - ODOMETRY[i]], noise, "odometry")
    for i in range(3):
        graph.add_edge(DIFFERENCE[R1], [i, landmark], [AHEAD[i]], noise, "sightings")
    solver = with_all(graph)
    report = solver.optimize()
    rows = np.array([[-1, 1, 0, 0], [0, -1, 1, 0], [-1, 0, 0, 1], [0, -1, 0, 1], [0, 0, -1, 1.0]]) / np.sqrt(VARIANCE)
    readings = np.array([1.5, 0.9, *AHEAD]) / np.sqrt(VARIANCE)
    rows, readings = np.vstack([[1, 0, 0, 0], rows]), np.append(0.0, readings)
    best = np.linalg.lstsq(rows, readings, rcond=None)[0]
    found = solver.estimate(range(4)).ravel()
    assert found == pytest.approx(best, abs=1e-12)
    assert report.chi2_final == pytest.approx(((rows @ best - readings) ** 2).sum(), rel=1e-12)
    assert np.abs(found - [0, 1, 2, 3]).max() < np.abs(ODOMETRY - [0, 1, 2]).max()
    # what an edge per pair claims to know of the last pose, it knows only by using sightings twice
    own, pairs = (np.linalg.inv(s.information_matrix()) for s in (solver, poses_on_a_line(anchored=True)))
    sightings_alone = np.linalg.inv(rows[[0, 3, 4, 5]].T @ rows[[0, 3, 4, 5]])
    assert pairs[2, 2] < sightings_alone[2, 2]
    assert own[2, 2] < sightings_alone[2, 2]


READINGS = [((1.0, 0.0, 0.1), (3.0, 1.0, 0.4), (2.0, 0.5, 0.3)), ((-7.0, 2.0, 3.0), (0.3, -4.0, -2.0), (9.0, 9.0, 1.0))]


@each("second, first_sees, second_sees", READINGS)
def test_in_the_plane_the_determinant_is_that_of_the_information_whatever_the_readings(second, first_sees, second_sees):
    # One edge between two poses, H = [Ji Jj]' Omega [Ji Jj]. With an anchor of information I on the first pose, a
    # determinant by blocks is det(I) det(Jj' Omega Jj) = det(Jj)^2 det(Omega). Jj is a rotation beside a 1, so what is
    # left is det(Omega) = 1 / (0.2 * 0.2 * 2 pi / 180) = 716.197.
    information = np.linalg.inv(np.diag([0.1, 0.1, np.pi / 180]) * 2)
    graph = Graph()
    graph.add_vertices(SE2, [(0.0, 0.0, 0.0), second])
    z = se2.compose(first_sees, se2.inverse(second_sees))  # the landmark, a pose, seen from both
    graph.add_edge(RELATIVE_POSE, [0, 1], z, Gaussian.from_information(information), "sightings")
    solver = with_all(graph)
    h = solver.information_matrix()
    assert np.linalg.matrix_rank(h, tol=1e-9) == 3
    assert abs(np.linalg.det(h)) < 1e-6
    anchor = graph.add_edge(POSE_PRIOR, [0], (0.0, 0.0, 0.0), Gaussian.from_information(np.eye(3)), "anchor")
    solver.add([], [anchor])
    assert np.linalg.det(solver.information_matrix()) == pytest.approx(716.197, abs=5e-4)
    solver.optimize()
    assert se2.between(*solver.estimate([0, 1])) == pytest.approx((*z[:2], se2.wrap(z[2])), abs=1e-6)
    assert np.linalg.det(solver.information_matrix()) == pytest.approx(716.197, abs=5e-4)


def public(name):
    path = GRAPHS / name
    if not path.is_file():
        pytest.skip(f"{path} is not there: set GRAPH_SLAM_DATASETS to the folder of the public graphs")
    return path


def solved(path, error_map="relative", **settings):
    file = read_g2o(path, error_map=error_map)
    solver = Solver(file.graph, Settings(**settings))
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    solver.hold(0)
    return solver.optimize()


@each(
    "error_map, start, end, odometry, closures",
    [("seed", 7191686, "215.84", "142.189", "73.652"), ("relative", 5149721, "215.8302", "142.266", "73.564")],
)
def test_the_intel_graph_is_solved_in_six_steps(error_map, start, end, odometry, closures):
    report = solved(public("input_INTEL.g2o"), error_map)
    assert report.chi2_initial == pytest.approx(start, abs=0.5)
    assert (report.method, report.converged) == ("gn", True)
    assert len(report.iterations) <= 6
    digits = [len(text.partition(".")[2]) for text in (end, odometry, closures)]
    found = [report.chi2_final, report.classes["odometry"].chi2, report.classes["closures"].chi2]
    assert [f"{x:.{n}f}" for x, n in zip(found, digits, strict=True)] == [end, odometry, closures]
    assert (report.classes["odometry"].edges, report.classes["closures"].edges) == (1227, 256)


# As other solvers find them, in all digits given.
OPTIMA = [
    ("M3500.g2o", 137.91295, 3499, 1954),
    ("intel_943.g2o", 546.461, 942, 895),
    ("manhattanOlson3500.g2o", 146.0766, 3499, 2099),
    ("ring.g2o", 11.1631, 433, 26),
]


@each("method", ["gn", "lm"])
@each("name, chi2, odometry, closures", OPTIMA)
def test_a_public_graph_comes_to_its_known_optimum(name, chi2, odometry, closures, method):
    report = solved(public(name), method=method)
    assert (report.method, report.converged) == (method, True)
    digits = len(str(chi2).partition(".")[2])
    # the rule of convergence leaves a millionth, the last digit half of its unit
    assert report.chi2_final == pytest.approx(chi2, rel=1e-6, abs=0.51 * 10.0**-digits)
    assert (report.classes["odometry"].edges, report.classes["closures"].edges) == (odometry, closures)
