"""Graphs in other texts: what is written is read back as the same graph, and what a format cannot say is told."""

import re
from pathlib import Path

import numpy as np
import pytest
from graph_texts import PLANE, SPACE, UPPER
from places import DATASETS, ROOT
from scipy.spatial.transform import Rotation

from graph_slam_ros.cli import main
from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.convert import ENDINGS, format_of, write_graph
from graph_slam_ros.formats.dialects import LANDMARK_IDS_FROM, Text, from_g2o_words, in_g2o_words
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import R2, RELATIVE_POSE, SE2, TAG_POSITION, Gaussian, Graph
from graph_slam_ros.solver import Solver, initial_values

DATA = ROOT / "data"
GRAPHS = DATASETS / "pose_graphs"
PUBLIC = pytest.mark.skipif(not GRAPHS.exists(), reason=f"no public graphs under {GRAPHS}")


@pytest.fixture
def convert(tmp_path, capsys):
    """Convert a text or a file; returns exit code, standard output, lines on standard error and the file written."""

    def convert(source, ending, *options):
        if isinstance(source, str):
            (tmp_path / "a.g2o").write_text(source)
            source = tmp_path / "a.g2o"
        target = tmp_path / f"b{ending}"
        try:
            code = main(["convert", str(source), str(target), "--force", *options])
        except SystemExit as end:  # argparse
            code = end.code
        out, err = capsys.readouterr()
        return code, out, err.splitlines(), target

    return convert


def information(table):
    root = table.sqrt_information.values
    return np.swapaxes(root, 1, 2) @ root


def assert_same_graph(one, two, rotations=0.0):
    """Same ids, labels and numbers; information to rounding, in its own units and as far as it can be inverted."""
    assert one.ids == two.ids
    assert list(one.graph.tables) == list(two.graph.tables)
    assert one.graph.initial.values == pytest.approx(two.graph.initial.values, rel=0, abs=rotations)
    for a, b in zip(one.graph.tables.values(), two.graph.tables.values(), strict=True):
        order_a, order_b = (np.lexsort((*t.measured.values.T, *t.vertices.values.T)) for t in (a, b))
        assert np.array_equal(a.vertices.values[order_a], b.vertices.values[order_b])
        assert np.abs(a.measured.values[order_a] - b.measured.values[order_b]).max() <= rotations
        labels = [[f.graph.labels[k] for k in t.label.values[o]] for f, t, o in ((one, a, order_a), (two, b, order_b))]
        assert labels[0] == labels[1]
        first, second = information(a)[order_a], information(b)[order_b]
        sigma = np.sqrt(np.diagonal(first, axis1=1, axis2=2))
        first, second = (m / sigma[:, :, None] / sigma[:, None, :] for m in (first, second))
        assert (np.abs(first - second).max(axis=(1, 2)) < 1e-14 * np.linalg.cond(first)).all()


def solved(path):
    file = read_g2o(path)
    solver = Solver(file.graph)
    solver.start_at(initial_values(file.graph, "file" if file.has_values else "tree", 0))
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    solver.hold(int(np.argmin(file.ids)))
    return solver.optimize()


# -- what each format says -------------------------------------------------------------------------------------------


def test_toro_has_its_own_tags_and_its_own_order_of_the_information(convert):
    code, out, err, target = convert(PLANE, ".toro")
    assert code == 3
    assert err == ["graph_slam: lost: 1 VERTEX_XY, 1 EDGE_SE2_XY: TORO has no such line"]
    assert out == f"wrote {target} as TORO: 2 of 3 vertices, 1 of 2 edges\nnext: graph_slam optimize {target}\n"
    *words, numbers = target.read_text().splitlines()
    assert words == ["VERTEX2 10 0.1 -2e-07 3.0", "VERTEX2 11 1.5 -0.002 0.25"]
    tag, *numbers = numbers.split()
    # I11 I12 I22 I33 I13 I23
    assert (tag, numbers[:2]) == ("EDGE2", ["10", "11"])
    assert [float(v) for v in numbers[2:]] == pytest.approx([1, 0, 0.1, 10, 1, 20, 30, -2, 3], rel=1e-14)


