"""Edge types of a package of its own: the example of the page in g2o files, and plugins that fail."""

import re

import numpy as np
import pytest
from installed import installer
from places import ROOT

from graph_slam_ros import edge_tags
from graph_slam_ros.cli import main
from graph_slam_ros.errors import ConfigError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.graph import GROUPS, LANDMARK_POSITION, R3, SE2, SE3, check_edge, edge_from_residual
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.plugin_edges import failed_edges, measured_at_stamps

PAGE = (ROOT / "docs/library.md").read_text()
(EXAMPLE,) = re.findall(r"```python\n(import numpy as np\n.*?)check_edge\(tdoa\)", PAGE, re.DOTALL)
(ENTRY,) = set(re.findall(r'\[project\.entry-points\."(.*)"\]\n(\w+) = "(\w+):(\w+)"', PAGE))
LINES = ["EDGE_TDOA 0 1 2 -2.4 10000", "EDGE_TDOA 0 1 3 -3.6 10000", "EDGE_TDOA 0 1 4 -1.2 10000"]
GRAPH = "\n".join(
    [
        "VERTEX_SE2 0 1 1 0",
        *(f"VERTEX_XY {k} {x} {y}" for k, (x, y) in enumerate([(0, 0), (8, 0), (8, 6), (0, 6)], start=1)),
        "FIX 1 2 3 4",
        "EDGE_PRIOR_SE2 0 1 1 0 0.0123 0 0 0.0123 0 100",
        *LINES,
        "",
    ]
)


@pytest.fixture
def install(tmp_path, monkeypatch):
    monkeypatch.setattr(edge_tags, "_loaded", {})
    monkeypatch.setattr(edge_tags, "_tags", {})
    with installer(tmp_path, monkeypatch) as put:
        group, tag, module, at = ENTRY

        def installed(text, name=tag, module=module):
            return put(text, group=group, name=name, module=module, at=at)

        yield installed


@pytest.fixture
def graph(tmp_path):
    (tmp_path / "tdoa.g2o").write_text(GRAPH)
    return tmp_path / "tdoa.g2o"


def test_a_tag_of_a_plugin_is_read_solved_written_and_read_again(install, graph, tmp_path, capsys):
    install(EXAMPLE)
    solved = tmp_path / "solved.g2o"
    assert main(["optimize", str(graph), "--out", str(solved)]) == 0, capsys.readouterr().err
    assert "unknown" not in capsys.readouterr().err
    (pose,) = [line.split() for line in solved.read_text().splitlines() if line.startswith("VERTEX_SE2")]
    assert [float(x) for x in pose[2:4]] == pytest.approx([2.53, 2.12], abs=0.01)
    again = [line.split() for line in solved.read_text().splitlines() if line.startswith("EDGE_TDOA")]
    assert [[float(x) for x in words[1:]] for words in again] == [[float(x) for x in s.split()[1:]] for s in LINES]
    file = read_g2o(solved)
    (edge,) = [one for one in file.graph.tables if one.name == "difference of ranges"]
    assert len(file.graph.tables[edge].id.values) == 3


def test_an_edge_type_of_a_program_is_written_with_the_tag_of_its_plugin(install, monkeypatch):
    install(EXAMPLE)
    from my_tdoa import tdoa

    assert edge_tags.tag_of(tdoa) == "EDGE_TDOA"


def test_without_the_plugin_the_lines_are_named_and_no_part_of_the_graph(graph, capsys):
    assert main(["optimize", str(graph)]) == 0
    assert "3 lines with unknown tags kept as they are: EDGE_TDOA" in capsys.readouterr().err


