"""The node, as a robot has it: real processes, a real ROS graph on this machine's loopback."""

import json
import os
import time

import numpy as np
import pytest
from live_nodes import ENVIRONMENT, graph_slam, node, replayed, results, until
from messages import record_drive
from places import executable

from graph_slam_ros.cli import main
from graph_slam_ros.node import player
from graph_slam_ros.recordings.bag import BagWriter, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag

ODOMETRY, DETECTIONS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
SEVERAL = {
    "inputs.names": "odom detections gps tags",
    "gps.topic": "/fix",
    "gps.type": "sensor_msgs/msg/NavSatFix",
    "tags.topic": "/tf",
    "tags.type": "tf2_msgs/msg/TFMessage",
    "tags.use": "landmarks",
    "tags.frame_prefix": "tag36h11",
}


WORLD = "warehouse", 6, {"aisles": 2, "laps": 1, "aisle_m": 4.0}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    name, seed, options = WORLD
    file = tmp_path_factory.mktemp("bag") / "drive.mcap"
    write_bag(simulate(name, seed, **options), file)
    return file


def surveyed(file):
    """Settings with a table of all landmarks, in the frame of a floor plan, and where the robot starts in it."""
    name, seed, options = WORLD
    landmarks = simulate(name, seed, **options).landmarks
    rows = [f"{name},{at[0] + 3.0},{at[1] - 2.0},0.5" for name, at in landmarks.items()]
    file.write_text("\n".join(["id,x,y,sigma", *rows]) + "\n")
    return {"landmarks.surveyed_file": str(file), "anchor.pose": "3 -2 0", "anchor.sigma_m": 1.0}


def flight(bag, file):
    write_bag(simulate("flight", 3, laps=1), whole := file.with_name("whole.mcap"))
    opened = open_bag(whole)
    messages = list(opened.messages(opened.topics))
    with BagWriter(file) as writer:
        for m in messages[: len(messages) // 5]:
            writer.write(m.topic, opened.topics[m.topic].type, m.log_ns, m.cdr)


def joints(bag, file):
    record_drive(file, seconds=3)


def garbled(bag, file):
    """As a bad network and a bad driver would deliver them: late, out of order, twice, broken; landmarks at 28 Hz."""
    rng, messages = np.random.default_rng(2), list(open_bag(bag).messages({"/odom", "/landmarks"}))
    messages = messages[: len(messages) // 4]
    delay = np.where(rng.random(len(messages)) < 0.1, rng.uniform(0.0, 0.3e9, len(messages)), 0.0)
    with BagWriter(file) as writer:
        for k in sorted(range(len(messages)), key=lambda k: messages[k].log_ns + delay[k]):
            m, chance = messages[k], rng.random()
            sent = [m.cdr, m.cdr] if chance < 0.05 else [m.cdr]
            if 0.05 <= chance < 0.1:
                sent.append(m.cdr[: rng.integers(4, len(m.cdr))])
            elif 0.1 <= chance < 0.15:
                broken = bytearray(m.cdr)
                for at in rng.integers(4, len(broken), 8):
                    broken[at] = rng.integers(256)
                sent.append(bytes(broken))
            for step in range(1, 5) if m.topic == "/landmarks" else ():
                stamp = m.log_ns + 3_000_000 * step
                sent.append(m.cdr[:4] + np.array([stamp // 10**9, stamp % 10**9], "<u4").tobytes() + m.cdr[12:])
            for cdr in sent:
                writer.write(m.topic, ODOMETRY if m.topic == "/odom" else DETECTIONS, m.log_ns, cdr)


@pytest.mark.parametrize(
    "record, settings",
    [(flight, {"world.dimensions": 3}), (joints, SEVERAL), (garbled, {})],
    ids=lambda one: getattr(one, "__name__", ""),
)
def test_a_recording_through_a_live_graph_is_saved_byte_for_byte_as_offline(record, settings, bag, tmp_path):
    record(bag, tmp_path / "drive.mcap")
    settings = settings or surveyed(tmp_path / "plan.csv")
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    replay(tmp_path / "drive.mcap", tmp_path / "offline", Config.from_mapping(settings))
    for trial in range(3):  # a machine that is very busy loses messages, and says so
        live = tmp_path / f"live_{trial}"
        done = graph_slam("replay", tmp_path / "drive.mcap", "--ros", "--out", live, *words)
        if "did not arrive" not in done.stderr:
            break
    assert done.returncode in ((0, 3) if record is garbled else (0,)), done.stderr
    assert record is garbled or " 0 lost; results in" in done.stdout
    assert results(live) == results(tmp_path / "offline") == replayed(live, tmp_path)
    assert results(live)["path.tum"].count(b"\n") > 10
    counters = (live / "run.json").read_text()
    assert '"node"' not in counters, "no message raised an error"
    if record is garbled:
        assert all(word in counters for word in ("late", "undecodable", "duplicate"))
        assert json.loads(counters)["classes"]["surveyed"]["edges"] > 3


def test_a_running_node_is_played_what_it_listens_to_at_a_rate(tmp_path):
    drive = record_drive(tmp_path / "drive.mcap", seconds=5)
    words = "inputs.names:=odom gps", "gps.type:=sensor_msgs/msg/NavSatFix", "gps.topic:=/fix", "inputs.tf:=false"
    run = f"output.folder:={tmp_path / 'run'}"
    with node(run, "inputs.reliable:=true", *words, by=[executable("graph_slam_node")]) as n:
        until(lambda: "kernels ready" in n.said, time.sleep, "node that is ready", 60.0)
        start = time.monotonic()
        done = graph_slam("replay", drive, "--ros", "--rate", 20)
        assert time.monotonic() - start > 5.0 / 20
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("56 messages sent, 0 lost"), "50 of odometry, 5 fixes, and what is fixed"
        assert f"results in {tmp_path / 'run'}" in done.stdout
        saved = results(tmp_path / "run")
        assert n.stop()[0] == 0
    assert results(tmp_path / "run") == saved


def test_without_a_node_or_where_its_own_does_not_start_the_player_says_so(bag, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("mine")
    done = graph_slam("replay", bag, "--ros", "--out", tmp_path)
    refused = f"graph_slam: {tmp_path}: not empty and not an earlier run; nothing was written\n"
    assert (done.returncode, done.stderr) == (2, refused)
    monkeypatch.setattr(player, "_PATIENCE_S", 0.5)
    monkeypatch.setattr(os, "environ", dict(ENVIRONMENT))
    assert main(["replay", str(bag), "--ros", "--node", "/nobody"]) == 2
    assert capsys.readouterr().err == "graph_slam: no /nobody/list_parameters: is the node running?\n"


def test_what_is_refused_at_the_start_ends_the_node_with_its_reason_and_code_2(tmp_path):
    mine = tmp_path / "foreign" / "file"
    mine.parent.mkdir()
    mine.write_text("mine")
    for word, complaint in (
        ("keyframes.min_distnce_m:=1.0", "unknown parameter 'keyframes.min_distnce_m'; did you mean"),
        ("frames.map:=3", "frames.map: 3 is not a text"),
        (f"output.folder:={mine.parent}", f"{mine.parent}: not empty and not an earlier run; nothing was written"),
        ("nonsense", "nonsense"),
    ):
        with node(word, cwd=tmp_path) as n:
            code, said = n.ended(30.0)
        assert code == 2, word
        assert complaint in said, word
        assert "Traceback" not in said, word
        assert said.count("\n") == 1 or word == "nonsense", said
    assert mine.read_text() == "mine"
