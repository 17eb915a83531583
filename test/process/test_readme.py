"""The Python of docs/library.md and theory.md prints what the page says; the names at top level are what they say."""

import re
import subprocess
import sys

import pytest
from places import ROOT
from rows import each

import graph_slam_ros

PAGES = ("library", "theory")
BLOCKS = [
    block
    for page in PAGES
    for block in re.findall(r"```python\n(.*?)```", (ROOT / f"docs/{page}.md").read_text(), re.DOTALL)
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the blocks run: data is there, and what they write stays out of the tree."""
    (tmp_path / "data").symlink_to(ROOT / "data")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@each("block", BLOCKS)
def test_a_block_of_the_docs_prints_what_it_says(block, folder, capsys):
    said = re.findall(r"^print\(.*\)  # (.*)$", block, re.MULTILINE)
    assert len(said) == block.count("print(") > 0
    exec(compile(block, "docs", "exec"), {"__name__": "readme"})
    assert capsys.readouterr().out.splitlines() == said


def test_the_docs_have_every_way():
    assert len(BLOCKS) == 9
    assert all(re.search(rf"\b{name}\b", "".join(BLOCKS)) for name in ("optimize", "Solver", "GraphSlam"))


def test_every_public_name_is_there_once_and_documented():
    assert len(set(graph_slam_ros.__all__)) == len(graph_slam_ros.__all__)
    assert set(graph_slam_ros.__all__) <= set(dir(graph_slam_ros))
    for name in graph_slam_ros.__all__:
        assert getattr(graph_slam_ros, name).__doc__, name
    with pytest.raises(AttributeError, match="has no attribute 'solve'"):
        graph_slam_ros.solve  # noqa: B018


def test_a_type_checker_and_python_find_the_same_names():
    script = "import graph_slam_ros as g; print(*(getattr(g, n).__module__ + '.' + n for n in g.__all__), sep='\\n')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)
    text = (ROOT / "graph_slam_ros/__init__.py").read_text()
    typed = {
        name: home
        for home, names in re.findall(r"^    from ([\w.]+) import (.*)$", text, re.MULTILINE)
        for name in names.split(", ")
    }
    assert sorted(typed) == sorted(graph_slam_ros.__all__)
    for line in done.stdout.split():
        home, name = line.rsplit(".", 1)
        assert home.startswith(typed[name]), "the same folder or file"


def test_optimize_takes_a_file_what_was_read_and_a_graph():
    path = ROOT / "data/landmarks.g2o"
    file = graph_slam_ros.read_g2o(path)
    assert file.fixed == [0]
    solutions = [graph_slam_ros.optimize(source) for source in (path, str(path), file, file.graph)]
    for solution in solutions:  # a bare graph has no FIX line: its first pose is held all the same
        assert solution.report.converged
        assert solution.report.chi2_final == pytest.approx(1021.705300, abs=1e-4)
        assert solution.poses.shape == (101, 3)
        assert solution.points.shape == (5, 2)
        assert solution.poses.tobytes() == solutions[0].poses.tobytes()


def test_optimize_starts_where_it_is_told_and_as_it_is_told():
    settings = graph_slam_ros.Settings(method="lm")
    solution = graph_slam_ros.optimize(ROOT / "data/city.g2o", settings, init="chordal")
    assert (solution.start, solution.report.method) == ("chordal", "lm")
    assert solution.report.chi2_initial < 1e4
    assert solution.report.chi2_final == pytest.approx(465.969818, abs=1e-3)