def test_a_built_in_tag_is_never_a_plugins(install):
    install(EXAMPLE, name="EDGE_SE2_XY")
    assert edge_tags.edge_of("EDGE_SE2_XY") is LANDMARK_POSITION
    assert "EDGE_SE2_XY" not in edge_tags.plugin_tags()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("import not_there", "cannot be loaded: ModuleNotFoundError: No module named 'not_there'"),
        ("tdoa = 3", "it is a int, not an EdgeType"),
        (
            "from graph_slam_ros.graph import *\ntdoa = edge_from_residual('mine', (), 1, 1, len)",
            "cannot be loaded: Graph",
        ),
        (EXAMPLE.replace("pose, one, other = values", "1 / 0"), "ZeroDivisionError: division by zero"),
        (EXAMPLE.replace("    return [", "    return [1.0, 2.0, "), "ValueError: could not broadcast"),
    ],
)
def test_a_plugin_that_cannot_be_used_or_raises_is_named_in_one_line(text, line, install, graph, capsys):
    install(text)
    assert main(["optimize", str(graph)]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "plugin my_tdoa:tdoa of my-tdoa 1.0" in said
    assert line in said


def moving(rng):
    """A measurement behind which come motions since a keyframe; of landmarks' slots none."""
    return np.concatenate([rng.standard_normal(1), *(se2.exp(rng.standard_normal(3)) for _ in range(2))])


def moving_in_space(rng):
    return np.concatenate([rng.standard_normal(2), se3.exp(tuple(rng.standard_normal(6)))])


def turned(values, measured):
    """How much farther a pose is turned than another."""
    return [se2.wrap(values[1][2] - values[0][2] - measured[0])]


def at_a_point(values, measured):
    """Azimuth and height of a point from a pose in space."""
    x, y, z = se3.act(se3.inverse(tuple(values[0])), tuple(values[1]))
    return [se2.wrap(np.arctan2(y, x) - measured[0]), z - measured[1]]


@pytest.mark.parametrize(
    ("edge", "drawn", "size"),
    [
        (edge_from_residual("turn", ((SE2,), (SE2,)), 1, 1, turned), moving, 7),
        (edge_from_residual("azimuth and height", ((SE3,), (R3,)), 2, 2, at_a_point), moving_in_space, 9),
    ],
)
def test_an_edge_between_keyframes_measures_at_the_stamps_with_the_right_derivative(edge, drawn, size):
    lifted = measured_at_stamps(edge)
    assert lifted.measured_size == size
    check_edge(lifted, drawn)
    rng = np.random.default_rng(1)
    for _ in range(5):
        kinds = [kinds[0] for kinds in edge.accepts]
        values = [kind.retract(np.array([_origin(kind)]), rng.standard_normal((1, kind.dof)))[0] for kind in kinds]
        z, at = drawn(rng), np.cumsum([[0, *(kind.size for kind in kinds[:-1])]], axis=1)
        moved, first = list(values), edge.measured_size
        for slot, kind in enumerate(kinds):
            if kind in GROUPS:
                motion, first = tuple(z[first : first + kind.size]), first + kind.size
                moved[slot] = np.array(GROUPS[kind].compose(tuple(values[slot]), motion))
        here, _ = lifted.linearize(np.concatenate(values), at, z[None])
        there, _ = edge.linearize(np.concatenate(moved), at, z[None, : edge.measured_size])
        assert here == pytest.approx(there, abs=1e-12)


def _origin(kind):
    return GROUPS[kind].IDENTITY if kind in GROUPS else [0.0] * kind.size


def test_a_line_without_the_motion_is_one_at_the_keyframe_and_one_with_it_is_read_back(install, tmp_path):
    install(EXAMPLE)
    text = GRAPH.replace(LINES[0], "EDGE_TDOA 0 1 2 -2.4 0.5 0.25 0.125 10000")
    (tmp_path / "a.g2o").write_text(text)
    file = read_g2o(tmp_path / "a.g2o")
    (table,) = [table for edge, table in file.graph.tables.items() if edge.name == "difference of ranges"]
    assert table.measured.values.tolist() == [[-2.4, 0.5, 0.25, 0.125], [-3.6, 0, 0, 0], [-1.2, 0, 0, 0]]
    write_g2o(tmp_path / "b.g2o", file, values_of(file.graph))
    lines = [line for line in (tmp_path / "b.g2o").read_text().splitlines() if line.startswith("EDGE_TDOA")]
    assert lines[0] == "EDGE_TDOA 0 1 2 -2.4 0.5 0.25 0.125 10000.0"
    assert lines[1].startswith("EDGE_TDOA 0 1 3 -3.6 1")


def values_of(graph):
    return lambda ids: np.array([graph.vertex(int(v)).initial for v in ids])


def test_one_failing_edge_of_a_map_counts_for_nothing_and_the_others_for_all(install):
    install(EXAMPLE.replace("pose, one, other = values", "pose, one, other = values\n    assert measured[0] != 7.0"))
    edge = edge_tags.map_edge_of("EDGE_TDOA")
    x, at = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 8.0, 0.0]), np.array([[0, 3, 5]] * 3)
    z = np.array([[1.0, 0, 0, 0], [7.0, 0, 0, 0], [2.0, 0.1, 0, 0]])
    with failed_edges() as failed:
        residual, jacobian = edge.linearize(x, at, z)
    (one,) = failed.values()
    assert (one.tag, one.at, one.measured) == ("EDGE_TDOA", (0, 3, 5), (7.0, 0.0, 0.0, 0.0))
    assert one.fault == "edge 'difference of ranges', plugin my_tdoa:tdoa of my-tdoa 1.0: AssertionError: "
    assert not residual[1].any()
    assert not jacobian[1].any()
    for k in (0, 2):
        alone = edge.linearize(x, at[:1], z[k : k + 1])
        assert np.abs(alone[0]).min() > 0.1
        assert (residual[k], jacobian[k]) == (pytest.approx(alone[0][0]), pytest.approx(alone[1][0]))
    with pytest.raises(ConfigError, match=r"edge .difference of ranges., plugin my_tdoa:tdoa of my-tdoa 1\.0: Assert"):
        edge_tags.edge_of("EDGE_TDOA").linearize(x, at, z)
