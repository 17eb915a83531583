"""What data/README.md says of the files beside it is true."""

import hashlib
import os
import re
from pathlib import Path

import pytest
from places import ROOT

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.solver import Settings, Solver

DATA = ROOT / "data"
README = (DATA / "README.md").read_text()
WORDS = r"[A-Za-z]\w+|-?\d+\.?\d*(?:e[+-]?\d+)?"
SUMS = dict(re.findall(r"^\| `([\w.]+)` .*`([0-9a-f]{64})` \|$", README, re.MULTILINE))
REFERENCES = re.findall(
    r"^\| `(\w+\.g2o)` \| (\w+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", README, re.MULTILINE
)


@pytest.fixture(scope="module")
def made_again(tmp_path_factory):
    """A folder with the bag and the city, made by the lines that the README shows."""
    folder, before = tmp_path_factory.mktemp("data"), Path.cwd()
    (lines,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    os.chdir(folder)
    try:
        exec(lines, {})
    finally:
        os.chdir(before)
    return folder


def test_every_file_has_the_sha256_that_the_readme_lists():
    files = {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in DATA.iterdir() if f.name != "README.md"}
    assert files == SUMS


@pytest.mark.parametrize("name, error_map, start, optimum, odometry, others", REFERENCES)
def test_each_graph_has_the_optimum_that_the_readme_states(name, error_map, start, optimum, odometry, others):
    file = read_g2o(DATA / name, error_map=error_map)
    solver = Solver(file.graph, Settings(step_tolerance=1e-10, cost_tolerance=1e-14))
    solver.add(range(file.graph.vertex_count), range(file.graph.edge_count))
    for vertex in file.fixed:
        solver.hold(vertex)
    report = solver.optimize()
    assert report.converged
    classes = [c.chi2 for _, c in sorted(report.classes.items(), key=lambda item: item[0] != "odometry")]
    assert f"{report.chi2_initial:.3f}" == start
    assert [report.chi2_final, *classes] == pytest.approx([float(optimum), float(odometry), float(others)], abs=2e-6)


def test_the_lines_in_the_readme_make_the_bag_and_the_city_again(made_again):
    ours, again = ((folder / "city.g2o").read_text().splitlines() for folder in (DATA, made_again))
    assert [line.split()[0] for line in ours] == [line.split()[0] for line in again]
    numbers = [[float(word) for line in file if line[0] != "#" for word in line.split()[1:]] for file in (ours, again)]
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-9, abs=1e-9)  # the last digits of sines differ by machine
    bags = [open_bag(folder / "demo.mcap") for folder in (DATA, made_again)]
    for pair in zip(*(bag.messages(list(bag.topics)) for bag in bags), strict=True):
        assert len({(m.topic, m.log_ns) for m in pair}) == 1
        if pair[0].cdr != pair[1].cdr:
            kind = bags[0].topics[pair[0].topic].type
            read = [re.findall(WORDS, repr(typestore().deserialize_cdr(m.cdr, kind))) for m in pair]
            assert len({tuple(word for word in found if word[0].isalpha()) for found in read}) == 1
            floats = [[float(word) for word in found if not word[0].isalpha()] for found in read]
            assert floats[0] == pytest.approx(floats[1], rel=1e-9, abs=1e-9)