def test_gtsam_text_has_covariances_and_the_start(convert):
    code, out, err, target = convert(PLANE, ".gtsam")
    assert (code, err) == (0, [])
    assert out.splitlines() == [
        f"wrote {target} as GTSAM's text: 3 of 3 vertices, 2 of 2 edges",
        f"next: graph_slam optimize {target}",
    ]
    lines = [line.split() for line in target.read_text().splitlines()]
    assert [line[0] for line in lines] == ["VERTEX_SE2", "VERTEX_SE2", "VERTEX_XY", "ODOMETRY", "LANDMARK"]
    covariance = np.linalg.inv([[10, 1, -2], [1, 20, 3], [-2, 3, 30]])[np.triu_indices(3)]
    assert [float(v) for v in lines[3][6:]] == pytest.approx(covariance, rel=1e-12)
    assert [float(v) for v in lines[4][1:]] == pytest.approx([11, 7, 1, 2, 9 / 35, -1 / 35, 4 / 35], rel=1e-12)


def test_tum_has_the_poses_in_order_of_id_with_the_id_as_stamp(convert):
    code, out, err, target = convert("VERTEX_SE2 30 5 6 -1\n" + PLANE, ".tum")
    assert (code, err) == (0, [])
    assert out == f"wrote {target} as TUM: 3 of 4 vertices, 0 of 2 edges\nnext: evo_traj tum {target}\n"
    rows = [[float(v) for v in line.split()] for line in target.read_text().splitlines()]
    assert target.read_text().startswith("10.000000000 0.1 -2e-07 0.0 0.0 0.0 ")
    assert [row[0] for row in rows] == [10, 11, 30]
    angles = [Rotation.from_quat(row[4:]).as_euler("xyz")[2] for row in rows]
    assert angles == pytest.approx([3, 0.25, -1], abs=1e-15)


def test_tum_in_space_has_the_quaternions_as_they_are(convert):
    code, _, err, target = convert(SPACE, ".tum")
    assert (code, err) == (0, [])
    rows = target.read_text().splitlines()
    assert rows[1] == "1.000000000 1.0 2.0 3.0 0.1 -0.7 0.1 0.7"


def test_landmarks_that_are_poses_are_no_part_of_the_trajectory(tmp_path):
    graph = Graph()
    graph.add_vertices(SE2, [[k, 0, 0] for k in range(4)])
    unit = Gaussian(np.eye(3))
    graph.add_edge(RELATIVE_POSE, [0, 1], [1, 0, 0], unit, "odometry")
    graph.add_edge(RELATIVE_POSE, [1, 2], [1, 0, 0], unit, "landmarks")
    graph.add_edge(TAG_POSITION, [1, 3], [1, 0], Gaussian(np.eye(2)), "landmarks")
    written = write_graph(tmp_path / "a.tum", G2oFile(graph, [0, 1, 2, 3]), Solver(graph).estimate, "tum")
    assert (written.vertices, written.lost) == (2, [])
    assert [line.split()[1] for line in (tmp_path / "a.tum").read_text().splitlines()] == ["0.0", "1.0"]


def test_unknown_lines_are_kept_in_g2o_and_told_elsewhere(convert):
    odd = "EDGE_ODD 10 11  x\n"
    code, _, err, target = convert(PLANE + odd + "FIX 10\n", ".out.g2o")
    assert (code, err) == (0, ["graph_slam: 1 lines with unknown tags kept as they are: EDGE_ODD"])
    assert target.read_text().endswith(odd)
    code, out, err, _ = convert(PLANE + odd + "FIX 10\n", ".gtsam")
    assert (code, err) == (3, ["graph_slam: lost: 1 FIX, 1 EDGE_ODD: GTSAM's text has no such line"])
    assert "2 of 2 edges" in out


