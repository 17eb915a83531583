"""Worlds with loop closures, and as graphs: the truth beside them explains what was measured."""

import numpy as np
import pytest

from graph_slam_ros import cli
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.lie import se3
from graph_slam_ros.tools.simulation import simulate, with_closures
from graph_slam_ros.tools.simulation.motion import space_of
from graph_slam_ros.tools.simulation.recording import places

WORLDS = {"warehouse": {"aisles": 2, "laps": 2, "aisle_m": 8.0}, "flight": {"laps": 2}}


def run(capsys, *words):
    code = cli.main([str(word) for word in words])
    return code, *capsys.readouterr()


@pytest.mark.parametrize("world", WORLDS)
def test_true_closures_are_off_by_their_noise_and_lead_back_to_an_old_place(world):
    recording = simulate(world, 7, **WORLDS[world])
    many = with_closures(recording, 60, seed=3).closures
    assert len(many) == 60
    assert many != with_closures(recording, 60, seed=4).closures
    at = dict(zip(recording.stamps_ns.tolist(), recording.T_world_base, strict=True))
    space = space_of(recording.T_world_base[0])
    whitened = []
    for c in many:
        assert c.stamp_ns - c.from_stamp_ns >= 10 * 10**9
        a, b = tuple(at[c.from_stamp_ns]), tuple(at[c.stamp_ns])
        assert np.linalg.norm(np.subtract(a, b)[: space.dimensions]) <= 2.0
        error = np.array(space.group.local(c.T_from_base, space.group.between(a, b)))
        whitened.append(np.linalg.solve(np.linalg.cholesky(np.reshape(c.covariance, (space.dof, -1))), error))
    assert np.square(whitened).mean() == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / np.size(whitened)))


def test_places_are_half_a_metre_apart_along_the_way():
    driven = np.column_stack([np.linspace(0.0, 10.0, 1001), np.zeros((1001, 2))])
    assert driven[places(driven), 0] == pytest.approx(np.arange(0.0, 10.1, 0.5), abs=0.011)
    assert places(np.zeros((5, 3))).tolist() == [0]


def test_more_closures_than_the_robot_came_back_for_are_refused():
    with pytest.raises(GraphSlamError, match=r"500 closures: the robot came back to \d+ places only"):
        with_closures(simulate("manhattan", 1, poses=60), 500, seed=1)


@pytest.mark.parametrize(
    "world, sensor",
    [("warehouse", "pose"), ("warehouse", "range_bearing"), ("flight", "position"), ("flight", "range_bearing")],
)
def test_the_truth_beside_a_worlds_graph_explains_it_within_its_noise(tmp_path, capsys, world, sensor):
    file = tmp_path / "world.g2o"
    options = [word for key, value in WORLDS[world].items() for word in ("--set", f"{key}={value}")]
    options += ["--set", f"sensor={sensor}", "--set", "correlation_time_s=0", "--closures", "40"]
    assert run(capsys, "simulate", world, *options, "--out", file)[0] == 0
    graph = read_g2o(file).graph
    recording = with_closures(simulate(world, 0, **WORLDS[world], sensor=sensor, correlation_time_s=0.0), 40, seed=0)
    rows = np.loadtxt(tmp_path / "world.truth.tum")
    poses = len(recording.stamps_ns)
    assert rows[:poses, 1:] == pytest.approx(se3.in_space(recording.T_world_base))
    values = graph.initial.values.copy()
    values[: recording.T_world_base.size] = recording.T_world_base.ravel()
    names = list(dict.fromkeys(s.id for seen in recording.seen for s in seen.sightings))
    for k, name in enumerate(names):
        at, size = graph.offset.values[poses + k], graph.kind_of(poses + k).size
        values[at : at + size] = recording.landmarks[name][:size]
    for table in graph.tables.values():
        residual, _ = table.type.linearize(values, graph.offset.values[table.vertices.values], table.measured.values)
        whitened = np.einsum("nij,nj->ni", table.sqrt_information.values, residual)
        for code, label in enumerate(graph.labels):
            mine = whitened[table.label.values == code]
            if len(mine):
                assert np.square(mine).mean() == pytest.approx(1.0, abs=0.02 + 6.0 * np.sqrt(2.0 / mine.size)), label


def test_of_a_bearing_alone_no_graph_is_made(tmp_path, capsys):
    code, _, err = run(capsys, "simulate", "warehouse", "--set", "sensor=bearing", "--out", tmp_path / "a.g2o")
    assert (code, err.count("\n")) == (2, 1)
    assert "a bearing alone does not determine a landmark" in err
