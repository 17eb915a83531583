"""g2o files with every edge type there is a tag for, and with sensors that are not at the robot's origin."""

import numpy as np
import pytest

from graph_slam_ros.edge_tags import EDGE_TAGS
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import (
    ATTITUDE_PRIOR_3D,
    LANDMARK_POSITION_3D,
    POSE_PRIOR_3D,
    RELATIVE_POSE_3D,
    SE3,
    Gaussian,
    Graph,
)
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.solver import Solver

UPPER = "5 1 2 0 0 0 6 3 0 0 0 7 0 0 0 8 1 0 9 2 10"  # of an information matrix of six
OFFSET = (0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5)
SPACE = f"""\
PARAMS_SE3OFFSET 3 {" ".join(map(str, OFFSET))}
VERTEX_SE3:QUAT 0 1 2 3 0 0 0.6 0.8
VERTEX_SE3:QUAT 1 4 5 6 0 0 0 1
VERTEX_TRACKXYZ 2 7 8 9
EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 1 {UPPER}
EDGE_SE3_TRACKXYZ 0 2 3 1 2 3 9 1 2 8 3 7
"""


def everything():
    """A graph with an edge of every tag, of random numbers and correlated noise."""
    rng = np.random.default_rng(3)
    graph = Graph()
    for edge in EDGE_TAGS.values():
        at = []
        for kinds in edge.accepts:
            value = rng.standard_normal(kinds[0].size)
            at.append(graph.add_vertex(kinds[0], [*value[:3], 0, 0, 0, 1] if kinds[0] is SE3 else value))
        root = rng.standard_normal((edge.residual_size, edge.residual_size))
        measured = rng.standard_normal(edge.measured_size)
        if edge in (RELATIVE_POSE_3D, POSE_PRIOR_3D):
            measured = np.array(se3.exp(tuple(measured[:6])))
        elif edge.tail == se3.IDENTITY:  # each other one with its sensor elsewhere
            measured[-7:] = se3.exp(tuple(measured[-6:])) if "range" in edge.name else edge.tail
        elif edge is ATTITUDE_PRIOR_3D:
            measured = np.array(so3.exp(tuple(measured[:3])))
        noise = Gaussian.from_information(root @ root.T + np.eye(len(root)))
        graph.add_edge(edge, at, measured, noise, edge.name.replace(" ", "_"))
    return graph


def by_label(file):
    """Of each label, what its one edge is."""
    out = {}
    for edge, table in file.graph.tables.items():
        for row in range(len(table)):
            label = file.graph.labels[table.label.values[row]]
            ids = [file.ids[v] for v in table.vertices[row]]
            root = table.sqrt_information.values[row]
            out[label] = edge, ids, table.measured.values[row], root.T @ root
    return out


@pytest.mark.parametrize("raw", [False, True])
def test_edges_of_every_tag_are_written_and_read_back(tmp_path, raw):
    graph = everything()
    written = G2oFile(graph, list(range(graph.vertex_count)), raw=raw)
    write_g2o(tmp_path / "a.g2o", written, Solver(graph).estimate)
    read = read_g2o(tmp_path / "a.g2o", raw=raw)
    assert not read.unknown
    before, after = by_label(written), by_label(read)
    assert len(before) == len(after) == len(EDGE_TAGS)
    for label, (edge, ids, measured, information) in before.items():
        assert after[label][:2] == (edge, ids)
        assert after[label][2] == pytest.approx(measured, rel=1e-14)
        assert after[label][3] == pytest.approx(information, rel=1e-12, abs=1e-12)
    assert read.graph.initial.values.tolist() == graph.initial.values.tolist()


def test_a_sighting_by_a_sensor_is_one_by_the_robot_and_is_written_again_with_its_parameters(tmp_path):
    (tmp_path / "a.g2o").write_text(SPACE)
    file = read_g2o(tmp_path / "a.g2o")
    assert file.offsets == {3: OFFSET}
    table = file.graph.tables[LANDMARK_POSITION_3D]
    assert table.measured.values[0] == pytest.approx(se3.act(OFFSET, (1.0, 2.0, 3.0)), abs=1e-14)
    # the same landmark seen at its place gives the residual in the sensor's frame, whitened alike
    x = np.concatenate([(1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8), (7.0, 8.0, 9.0)])
    residual = LANDMARK_POSITION_3D.linearize(x, np.array([[0, 7]]), table.measured.values[:1])[0][0]
    T_map_sensor = se3.compose((1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8), OFFSET)
    in_sensor = np.subtract(se3.act(se3.inverse(T_map_sensor), (7.0, 8.0, 9.0)), (1.0, 2.0, 3.0))
    information = np.array([[9, 1, 2], [1, 8, 3], [2, 3, 7.0]])
    root = table.sqrt_information.values[0]
    assert np.sum((root @ residual) ** 2) == pytest.approx(in_sensor @ information @ in_sensor, rel=1e-12)

    write_g2o(tmp_path / "b.g2o", file, Solver(file.graph).estimate)
    lines = (tmp_path / "b.g2o").read_text().splitlines()
    assert f"PARAMS_SE3OFFSET 3 {' '.join(map(str, OFFSET))}" in lines
    (sighting,) = [line.split() for line in lines if line.startswith("EDGE_SE3_TRACKXYZ")]
    assert sighting[1:4] == ["0", "2", "3"]
    assert [float(word) for word in sighting[4:]] == pytest.approx([1, 2, 3, 9, 1, 2, 8, 3, 7], abs=1e-13)
    assert read_g2o(tmp_path / "b.g2o").seen_from == file.seen_from

    (tmp_path / "a.g2o").write_text(SPACE.split("\n", 1)[1].replace("0 2 3 1 2 3", "0 2 0 1 2 3"))
    file = read_g2o(tmp_path / "a.g2o")
    assert file.graph.tables[LANDMARK_POSITION_3D].measured.values.tolist() == [[1.0, 2.0, 3.0]], (
        "the robot's own frame"
    )
    write_g2o(tmp_path / "b.g2o", file, Solver(file.graph).estimate)
    assert (tmp_path / "b.g2o").read_text().startswith("PARAMS_SE3OFFSET 0 0.0 0.0 0.0 0.0 0.0 0.0 1.0\n")