# -- there and back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "ending"),
    [("city.g2o", e) for e in (".toro", ".graph", ".gtsam", ".copy.g2o")]
    + [("landmarks.g2o", e) for e in (".gtsam", ".copy.g2o")],
)
def test_a_graph_in_the_plane_comes_back_with_the_same_numbers(convert, name, ending):
    *_, target = convert(DATA / name, ending)
    one, two = read_g2o(DATA / name), read_g2o(target)
    if ending == ".gtsam":
        two.ids = [v - LANDMARK_IDS_FROM if v >= LANDMARK_IDS_FROM else v for v in two.ids]
    assert_same_graph(one, two)


@PUBLIC
@pytest.mark.parametrize("ending", [".toro", ".gtsam"])
@pytest.mark.parametrize("name", ["M3500", "input_INTEL", "intel_943", "manhattanOlson3500", "ring"])
def test_public_graphs_in_the_plane_come_back_with_the_same_numbers(convert, name, ending):
    code, _, err, target = convert(GRAPHS / f"{name}.g2o", ending)
    assert (code, err) == (0, [])
    assert_same_graph(read_g2o(GRAPHS / f"{name}.g2o"), read_g2o(target, dialect=format_of(target)))


@PUBLIC
@pytest.mark.parametrize("information", ["g2o", "raw"])
@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D", "parking-garage"])
def test_public_graphs_in_space_come_back_from_toro_with_the_same_rotations_and_information(convert, name, information):
    code, _, err, target = convert(GRAPHS / f"{name}.g2o", ".toro", "--information", information)
    assert (code, err) == (0, [])
    raw = information == "raw"
    one, two = (read_g2o(path, raw=raw) for path in (GRAPHS / f"{name}.g2o", target))
    for file in (one, two):  # a quaternion and its negative are one rotation
        for column, width in [(file.graph.initial, 7), *((t.measured, 7) for t in file.graph.tables.values())]:
            rows = column.values.reshape(-1, width)
            rows[rows[:, 6] < 0.0, 3:] *= -1.0
            rows[:, 3:][np.abs(rows[:, 6]) < 1e-12] = 0.0  # half a turn: the sign is anyone's
    assert_same_graph(one, two, rotations=1e-14)


def test_roll_pitch_and_yaw_are_exact_also_where_the_nose_points_up():
    rng = np.random.default_rng(5)
    quaternions = [q / np.linalg.norm(q) for q in rng.standard_normal((500, 4))]
    for pitch in (np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, -np.pi / 2 + 3e-8, np.pi / 2 - 1e-5):
        quaternions += list(Rotation.from_euler("xyz", [[r, pitch, 1.5 * r + 1] for r in range(-3, 4)]).as_quat())
    quaternions += [np.eye(4)[k] for k in range(4)] + [-np.eye(4)[k] for k in range(4)]
    for q in quaternions:
        words = ["VERTEX_SE3:QUAT", "1", "0.0", "0.0", "0.0", *(repr(float(v)) for v in q)]
        toro = from_g2o_words(words, Text("toro"))
        roll, pitch, yaw = map(float, toro[5:])
        assert max(abs(roll), abs(yaw)) <= np.pi and abs(pitch) <= np.pi / 2 + 1e-15
        assert np.allclose(
            Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix(), Rotation(q).as_matrix(), atol=2e-15
        )
        back = np.array([float(v) for v in in_g2o_words(toro, Text("toro"))[5:]])
        assert min(np.abs(back - q).max(), np.abs(back + q).max()) < 1e-15


def test_the_information_of_rotations_is_that_of_the_rotation_vector_in_toro(convert):
    *_, target = convert(SPACE, ".toro")
    words = next(line.split() for line in target.read_text().splitlines() if line.startswith("EDGE3"))
    written, g2o = np.zeros((6, 6)), np.zeros((6, 6))
    written[np.triu_indices(6)] = [float(v) for v in words[9:]]
    g2o[np.triu_indices(6)] = [float(v) for v in UPPER.split()]
    assert words[6:9] == pytest.approx(words[6:9])
    assert written[:3, :3] == pytest.approx(g2o[:3, :3])
    assert written[:3, 3:] == pytest.approx(g2o[:3, 3:] / 2)
    assert written[3:, 3:] == pytest.approx(g2o[3:, 3:] / 4)


