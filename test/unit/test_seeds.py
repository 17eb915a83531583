"""Public graphs, at their published values."""

import numpy as np
import pytest
from places import DATASETS
from rows import each

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import RELATIVE_POSE_3D
from graph_slam_ros.solver import Settings, Solver

GRAPHS = DATASETS / "pose_graphs"
NEEDS_GRAPHS = pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}: GRAPH_SLAM_DATASETS")


def solved(name, method="gn", **options):
    file = read_g2o(GRAPHS / name, **options)
    solver = Solver(file.graph, Settings(method=method))
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    solver.hold(0)
    return solver.optimize()


@NEEDS_GRAPHS
@each(
    "error_map, start, end, odometry, closures",
    [("seed", 7191686, "215.84", "142.189", "73.652"), ("relative", 5149721, "215.8302", "142.266", "73.564")],
)
def test_the_intel_graph_is_solved_in_six_steps(error_map, start, end, odometry, closures):
    report = solved("input_INTEL.g2o", error_map=error_map)
    assert report.chi2_initial == pytest.approx(start, abs=0.5)
    assert (report.method, report.converged) == ("gn", True)
    assert len(report.iterations) <= 6
    digits = [len(text.partition(".")[2]) for text in (end, odometry, closures)]
    found = [report.chi2_final, report.classes["odometry"].chi2, report.classes["closures"].chi2]
    assert [f"{x:.{n}f}" for x, n in zip(found, digits, strict=True)] == [end, odometry, closures]
    assert (report.classes["odometry"].edges, report.classes["closures"].edges) == (1227, 256)


@NEEDS_GRAPHS
@each(
    "name, method, chi2, odometry, closures",
    [  # as other solvers find them, in all digits given
        ("M3500.g2o", "gn", 137.91295, 3499, 1954),
        ("intel_943.g2o", "lm", 546.461, 942, 895),
        ("manhattanOlson3500.g2o", "gn", 146.0766, 3499, 2099),
        ("ring.g2o", "lm", 11.1631, 433, 26),
        ("smallGrid3D.g2o", "lm", 1033.9, 124, 173),
        ("parking-garage.g2o", "gn", 1.26838, 1660, 4615),
    ],
)
def test_a_public_graph_comes_to_its_known_optimum(name, method, chi2, odometry, closures):
    report = solved(name, method, raw=True)
    assert (report.method, report.converged) == (method, True)
    digits = len(str(chi2).partition(".")[2])
    # the rule of convergence leaves a millionth, the last digit half of its unit
    assert report.chi2_final == pytest.approx(chi2, rel=1e-6, abs=0.51 * 10.0**-digits)
    assert (report.classes["odometry"].edges, report.classes["closures"].edges) == (odometry, closures)


@NEEDS_GRAPHS
def test_the_information_of_rotations_is_scaled_when_read():
    files = [read_g2o(GRAPHS / "tinyGrid3D.g2o", raw=raw) for raw in (False, True)]
    information = [f.graph.tables[RELATIVE_POSE_3D].sqrt_information.values for f in files]
    scaled, plain = (np.swapaxes(r, 1, 2) @ r for r in information)
    assert np.allclose(4.0 * scaled[:, 3:, 3:], plain[:, 3:, 3:])
    assert np.allclose(scaled[:, :3, :3], plain[:, :3, :3])
