"""Replay and the run folder: the same sequence gives the same bytes, and nothing is overwritten that is not a run."""

import csv
import dataclasses
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rows import each

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import from_record
from graph_slam_ros.messages import results
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.folder import RunError, run_config
from graph_slam_ros.runs.journal import RecordWriter, parts_of, read_ingest
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.trajectory import read_tum
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.tools.simulation import measurements, simulate, write_bag

RESULTS = (
    "graph.g2o path.tum path_odometry.tum covariances.csv sightings.tum landmarks.csv ledger.csv ledger_changes.csv"
)
RESULTS = tuple(RESULTS.split())
ALL = {*RESULTS, "graph_vertices.csv", "odometry.tum", "run.mcap", "ingest.mcap", "map.mcap", "config.yaml", "run.json"}


@pytest.fixture(scope="module")
def world():
    return simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0)


@pytest.fixture(scope="module")
def bag(tmp_path_factory, world):
    file = tmp_path_factory.mktemp("bag") / "drive.mcap"
    write_bag(world, file)
    return file


@pytest.fixture(scope="module")
def made(tmp_path_factory, bag):
    out = tmp_path_factory.mktemp("runs") / "first"
    return out, replay(bag, out)


@pytest.fixture(scope="module")
def folder(made):
    return made[0]


@pytest.fixture(scope="module")
def run(made):
    return made[1]


def contents(folder, names=RESULTS):
    return {name: (folder / name).read_bytes() for name in names}


def test_a_run_folder_holds_what_it_says(folder, run):
    assert {file.name for file in folder.iterdir()} == ALL
    summary = json.loads((folder / "run.json").read_text())
    assert summary["keyframes"] == len(run.slam.view.keyframes) > 50
    assert summary["landmarks"] == len(run.slam.view.landmarks) > 10
    assert summary["edges"] == run.slam.view.graph.edge_count == summary["keyframes"] + summary["sightings"]
    assert sum(c["edges"] for c in summary["classes"].values()) == summary["edges"]
    assert sum(c["chi2"] for c in summary["classes"].values()) == pytest.approx(summary["chi2"])
    assert summary["converged"]
    assert summary["counters"] == {}
    assert summary["losses"] == []


ONE_AFTER_THE_OTHER = """
import sys
from pathlib import Path
from graph_slam_ros.runs.replay import replay
for source, out in zip(sys.argv[1::2], sys.argv[2::2]):
    replay(Path(source), Path(out))
"""


def test_what_a_process_has_replayed_before_changes_no_byte(tmp_path, folder, bag):
    """The short run needs other kernels first."""
    recorder = RunRecorder(tmp_path / "short", Config())
    for measurement in (Odometry(10**15, (0.0, 0.0, 0.0), None, "odom"), Control("end"), Control("optimize")):
        recorder.sink(measurement)
    recorder.close()
    runs = [tmp_path / "short", tmp_path / "short_again", bag, tmp_path / "again"]
    subprocess.run([sys.executable, "-c", ONE_AFTER_THE_OTHER, *map(str, runs)], check=True)
    assert contents(tmp_path / "again") == contents(folder)


def test_a_run_in_several_parts_with_odd_names_is_replayed_as_one_with_its_configuration(tmp_path, world):
    config = Config.from_mapping({"keyframes.min_distance_m": 0.6, "solve.every_keyframes": 3, "frames.map": 'a"b\\'})
    recorder = RunRecorder(tmp_path / "run", config)
    slam = GraphSlam(config, recorder.sink)
    for k, m in enumerate(list(measurements(world))[:500]):
        if hasattr(m, "sightings"):
            odd = tuple(dataclasses.replace(s, id='a,"b"\nc' + s.id) for s in m.sightings)
            m = dataclasses.replace(m, sightings=odd)
        recorder.record(slam, slam.process(m))
        if k % 100 == 50:
            recorder.record(slam, slam.process(Control("flush")))
            recorder.record(slam, slam.process(Control("optimize")))
            recorder.save(slam)
    for event in ("flush", "optimize"):
        slam.process(Control(event))
    recorder.save(slam)
    assert len(parts_of(tmp_path / "run")) > 4
    assert run_config(tmp_path / "run") == config
    with (tmp_path / "run" / "landmarks.csv").open(newline="") as stream:
        assert [row[0] for row in csv.reader(stream)][1:] == list(slam.view.landmarks)
    replay(tmp_path / "run", tmp_path / "again")
    assert contents(tmp_path / "again") == contents(tmp_path / "run")
    assert run_config(tmp_path / "again") == config


