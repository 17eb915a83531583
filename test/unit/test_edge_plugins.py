"""Edge types of a package of its own: the example of the page in g2o files, and plugins that fail."""

import re

import pytest
from installed import installer
from places import ROOT

from graph_slam_ros import edge_tags
from graph_slam_ros.cli import main
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.graph import RELATIVE_POSE

PAGE = (ROOT / "docs/library.md").read_text()
(EXAMPLE,) = re.findall(r"```python\n(import numpy as np\n.*?)check_edge\(tdoa\)", PAGE, re.DOTALL)
(ENTRY,) = set(re.findall(r'\[project\.entry-points\."(.*)"\]\n(\w+) = "(\w+):(\w+)"', PAGE))
LINES = ["EDGE_TDOA 0 1 2 -2.4 10000", "EDGE_TDOA 0 1 3 -3.6 10000", "EDGE_TDOA 0 1 4 -1.2 10000"]
GRAPH = "".join(f"VERTEX_XY {k} {x} {y}\n" for k, (x, y) in enumerate([(0, 0), (8, 0), (8, 6), (0, 6)], start=1))
GRAPH += "FIX 1 2 3 4\nVERTEX_SE2 0 1 1 0\nEDGE_PRIOR_SE2 0 1 1 0 0.0123 0 0 0.0123 0 100\n"
GRAPH += "".join(f"{line}\n" for line in LINES)


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
    assert main(["optimize", str(graph)]) == 3
    assert "lost: 3 EDGE_TDOA: of an unknown kind" in capsys.readouterr().err, "without the plugin"
    install(EXAMPLE)
    solved = tmp_path / "solved.g2o"
    assert main(["optimize", str(graph), "--out", str(solved)]) == 3, capsys.readouterr().err
    assert "unknown" not in capsys.readouterr().err
    (pose,) = [line.split() for line in solved.read_text().splitlines() if line.startswith("VERTEX_SE2")]
    assert [float(x) for x in pose[2:4]] == pytest.approx([2.53, 2.12], abs=0.01)
    again = [line.split() for line in solved.read_text().splitlines() if line.startswith("EDGE_TDOA")]
    assert [[float(x) for x in words[1:]] for words in again] == [[float(x) for x in s.split()[1:]] for s in LINES]
    file = read_g2o(solved)
    (edge,) = [one for one in file.graph.tables if one.name == "difference of ranges"]
    assert len(file.graph.tables[edge].ids) == 3


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("import not_there", "cannot be loaded: ModuleNotFoundError: No module named 'not_there'"),
        ("tdoa = 3", "it is a int, not an EdgeType"),
        ("from graph_slam_ros.graph import *\ntdoa = edge_from_residual('', (), 1, 1, len)", "cannot be loaded: Graph"),
        (EXAMPLE.replace("pose, one, other = values", "1 / 0"), "ZeroDivisionError: division by zero"),
        (EXAMPLE.replace("    return [", "    return [1.0, 2.0, "), "the residual has the shape (3,), not (1,)"),
        (EXAMPLE.replace("_of_ranges)", "_of_ranges, lambda v, z: np.ones((1, 7)))"), "Jacobian[0, "),
        (
            EXAMPLE.replace("_of_ranges)", "_of_ranges, lambda v, z: np.full((1, 7), 1 if z > 0.5 else np.nan))"),
            "Jacobian[0, ",
        ),
    ],
)
def test_a_plugin_that_cannot_be_used_or_raises_is_named_in_one_line(text, line, install, graph, capsys):
    install(text)
    assert main(["optimize", str(graph)]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert "plugin my_tdoa:tdoa of my-tdoa 1.0" in said
    assert line in said


def test_a_built_in_tag_is_never_a_plugins_and_info_lists_edge_types_of_plugins_usable_or_not(install):
    install(EXAMPLE)
    install("tdoa = 3", name="EDGE_WRONG", module="my_wrong")
    install(EXAMPLE, name="EDGE_SE2", module="my_other")
    assert edge_tags.edge_of("EDGE_SE2") is RELATIVE_POSE
    assert edge_tags.described() == [
        "EDGE_SE2: the plugin of my-other 1.0 is not used: it is built in",
        "EDGE_TDOA: 'difference of ranges', an edge type of my-tdoa 1.0",
        "EDGE_WRONG: plugin my_wrong:tdoa of my-wrong 1.0: it is a int, not an EdgeType",
    ]
