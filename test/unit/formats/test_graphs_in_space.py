"""Public graphs in space, and the information of rotations in g2o files."""

import numpy as np
import pytest
from places import DATASETS

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import RELATIVE_POSE_3D
from graph_slam_ros.solver import Solver

GRAPHS = DATASETS
GRAPHS = GRAPHS / "pose_graphs"


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
@pytest.mark.parametrize(("name", "optimum"), [("smallGrid3D", 1033.9), ("parking-garage", 1.26838)])
def test_public_graphs_in_space_reach_their_optimum(name, optimum):
    file = read_g2o(GRAPHS / f"{name}.g2o", raw=True)
    assert solved(file).chi2_final == pytest.approx(optimum, rel=1e-4)


@pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")
def test_the_information_of_rotations_is_scaled_when_read():
    file = read_g2o(GRAPHS / "tinyGrid3D.g2o")
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
