"""The commands on saved maps: export, diff, merge, freeze."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from runs import drive, with_a_wrong_sighting

from graph_slam_ros import cli, read_g2o
from graph_slam_ros.ros.bag import open_bag
from graph_slam_ros.ros.interfaces import typestore
from graph_slam_ros.run import RunRecorder, taken_up
from graph_slam_ros.simulation import measurements, simulate
from graph_slam_ros.slam import Config, Control, GraphSlam, Sightings


@pytest.fixture(scope="module")
def world():
    return list(measurements(simulate("warehouse", 0, aisles=2, laps=1)))


@pytest.fixture(scope="module")
def cut_off(world, tmp_path_factory):
    """A run that nobody ended, and its pipeline."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    return folder, drive(folder, Config(), world)


@pytest.fixture(scope="module")
def whole(cut_off, tmp_path_factory):
    """The same run, ended."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert cli.main(["recover", str(cut_off[0]), "--out", str(folder)]) == 3
    return folder


def run(*words):
    return cli.main([str(word) for word in words])


# -- export ------------------------------------------------------------------------------------------------------------


def test_export_writes_what_the_run_folder_has(whole, tmp_path, capsys):
    assert run("export", whole, "--to", "tum", "--out", tmp_path / "path.tum") == 0
    assert run("export", whole, "--to", "g2o", "--out", tmp_path / "graph.g2o") == 0
    assert "graph_vertices.csv" in capsys.readouterr().out
    assert (tmp_path / "graph_vertices.csv").read_bytes() == (whole / "graph_vertices.csv").read_bytes()
    a, b = (np.loadtxt(folder / "path.tum") for folder in (whole, tmp_path))
    assert b == pytest.approx(a, abs=1e-6)
    ours, theirs = (read_g2o(folder / "graph.g2o").graph for folder in (whole, tmp_path))
    assert theirs.edge_count == ours.edge_count
    assert theirs.initial.values == pytest.approx(ours.initial.values, abs=1e-6)


def test_export_of_a_graph_may_be_gzipped(whole, tmp_path):
    assert run("export", whole, "--to", "g2o", "--out", tmp_path / "map.g2o.gz") == 0
    assert (tmp_path / "map_vertices.csv").read_bytes() == (whole / "graph_vertices.csv").read_bytes()
    assert read_g2o(tmp_path / "map.g2o.gz").graph.vertex_count == read_g2o(whole / "graph.g2o").graph.vertex_count


def test_export_as_messages_has_every_pose_at_its_stamp(cut_off, tmp_path):
    folder, slam = cut_off
    assert run("export", folder, "--to", "mcap", "--out", tmp_path / "map.mcap") == 3, "its end is missing"
    bag = open_bag(tmp_path / "map.mcap")
    counts = {name: topic.count for name, topic in bag.topics.items()}
    assert counts == {"/pose": len(slam.keyframes), "/path": 1, "/landmarks": 1, "/landmarks_estimate": 1}
    read = [(m.log_ns, typestore().deserialize_cdr(m.cdr, bag.topics["/pose"].type)) for m in bag.messages({"/pose"})]
    assert [stamp for stamp, _ in read] == slam.keyframes.stamps_ns.tolist()
    at = [(m.pose.pose.position.x, m.pose.pose.position.y) for _, m in read]
    assert np.array(at) == pytest.approx(slam.trajectory()[:, :2], abs=1e-6)
    variance = [m.pose.covariance[35] for _, m in read]
    assert variance == pytest.approx(slam.keyframe_covariances()[:, 2, 2], rel=1e-3)
    assert len(next(iter(bag.messages({"/landmarks_estimate"}))).cdr) > 100 * len(slam.landmarks)


def test_export_of_a_map_that_is_cut_is_of_what_is_left_and_tells(cut_off, tmp_path, capsys):
    folder, slam = cut_off
    shutil.copytree(folder, tmp_path / "run")
    whole = (folder / "map.mcap").read_bytes()
    (tmp_path / "run" / "map.mcap").write_bytes(whole[: len(whole) // 2])
    assert run("export", tmp_path / "run", "--to", "tum", "--out", tmp_path / "path.tum") == 3
    assert "lost: " in capsys.readouterr().err
    stamps = [line.split()[0] for line in (tmp_path / "path.tum").read_text().splitlines()]
    assert 10 < len(stamps) < len(slam.keyframes)
    assert stamps[0] == f"{slam.keyframes[0].stamp_ns / 1e9:.9f}"


def test_export_refuses_in_one_line(whole, tmp_path, capsys):
    before = (whole / "path.tum").read_bytes()
    for words in (
        (whole, "--to", "tum", "--out", whole / "path.tum"),
        (tmp_path, "--to", "tum", "--out", tmp_path / "path.tum"),
        (whole, "--to", "mcap", "--out", tmp_path / "none" / "map.mcap"),
    ):
        assert run("export", *words) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert (whole / "path.tum").read_bytes() == before


# -- diff --------------------------------------------------------------------------------------------------------------


def told(capsys, *words):
    """(exit code, what is on standard output as JSON)."""
    capsys.readouterr()
    code = run(*words)
    return code, json.loads(capsys.readouterr().out)


def moved(world, name, by_m, after_ns=0):
    """A landmark stands elsewhere: what is seen of it is farther ahead of the robot."""
    for m in world:
        if isinstance(m, Sightings) and m.stamp_ns >= after_ns:
            m = replace(m, sightings=tuple(_farther(one, by_m) if one.id == name else one for one in m.sightings))
        yield m


def _farther(one, by_m):
    return replace(one, measured=(one.measured[0] + by_m, *one.measured[1:]))


def ended(folder, world, config=None):
    """The folder of a run that was ended."""
    recorder = RunRecorder(folder, config or Config())
    slam = GraphSlam(config or Config(), recorder.sink)
    for m in [*world, Control("end"), Control("optimize")]:
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    recorder.close()
    return folder


@pytest.fixture(scope="module")
def first(tmp_path_factory, world):
    return ended(tmp_path_factory.mktemp("runs") / "first", world)


@pytest.fixture(scope="module")
def second(tmp_path_factory):
    """Of another drive, past the same landmarks."""
    world = measurements(simulate("warehouse", 5, aisles=2, laps=1))
    return ended(tmp_path_factory.mktemp("runs") / "second", world)


def test_diff_of_a_run_and_what_it_repeats_to_is_nothing(first, tmp_path, capsys):
    assert run("replay", first, "--out", tmp_path / "again") == 0
    code, found = told(capsys, "diff", first, tmp_path / "again", "--json")
    assert code == 0
    assert found["same"]
    assert found["keyframes"]["a"] == found["keyframes"]["both"] > 50
    assert found["edges"]["a"] == found["edges"]["both"] > 100
    assert run("diff", first, tmp_path / "again") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no difference"


def test_diff_finds_the_landmark_that_was_moved_and_what_is_only_in_one(first, world, tmp_path, capsys):
    slam = taken_up(first, [])
    names = sorted(slam.landmarks, key=lambda name: -slam.landmarks[name].sightings)
    other, gone = names[0], names[1]
    without = [
        replace(m, sightings=tuple(one for one in m.sightings if one.id != gone)) if isinstance(m, Sightings) else m
        for m in moved(world, other, 0.4)
    ]
    code, found = told(capsys, "diff", first, ended(tmp_path / "other", without), "--json")
    assert code == 4
    assert found["only_in_a"] == [gone]
    assert found["only_in_b"] == []
    farthest, *others = found["moved"]
    assert farthest["landmark"] == other
    assert farthest["sigmas"] > 2.0 * max(one["sigmas"] for one in others)
    assert 0.1 < farthest["distance_m"] < 0.8
    assert run("diff", first, tmp_path / "other") == 4
    out = capsys.readouterr().out
    assert f"only in A  landmark {gone}" in out
    assert f"moved      landmark {other}" in out
    assert out.splitlines()[-1] == "they differ"


def test_diff_tells_sigmas_that_are_as_large_as_they_should_be(first, second, capsys):
    code, found = told(capsys, "diff", first, second, "--json")
    assert code == 4
    assert found["aligned_by"].endswith("landmarks")
    sigmas = np.array([one["sigmas"] for one in found["moved"]])
    assert len(sigmas) > 10
    assert 0.5 < np.sqrt(np.mean(sigmas**2)) < 2.0
    assert max(one["distance_m"] for one in found["moved"]) < 0.3


def test_diff_tells_verdicts_on_the_same_measurement(first, world, tmp_path, capsys):
    a = ended(tmp_path / "a", with_a_wrong_sighting(world))
    config = Config.from_mapping({"robust.decide": False})
    b = ended(tmp_path / "b", with_a_wrong_sighting(world), config)
    code, found = told(capsys, "diff", a, b, "--json")
    assert code == 4
    (wrong,) = (one for one in found["verdicts"] if one["verdict_a"] in ("pending", "rejected"))
    assert wrong["about"].startswith("landmarks ")
    assert wrong["verdict_b"] == "accepted"


def test_diff_without_common_landmarks_is_by_stamps(world, first, tmp_path, capsys):
    blind = [m for m in world if not isinstance(m, Sightings)]
    code, found = told(capsys, "diff", first, ended(tmp_path / "blind", blind), "--json")
    assert code == 4
    assert found["aligned_by"] == f"{found['keyframes']['both']} stamps"
    assert found["landmarks"] == {"a": found["landmarks"]["a"], "b": 0, "both": 0}
    assert found["only_in_a"]
    assert found["keyframes_m"][1] > 0.05


def test_diff_of_the_plane_and_space_is_refused(first, tmp_path, capsys):
    flight = list(measurements(simulate("flight", 0)))[:400]
    other = ended(tmp_path / "flight", flight, Config.from_mapping({"world.dimensions": 3}))
    assert run("diff", first, other) == 2
    assert "world.dimensions" in capsys.readouterr().err
    assert told(capsys, "diff", other, other, "--json")[0] == 0