@PUBLIC
@pytest.mark.parametrize("name", ["input_INTEL.g2o", "ring.g2o", "tinyGrid3D.g2o", "parking-garage.g2o"])
@pytest.mark.parametrize("ending", [".toro", ".gtsam", ".out.g2o"])
def test_a_converted_graph_optimises_to_the_same_chi2(convert, name, ending):
    code, _, err, target = convert(GRAPHS / name, ending)
    if ending == ".gtsam" and name in ("tinyGrid3D.g2o", "parking-garage.g2o"):
        assert (code, err) == (2, [f"graph_slam: {target}: GTSAM's text can say no edge of this graph"])
        assert not target.exists()
        return
    one, two = solved(GRAPHS / name), solved(target)
    assert one.converged
    assert two.chi2_initial == pytest.approx(one.chi2_initial, rel=1e-9)
    assert two.chi2_final == pytest.approx(one.chi2_final, rel=1e-9)


@PUBLIC
def test_edges_alone_start_from_their_tree_and_keep_their_numbers(convert, tmp_path):
    source = GRAPHS / "victoria_park.txt"
    code, out, err, target = convert(source, ".g2o")
    assert (code, err) == (0, [])
    told, written, _ = out.splitlines()
    assert written.startswith(f"wrote {target} as g2o: ")
    assert told == "the file has no vertex lines: those of the spanning tree are written"
    g2o = read_g2o(target)
    assert g2o.has_values
    assert np.array_equal(g2o.graph.initial.values, initial_values(read_g2o(source).graph, "tree", 0))
    code, out, err, again = convert(source, ".gtsam")
    assert (code, err, len(out.splitlines())) == (0, [], 2)
    assert not any(line.startswith("VERTEX") for line in again.read_text().splitlines())
    assert_same_graph(read_g2o(source), read_g2o(again))
    lines = [path.read_text().splitlines() for path in (source, again)]
    # pose, landmark and position are the text's own again
    seen = [sorted(tuple(map(float, x.split()[1:5])) for x in text if x.startswith("LANDMARK")) for text in lines]
    assert seen[0] == seen[1]
    code, _, err, _ = convert(target, ".toro")
    assert (code, err) == (3, ["graph_slam: lost: 151 VERTEX_XY, 3640 EDGE_SE2_XY: TORO has no such line"])


def test_a_landmark_and_a_pose_of_one_number_are_two_vertices_in_gtsam_text(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_XY 1 2 0\nLANDMARK 0 1 2 0 1 0 1\n"
                    "LANDMARK 1 1 1 0 1 0 1\nODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n")  # fmt: skip
    file = read_g2o(path)
    assert file.ids == [0, 1, LANDMARK_IDS_FROM + 1]
    assert [file.graph.kind_of(v) for v in range(3)] == [SE2, SE2, R2]
    write_graph(tmp_path / "b.txt", file, Solver(file.graph).estimate, "gtsam")
    assert "VERTEX_XY 1 2.0 0.0" in (tmp_path / "b.txt").read_text().splitlines()
    assert_same_graph(file, read_g2o(tmp_path / "b.txt"))


