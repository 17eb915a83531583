"""TORO's, iSAM's and GTSAM's texts give the same graph as the g2o file of the same meaning."""

import numpy as np
import pytest
from graph_texts import SPACE, in_dialect
from places import ROOT
from rows import each
from scipy.spatial.transform import Rotation

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import RELATIVE_POSE, RELATIVE_POSE_3D
from graph_slam_ros.solver import Solver, initial_values


def read(tmp_path, text, **options):
    path = tmp_path / "graph.txt"
    path.write_text(text)
    return read_g2o(path, **options)


def information(file, edge):
    root = file.graph.tables[edge].sqrt_information.values
    return np.swapaxes(root, 1, 2) @ root


def chi2_of(file):
    solver = Solver(file.graph)
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    solver.start_at(initial_values(file.graph, "file" if file.has_values else "tree", 0))
    return float(solver.chi2_of(np.arange(file.graph.edge_count))[0].sum())


@each(
    "name, dialect",
    [*(("city", d) for d in ("toro", "gtsam", "isam", "rows")), ("landmarks", "gtsam"), ("", "toro"), ("", "isam")],
)
def test_a_text_has_the_chi2_of_its_twin_in_g2o(tmp_path, name, dialect):
    g2o, text = in_dialect((ROOT / f"data/{name}.g2o").read_text() if name else SPACE, dialect)
    one = read(tmp_path, g2o)
    two = read(tmp_path, text, dialect=dialect)
    assert (two.graph.vertex_count, two.graph.edge_count) == (one.graph.vertex_count, one.graph.edge_count)
    assert chi2_of(two) == pytest.approx(chi2_of(one), rel=1e-9)
    assert chi2_of(one) > 0.0


def test_lines_of_another_dialect_than_the_one_that_is_named_are_refused(tmp_path):
    for text, dialect, says in (
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", "gtsam", ":1: EDGE_SE2 is no line of a gtsam file"),
        ("VERTEX2 0 0 0 0\n", "g2o", ":1: VERTEX2 is no line of a g2o file"),
        ("EDGE2 0 1 1 0 0.5 4 0 0 3 0 9\n", "toro", ":1: information is not positive definite"),
    ):
        with pytest.raises(FormatError, match=says):
            read(tmp_path, text, dialect=dialect)


def test_edge2_with_rows_of_the_upper_triangle_may_be_square_roots_and_is_asked_for(tmp_path):
    text = "EDGE2 0 1 1 0 0.5 4 0 0 3 0 9\n"
    with pytest.raises(FormatError, match=r":1: EDGE2 is not in TORO's order: --from isam .* or --from rows") as error:
        read(tmp_path, text)
    assert len(str(error.value)) <= 200
    rows = read(tmp_path, text, dialect="rows")
    assert np.allclose(information(rows, RELATIVE_POSE)[0], np.diag([4.0, 3.0, 9.0]))


def test_edge3_turns_roll_pitch_and_yaw_into_a_quaternion_and_needs_no_information(tmp_path):
    file = read(tmp_path, "VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 1 2 3 0.1 -0.2 0.3\nEDGE3 0 1 1 2 3 0.1 -0.2 0.3\n")
    measured = file.graph.tables[RELATIVE_POSE_3D].measured.values[0]
    assert np.allclose(measured[3:], Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_quat())
    assert np.allclose(information(file, RELATIVE_POSE_3D)[0], np.eye(6))


def test_edge3_may_be_isams_square_root_which_is_said_and_taken_where_it_is_asked_for(tmp_path):
    root = np.triu(np.random.default_rng(1).uniform(0.1, 1.0, (6, 6))) + 5.0 * np.eye(6)

    def text(of):
        return "EDGE3 0 1 1 2 3 0.1 -0.2 0.3 " + " ".join(map(repr, of[np.triu_indices(6)].tolist())) + "\n"

    assert np.allclose(information(read(tmp_path, text(root), dialect="isam"), RELATIVE_POSE_3D)[0], root.T @ root)
    asked = "graph.txt:1: EDGE3 is read as TORO's information (--from toro says that it is)"
    assert [note.startswith(asked) and note.endswith(": --from isam") for note in read(tmp_path, text(root)).notes] == [
        True
    ]
    for dialect in ("isam", "toro"):
        assert not read(tmp_path, text(root), dialect=dialect).notes
    assert not read(tmp_path, text(np.eye(6))).notes, "the identity is its own root"
