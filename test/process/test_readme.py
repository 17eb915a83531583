"""The Python of docs/library.md and theory.md prints what the page says; the names at top level are what they say."""

import re

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
    assert all(re.search(rf"\b{name}\b", "".join(BLOCKS)) for name in ("optimize", "Solver", "GraphSlam"))


def test_every_public_name_is_there_once_and_documented():
    assert len(set(graph_slam_ros.__all__)) == len(graph_slam_ros.__all__)
    assert set(graph_slam_ros.__all__) <= set(dir(graph_slam_ros))
    for name in graph_slam_ros.__all__:
        assert getattr(graph_slam_ros, name).__doc__, name
    with pytest.raises(AttributeError, match="has no attribute 'solve'"):
        graph_slam_ros.solve  # noqa: B018


def test_a_type_checker_and_python_find_the_same_names():
    text = (ROOT / "graph_slam_ros/__init__.py").read_text()
    imports = re.findall(r"^    from ([\w.]+) import (.*)$", text, re.MULTILINE)
    typed = {name: home for home, names in imports for name in names.split(", ")}
    assert sorted(typed) == sorted(graph_slam_ros.__all__)
    for name, home in typed.items():
        assert getattr(graph_slam_ros, name).__module__.startswith(home), "the same folder or file"