# -- weights ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", ["g2o", "toro", "gtsam"])
def test_weights_multiply_the_information_and_edges_of_weight_0_are_left_out_and_counted(tmp_path, target):
    graph = Graph()
    graph.add_vertices(SE2, [[k, 0, 0] for k in range(3)])
    edges = graph.add_edges(
        RELATIVE_POSE, [[0, 1], [1, 2], [0, 2]], np.eye(3), Gaussian(np.diag([1.0, 2, 3])), "odometry"
    )
    solver = Solver(graph)
    solver.add(range(3), edges)
    solver.set_weight(1, 0.0)
    solver.set_weight(2, 0.25)
    written = write_graph(tmp_path / "a", G2oFile(graph, [0, 1, 2]), solver.estimate, target)
    assert (written.vertices, written.edges, written.lost) == (3, 2, ["1 edges of weight 0"])
    table = read_g2o(tmp_path / "a").graph.tables[RELATIVE_POSE]
    by_ends = dict(zip(map(tuple, table.vertices.values.tolist()), information(table), strict=True))
    assert set(by_ends) == {(0, 1), (0, 2)}
    assert by_ends[0, 1] == pytest.approx(np.diag([1.0, 4, 9]), rel=1e-14)
    assert by_ends[0, 2] == pytest.approx(np.diag([1.0, 4, 9]) / 4, rel=1e-14)
    assert write_g2o(tmp_path / "b", G2oFile(graph, [0, 1, 2]), solver.estimate) == 1
    assert (tmp_path / "b").read_text().count("EDGE_SE2") == 2


# -- options and refusals --------------------------------------------------------------------------------------------


def test_the_endings_are_those_that_the_help_lists(capsys):
    with pytest.raises(SystemExit):
        main(["convert", "--help"])
    assert set(re.findall(r"\.[a-z]\w+", capsys.readouterr().out)) == set(ENDINGS)


def test_to_overrules_the_ending_and_from_refuses_other_lines(convert):
    assert convert(PLANE, ".txt", "--to", "gtsam")[0] == 0
    *_, target = convert(PLANE, ".g2o.txt", "--to", "toro")
    assert target.read_text().startswith("VERTEX2 ")
    code, _, err, _ = convert(PLANE, ".toro", "--from", "gtsam")
    assert (code, err) == (2, ["graph_slam: a.g2o:4: EDGE_SE2 is no line of a gtsam file"])
    code, _, err, _ = convert("VERTEX2 0 0 0 0\n", ".toro", "--from", "g2o")
    assert (code, err) == (2, ["graph_slam: a.g2o:1: VERTEX2 is no line of a g2o file"])


def test_from_toro_guesses_at_no_other_order(convert):
    rows = "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0.5 4 0 0 3 0 9\n"
    code, _, err, target = convert(rows, ".toro")  # nor is it taken for TORO's without being asked
    assert (code, target.exists()) == (2, False)
    assert err[0].startswith("graph_slam: a.g2o:3: EDGE2 is not in TORO's order: --from isam")
    for source in ("isam", "rows"):
        assert convert(rows, ".toro", "--from", source)[0] == 0
    code, _, err, _ = convert(rows, ".toro", "--from", "toro")
    assert code == 2
    assert err[0].startswith("graph_slam: a.g2o:3: information is not positive definite")


def test_an_order_is_not_guessed_from_units(tmp_path):
    path = tmp_path / "a.graph"  # 1e-9 m and a right angle: determinants of such matrices are rounding alone
    path.write_text("VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 1e18 9e17 1e18 1e-2 9e7 9e7\n")
    expected = [[1e18, 9e17, 9e7], [9e17, 1e18, 9e7], [9e7, 9e7, 1e-2]]
    assert information(read_g2o(path).graph.tables[RELATIVE_POSE])[0] == pytest.approx(np.array(expected), rel=1e-9)


