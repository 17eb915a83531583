"""The commands on saved maps: export, diff, merge, freeze."""

import shutil

import numpy as np
import pytest
from runs import drive

from graph_slam_ros import cli, read_g2o
from graph_slam_ros.ros.bag import open_bag
from graph_slam_ros.ros.interfaces import typestore
from graph_slam_ros.simulation import measurements, simulate
from graph_slam_ros.slam import Config


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
