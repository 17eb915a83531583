"""What data/README.md says of the files beside it is true."""

import hashlib
import os
import re
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from scipy.optimize import least_squares

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.lie import se2
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.solver import Settings, Solver

DATA = ROOT / "data"
README = (DATA / "README.md").read_text()
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


def test_the_lines_in_the_readme_make_the_city_again(made_again):
    ours, again = (
        [line.split() for line in (folder / "city.g2o").read_text().splitlines()] for folder in (DATA, made_again)
    )
    assert [line[0] for line in ours] == [line[0] for line in again]
    numbers, numbers_again = (
        np.array([float(word) for line in file if line[0] != "#" for word in line[1:]]) for file in (ours, again)
    )
    # the last digits of sines differ between machines
    assert numbers == pytest.approx(numbers_again, rel=1e-9, abs=1e-9)


def test_the_lines_in_the_readme_make_the_bag_again(made_again):
    ours, again = (open_bag(folder / "demo.mcap") for folder in (DATA, made_again))
    assert ours.topics == again.topics
    pairs = zip(ours.messages(list(ours.topics)), again.messages(list(ours.topics)), strict=True)
    for a, b in pairs:
        assert (a.topic, a.log_ns) == (b.topic, b.log_ns)
        if a.cdr != b.cdr:
            kind = ours.topics[a.topic].type
            one, other = (list(leaves(typestore().deserialize_cdr(m.cdr, kind))) for m in (a, b))
            assert [type(x) for x in one] == [type(x) for x in other]
            assert [x for x in one if not isinstance(x, float)] == [x for x in other if not isinstance(x, float)]
            floats, floats_again = ([x for x in side if isinstance(x, float)] for side in (one, other))
            assert floats == pytest.approx(floats_again, rel=1e-9, abs=1e-9)


def leaves(value):
    if isinstance(value, np.ndarray):
        yield from value.tolist()
    elif isinstance(value, list):
        for item in value:
            yield from leaves(item)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            yield from leaves(getattr(value, name))
    else:
        yield value


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


def edges_of(lines, tag, size):
    """Ends, measured and the Cholesky factor of the information of all edges with a tag, from the text alone."""
    rows = np.array([[float(word) for word in line[1:]] for line in lines if line[0] == tag])
    information = np.zeros((len(rows), size, size))
    upper = np.triu_indices(size)
    information[:, upper[0], upper[1]] = information[:, upper[1], upper[0]] = rows[:, 2 + size :]
    return rows[:, 0].astype(int), rows[:, 1].astype(int), rows[:, 2 : 2 + size], np.linalg.cholesky(information)


def residuals(free, odometry, sightings, first):
    poses = np.vstack([first, free[:300].reshape(-1, 3)])
    points = free[300:].reshape(-1, 2)
    i, j, measured, root = odometry
    steps = se2.between(tuple(poses[i].T), tuple(poses[j].T))
    out = [np.einsum("nji,nj->ni", root, np.stack(se2.between(tuple(measured.T), steps), axis=1))]
    i, j, measured, root = sightings
    seen = np.stack(se2.act(se2.inverse(tuple(poses[i].T)), tuple(points[j - 101].T)), axis=1)
    out.append(np.einsum("nji,nj->ni", root, seen - measured))
    return np.concatenate([r.ravel() for r in out])


def test_a_general_optimiser_finds_the_chi2_that_the_readme_states():
    lines = [line.split() for line in (DATA / "landmarks.g2o").read_text().splitlines()]
    edges = edges_of(lines, "EDGE_SE2", 3), edges_of(lines, "EDGE_SE2_XY", 2)
    file = read_g2o(DATA / "landmarks.g2o")
    solver = Solver(file.graph)
    solver.add(range(106), range(file.graph.edge_count))
    solver.hold(0)
    solver.optimize()
    found = np.concatenate([solver.estimate(range(1, 101)).ravel(), solver.estimate(range(101, 106)).ravel()])
    start = found + 0.01 * np.random.default_rng(0).standard_normal(len(found))
    best = least_squares(residuals, start, args=(*edges, solver.estimate([0])[0]), x_scale="jac", max_nfev=15)
    (stated,) = {float(row[3]) for row in REFERENCES if row[:2] == ("landmarks.g2o", "relative")}
    assert 2.0 * best.cost == pytest.approx(stated, rel=1e-6)