@pytest.mark.parametrize(
    ("source", "ending", "options", "complaint"),
    [
        (PLANE, ".txt", [], "b.txt: its ending is none of .g2o, .toro, .graph, .gtsam, .tum; --to names the format"),
        (PLANE, "", [], "b: its ending is none of"),
        (PLANE, ".g2o", ["--to", "ros"], "argument --to: invalid choice: 'ros'"),
        (PLANE, ".g2o", ["--from", "tum"], "argument --from: invalid choice: 'tum'"),
        (PLANE + "EDGE_SE2 1 2\n", ".toro", [], "a.g2o:6: EDGE_SE2 needs 11 fields after the tag, found 2"),
        (SPACE, ".gtsam", [], "GTSAM's text can say no edge of this graph"),
        (PLANE.replace("4 1 9", "1e-309 0 9"), ".gtsam", [], "EDGE_SE2_XY 11 7: the information is too small to have"),
        ("VERTEX_XY 1 2 3\n", ".tum", [], "a trajectory needs poses of one kind, and this graph has 0 kinds"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 2 3 1 0 0 1 0 0 1 0 1\n", ".g2o", [], "no relative poses lead from"),
        (Path("none.g2o"), ".toro", [], "none.g2o: no such file"),
    ],
)
def test_a_refusal_is_one_line_with_code_2_and_nothing_is_written(convert, source, ending, options, complaint):
    code, out, err, target = convert(source, ending, *options)
    assert (code, out, len(err)) == (2, "", 1)
    assert err[0].startswith("graph_slam")
    assert complaint in err[0]
    assert not target.exists()


def test_a_trajectory_is_no_graph(convert, tmp_path):
    (tmp_path / "path.tum").write_text("0.0 1 2 0 0 0 0 1\n")
    code, _, err, _ = convert(tmp_path / "path.tum", ".g2o")
    assert code == 2
    assert err == [
        f"graph_slam: {tmp_path}/path.tum: a trajectory has no edges, and so is no graph: TUM is only written"
    ]


def test_gzipped_files_are_read_and_written_by_the_ending_before(convert, tmp_path):
    code, out, err, target = convert(PLANE, ".toro.gz", "--lenient")
    assert (code, err) == (3, ["graph_slam: lost: 1 VERTEX_XY, 1 EDGE_SE2_XY: TORO has no such line"])
    assert f"wrote {target} as TORO" in out
    code, _, err, again = convert(target, ".g2o")
    assert (code, err) == (0, [])
    assert_same_graph(read_g2o(target), read_g2o(again))
    target.write_bytes(target.read_bytes()[:-9])
    code, out, err, _ = convert(target, ".out.g2o")
    assert (code, out, err) == (2, "", ["graph_slam: b.toro.gz: damaged, or not a gzip file"])
    assert convert(tmp_path / "a.tum.gz", ".g2o")[0] == 2
    assert convert(PLANE, ".nonsense.gz")[0] == 2


def test_a_file_is_not_written_over_while_it_is_read(convert, tmp_path):
    (tmp_path / "b.g2o").write_text(PLANE)
    code, _, err, target = convert(tmp_path / "b.g2o", ".g2o")
    assert (code, err) == (2, [f"graph_slam: {target}: cannot be read from and written to at once"])
    assert target.read_text() == PLANE


def test_lenient_reading_tells_what_was_left_out(convert):
    code, out, err, _ = convert(PLANE + "EDGE_SE2 1 2\n", ".out.g2o", "--lenient")
    assert (code, err) == (3, ["graph_slam: lost: a.g2o:6: EDGE_SE2 needs 11 fields after the tag, found 2"])
    assert "2 of 2 edges" in out


@pytest.mark.parametrize("target", ["isam", "rows", "ros"])
def test_formats_that_are_only_read_or_unknown_are_not_written(tmp_path, target):
    (tmp_path / "a.g2o").write_text(PLANE)
    file = read_g2o(tmp_path / "a.g2o")
    with pytest.raises(FormatError, match=f"'{target}' is not written: choose g2o, toro, gtsam, tum"):
        write_graph(tmp_path / "b", file, Solver(file.graph).estimate, target)
    assert not (tmp_path / "b").exists()


def test_unknown_formats_are_refused_with_the_choices(tmp_path):
    (tmp_path / "a.g2o").write_text(PLANE)
    with pytest.raises(FormatError, match="dialect 'ros': choose g2o, toro, gtsam"):
        read_g2o(tmp_path / "a.g2o", dialect="ros")