def test_an_event_of_another_version_is_named_and_a_sequence_that_is_cut_is_told(tmp_path, folder):
    shutil.copytree(folder, tmp_path / "newer")
    ingest = tmp_path / "newer" / "ingest.mcap"
    records, whole = list(read_ingest(folder, [])), ingest.read_bytes()
    ingest.unlink()
    unknown = {"type": "control", "event": "dance", "values": []}
    writer = RecordWriter(ingest)
    writer.write([*records[:100], unknown, *records[100:]])
    writer.end().close()
    with pytest.raises(FormatError, match="'dance' is not one of"):
        replay(tmp_path / "newer", tmp_path / "again")
    ingest.write_bytes(whole[: len(whole) // 3])
    changed, cut = replay(tmp_path / "newer", tmp_path / "again", force=True).losses
    assert changed == "ingest.mcap is not the one that run.json was saved with"
    assert "ingest.mcap: cut off after" in cut


ODOMETRY = {"type": "odometry", "stamp_ns": 1, "T_odom_base": [0, 0, 0]}
SEEN = {"type": "sightings", "stamp_ns": 1, "topic": "/a"}


@each(
    "record, complaint",
    [
        ({"type": "sonar", "stamp_ns": 1}, "unknown kind of measurement 'sonar'"),
        ({"stamp_ns": 1}, "unknown kind of measurement None"),
        ({"type": "odometry", "stamp_ns": 1}, "odometry: .*T_odom_base"),
        (ODOMETRY | {"more": 1}, "odometry: .*more"),
        (SEEN, "sightings: 'sightings'"),
        (SEEN | {"sightings": [{"id": "a"}]}, "sightings: .*measured"),
        ({"type": "control", "event": "dance"}, "Control: 'dance' is not one of flush, end, optimize"),
        ({"type": "control", "event": "flush", "values": [["edge", 1]]}, "Control: flush has .* it needs no value"),
        ({"type": "control", "event": "remove", "values": [["vertex", 1]]}, "it needs edge .* or landmark"),
    ],
)
def test_a_record_of_another_shape_is_refused_by_field(record, complaint):
    with pytest.raises(FormatError, match=complaint):
        from_record(record)


def test_the_graph_file_reads_back_with_poses_first_and_stamps_beside_it(folder, run):
    file = read_g2o(folder / "graph.g2o")
    table = [line.split(",") for line in (folder / "graph_vertices.csv").read_text().splitlines()]
    assert table[0] == ["id", "vertex", "stamp_ns", "name"]
    keyframes = [row for row in table[1:] if row[1] == "keyframe"]
    assert [int(row[2]) for row in keyframes] == [k.stamp_ns for k in run.slam.view.keyframes]
    assert [int(row[0]) for row in table[1:]] == list(range(run.slam.view.graph.vertex_count))
    assert [row[3] for row in table[1 + len(keyframes) :]] == list(run.slam.view.landmarks)
    by_id = dict(zip(file.ids, range(len(file.ids)), strict=True))
    offset = file.graph.offset.values[[by_id[k] for k in range(len(keyframes))]]
    read = file.graph.initial.values[offset[:, None] + np.arange(3)]
    assert read == pytest.approx(run.slam.view.trajectory(), abs=1e-12)


def test_trajectories_have_a_line_for_each_keyframe_and_each_sighting(folder, run):
    path = read_tum(folder / "path.tum")
    assert path.poses[:, :2] == pytest.approx(run.slam.view.trajectory()[:, :2])
    stamps = [
        int(a) * 10**9 + int(b) for a, b in re.findall(r"^(\d+)\.(\d{9}) ", (folder / "path.tum").read_text(), re.M)
    ]
    assert stamps == [k.stamp_ns for k in run.slam.view.keyframes]
    for name, poses in (
        ("sightings.tum", run.slam.view.sighting_trajectory()),
        ("odometry.tum", run.slam.view.sighting_odometry()),
        ("path_odometry.tum", run.slam.view.keyframes.poses),
    ):
        assert read_tum(folder / name).poses[:, :2] == pytest.approx(poses[:, :2])


def test_the_table_of_landmarks_has_estimate_and_covariance(folder, run):
    rows = [line.split(",") for line in (folder / "landmarks.csv").read_text().splitlines()]
    spread = ["cov_xx", "cov_xy", "cov_xtheta", "cov_yy", "cov_ytheta", "cov_thetatheta"]
    assert rows[0] == ["id", "kind", "x", "y", "theta", "sightings", *spread]
    covariances = {name: covariance for name, _, covariance in results.landmark_estimates(run.slam.view)}
    assert [row[0] for row in rows[1:]] == list(run.slam.view.landmarks)
    for row in rows[1:]:
        landmark = run.slam.view.landmarks[row[0]]
        assert [float(v) for v in row[2:5]] == run.slam.view.solver.estimate([landmark.vertex])[0].tolist()
        assert int(row[5]) == landmark.sightings
        assert np.array(row[6:], float) == pytest.approx(covariances[row[0]][np.triu_indices(3)], rel=1e-8)


def test_the_recording_of_a_run_is_read_by_mcap_and_by_rosbags_and_its_last_path_is_the_saved_one(folder):
    types = {
        "/path": "nav_msgs/msg/Path",
        "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/landmarks": "visualization_msgs/msg/MarkerArray",
    }
    with (folder / "run.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        by_mcap = [(channel.topic, m.log_time, m.data) for _, channel, m in reader.iter_messages(log_time_order=False)]
    with AnyReader([folder / "run.mcap"]) as reader:
        by_rosbags = [(c.topic, t, bytes(raw)) for c, t, raw in reader.messages()]
        assert {c.topic: c.msgtype for c in reader.connections} == types
        path = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages() if c.topic == "/path"][-1]
    assert sorted(by_mcap) == sorted(by_rosbags)
    assert [t for _, t, _ in by_mcap] == sorted(t for _, t, _ in by_mcap)
    recorded = []
    for stamped in path.poses:
        stamp, p, q = stamped.header.stamp, stamped.pose.position, stamped.pose.orientation
        recorded.append(f"{stamp.sec}.{stamp.nanosec:09d} {p.x!r} {p.y!r} {p.z!r} {q.x!r} {q.y!r} {q.z!r} {q.w!r}")
    assert recorded == (folder / "path.tum").read_text().splitlines()


def test_the_recorded_transforms_lead_from_map_over_odom_to_the_recorded_pose(folder):
    store, poses, links = typestore(), {}, {}
    for m in open_bag(folder / "run.mcap").messages({"/pose", "/tf"}):
        if m.topic == "/pose":
            p = store.deserialize_cdr(m.cdr, "geometry_msgs/msg/PoseWithCovarianceStamped").pose.pose.position
            poses[m.log_ns] = (p.x, p.y)
        else:
            (t,) = store.deserialize_cdr(m.cdr, "tf2_msgs/msg/TFMessage").transforms
            at, turn = t.transform.translation, t.transform.rotation
            links[m.log_ns, t.header.frame_id, t.child_frame_id] = (at.x, at.y, 2 * np.arctan2(turn.z, turn.w))
    assert len(poses) > 50
    for stamp, at in poses.items():
        found = se2.compose(links[stamp, "map", "odom"], links[stamp, "odom", "base_link"])
        assert found[:2] == pytest.approx(at, abs=1e-9)


def test_a_folder_is_not_read_and_written_at_once(tmp_path, bag, folder):
    out = tmp_path / "run"
    shutil.copytree(folder, out)
    (tmp_path / "link").symlink_to(out)
    shutil.copy(bag, out / "run_5.mcap")
    before = contents(out, ALL)
    for source, target in ((out, out), (out, tmp_path / "link"), (out / "run_5.mcap", out)):
        with pytest.raises(RunError, match="cannot be read from and written to at once"):
            replay(source, target)
    assert contents(out, ALL) == before
    assert (out / "run_5.mcap").exists()


def test_a_run_in_space_leaves_positions_rotations_and_all_covariances(tmp_path):
    config = Config.from_mapping({"world.dimensions": 3})
    recorder = RunRecorder(tmp_path / "run", config)
    slam = GraphSlam(config, recorder.sink)
    flown = list(measurements(simulate("flight", 2, laps=1, beacons=4)))
    for m in [*flown[: len(flown) // 4], Control("end"), Control("optimize")]:
        recorder.record(slam, slam.process(m))
    recorder.save(slam)
    assert read_tum(tmp_path / "run" / "path.tum").poses == pytest.approx(slam.view.trajectory(), abs=1e-12)
    header, *rows = [line.split(",") for line in (tmp_path / "run" / "landmarks.csv").read_text().splitlines()]
    names = ["x", "y", "z", "rx", "ry", "rz"]
    pairs = [(i, j) for i in range(6) for j in range(i, 6)]
    assert header[:10] == ["id", "kind", "x", "y", "z", "qx", "qy", "qz", "qw", "sightings"]
    assert header[10:] == [f"cov_{names[i]}{names[j]}" for i, j in pairs]
    estimates = {name: (value, covariance) for name, value, covariance in results.landmark_estimates(slam.view)}
    assert {row[1] for row in rows} == {"pose", "point"}
    for row in rows:
        value, covariance = estimates[row[0]]
        size, dof = (7, 6) if row[1] == "pose" else (3, 3)
        assert tuple(map(float, row[2 : 2 + size])) == value
        assert row[2 + size : 9] == [""] * (7 - size)
        for word, (i, j) in zip(row[10:], pairs, strict=True):
            assert word == "" if j >= dof else float(word) == pytest.approx(covariance[i, j], rel=1e-8)
    replay(tmp_path / "run", tmp_path / "again")
    assert contents(tmp_path / "again") == contents(tmp_path / "run")
