"""The node, as a robot has it: real processes, a real ROS graph on this machine's loopback."""

import itertools
import math
import os
import shutil
import signal
import time

import numpy as np
import pytest
from executables import executable
from live_nodes import ENVIRONMENT, completed, finish, graph_slam, lenient, node, replayed, results, robot, until
from messages import record_drive
from rclpy.qos import ReliabilityPolicy

from graph_slam_ros.cli import main
from graph_slam_ros.recordings.bag import BagWriter, open_bag
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Config
from graph_slam_ros.tools.simulation import simulate, write_bag
from graph_slam_ros.warmup import warmup

INSTALLED = [executable("graph_slam_node")]


@pytest.fixture(scope="module", autouse=True)
def kernels():
    """Compiled before the first node starts, so that no patience is spent on it."""
    warmup()


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    file = tmp_path_factory.mktemp("bag") / "drive.mcap"
    write_bag(simulate("warehouse", 6, aisles=2, laps=1, aisle_m=4.0), file)
    return file


@pytest.fixture(scope="module")
def offline(bag, tmp_path_factory):
    folder = tmp_path_factory.mktemp("offline") / "run"
    replay(bag, folder)
    return folder


@pytest.fixture(scope="module")
def messages(bag):
    return list(open_bag(bag).messages({"/odom", "/landmarks"}))


# -- live equals replay ---------------------------------------------------------------------------------------------


def test_a_recording_through_a_live_graph_is_saved_byte_for_byte_as_offline(bag, offline, tmp_path):
    done = graph_slam("replay", bag, "--ros", "--out", tmp_path / "123")
    assert done.returncode == 0, done.stderr
    assert " 0 lost; results in" in done.stdout
    assert results(tmp_path / "123") == results(offline)
    assert replayed(tmp_path / "123", tmp_path) == results(offline)


def test_a_flight_in_space_is_saved_byte_for_byte_as_offline(tmp_path):
    flight, space = tmp_path / "flight.mcap", Config.from_mapping({"world.dimensions": 3})
    write_bag(simulate("flight", 3, laps=1), flight)
    replay(flight, tmp_path / "offline", space)
    done = graph_slam("replay", flight, "--ros", "--out", tmp_path / "live", "--set", "world.dimensions=3")
    assert done.returncode == 0, done.stderr
    assert results(tmp_path / "live") == results(tmp_path / "offline")
    assert results(tmp_path / "live")["path.tum"].count(b"\n") > 100


def test_live_equals_offline_when_landmarks_come_faster_than_odometry(bag, messages, tmp_path):
    """Each message of landmarks is repeated 5 times, 3 ms apart: 28 Hz beside an odometry of 10 Hz."""
    fast = tmp_path / "fast.mcap"
    with BagWriter(fast) as writer:
        for k, m in enumerate(messages[: len(messages) // 2]):
            if m.topic == "/odom" and k % 5 == 0:
                writer.write("/odom", "nav_msgs/msg/Odometry", m.log_ns, m.cdr)
            for step in range(5 if m.topic == "/landmarks" else 0):
                stamp = m.log_ns + 3_000_000 * step
                head = np.array([stamp // 10**9, stamp % 10**9], dtype="<u4").tobytes()
                cdr = m.cdr[:4] + head + m.cdr[12:]
                writer.write("/landmarks", "vision_msgs/msg/Detection3DArray", stamp, cdr)
    replay(fast, tmp_path / "offline")
    done = graph_slam("replay", fast, "--ros", "--out", tmp_path / "live")
    assert done.returncode == 0, done.stderr
    assert results(tmp_path / "live") == results(tmp_path / "offline")


def garbled(messages, seed=1):
    """As a bad network and a bad driver would deliver them: late, out of order, twice, broken."""
    rng = np.random.default_rng(seed)
    delay = np.where(rng.random(len(messages)) < 0.1, rng.uniform(0.0, 0.3e9, len(messages)), 0.0)
    for k in sorted(range(len(messages)), key=lambda k: messages[k].log_ns + delay[k]):
        m = messages[k]
        yield m
        chance = rng.random()
        if chance < 0.05:
            yield m
        elif chance < 0.1:
            at = int(rng.integers(4, len(m.cdr)))
            yield type(m)(m.topic, m.log_ns, m.cdr[:at])
        elif chance < 0.15:
            broken = bytearray(m.cdr)
            for at in rng.integers(4, len(broken), 8):
                broken[at] = rng.integers(256)
            yield type(m)(m.topic, m.log_ns, bytes(broken))


def test_whatever_came_replay_of_the_nodes_own_sequence_equals_what_it_saved(messages, offline, tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot() as r:
        r.wait_for_node()
        for half in (messages[: len(messages) // 2], messages[len(messages) // 2 :]):
            r.drive(garbled(half))
            assert r.save().success
        finish(n, r)
    counters = (tmp_path / "run" / "run.json").read_text()
    assert all(word in counters for word in ("late", "undecodable", "duplicate"))
    assert '"node"' not in counters, "no message raised an error"
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")
    assert results(tmp_path / "run") != results(offline)


def test_a_recording_with_late_and_broken_messages_is_the_same_live_and_offline(messages, tmp_path):
    file = tmp_path / "garbled.mcap"
    types = {"/odom": "nav_msgs/msg/Odometry", "/landmarks": "vision_msgs/msg/Detection3DArray"}
    with BagWriter(file) as writer:
        for m in garbled(messages[: len(messages) // 2], seed=2):
            writer.write(m.topic, types[m.topic], m.log_ns, m.cdr)
    replay(file, tmp_path / "offline")
    done = graph_slam("replay", file, "--ros", "--out", tmp_path / "live")
    assert done.returncode == 0, done.stderr
    assert results(tmp_path / "live") == results(tmp_path / "offline")


def test_several_inputs_and_a_sensor_on_a_joint_are_saved_byte_for_byte_as_offline(tmp_path):
    drive = record_drive(tmp_path / "drive.mcap", seconds=5)
    inputs = {
        "inputs.names": "odom detections gps tags",
        "gps.topic": "/fix",
        "gps.type": "sensor_msgs/msg/NavSatFix",
        "tags.topic": "/tf",
        "tags.type": "tf2_msgs/msg/TFMessage",
        "tags.use": "landmarks",
        "tags.frame_prefix": "tag36h11",
    }
    settings = [word for key, value in inputs.items() for word in ("--set", f"{key}={value}")]
    assert graph_slam("replay", drive, "--out", tmp_path / "offline", *settings).returncode == 0
    done = graph_slam("replay", drive, "--ros", "--out", tmp_path / "live", *settings)
    assert done.returncode == 0, done.stderr
    assert " 0 lost; results in" in done.stdout
    assert results(tmp_path / "live") == results(tmp_path / "offline")
    assert replayed(tmp_path / "live", tmp_path) == results(tmp_path / "live")


def test_a_running_node_is_played_what_it_listens_to(tmp_path):
    drive = record_drive(tmp_path / "drive.mcap", seconds=5)
    words = ("inputs.names:=odom gps", "gps.type:=sensor_msgs/msg/NavSatFix", "gps.topic:=/fix", "inputs.tf:=false")
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", *words) as n:
        done = graph_slam("replay", drive, "--ros")
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("56 messages sent, 0 lost"), "50 of odometry, 5 fixes, and what is fixed"
        assert n.stop()[0] == 0


def test_a_node_with_an_input_of_a_package_that_is_not_installed_says_so(tmp_path):
    words = ("inputs.names:=odom tags", "tags.type:=apriltag_msgs/msg/AprilTagDetectionArray", "output.folder:=''")
    with node(*words) as n:
        code, said = n.ended(60.0)
    assert code == 2
    assert "apriltag_msgs is not installed here" in said


def test_a_recording_is_played_into_a_node_that_runs_already(bag, offline, tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", by=INSTALLED) as n:
        done = graph_slam("replay", bag, "--ros")
        assert done.returncode == 0, done.stderr
        assert f" 0 lost; results in {tmp_path / 'run'}" in done.stdout
        assert results(tmp_path / "run") == results(offline)
        assert n.stop()[0] == 0
    assert results(tmp_path / "run") == results(offline)


def test_playing_at_a_rate_takes_its_time(bag, messages, tmp_path):
    span_s = (messages[-1].log_ns - messages[0].log_ns) * 1e-9
    start = time.monotonic()
    done = graph_slam("replay", bag, "--ros", "--rate", 20, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - start > span_s / 20


def test_without_a_node_the_player_says_so(bag, monkeypatch, capsys):
    from graph_slam_ros.node import player

    monkeypatch.setattr(player, "_PATIENCE_S", 0.5)
    monkeypatch.setattr(os, "environ", dict(ENVIRONMENT))
    assert main(["replay", str(bag), "--ros", "--node", "/nobody"]) == 2
    assert capsys.readouterr().err == "graph_slam: no parameters of /nobody: is the node running?\n"


# -- what the node publishes ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session(messages, tmp_path_factory):
    """One run of a node with all that was heard of it, and a listener that came late."""
    folder = tmp_path_factory.mktemp("session") / "run"
    parameters = (f"output.folder:={folder}", "inputs.reliable:=true", "tf.transform_publish_period:=0.01")
    with node(*parameters) as n, robot() as r:
        r.wait_for_node()
        for _ in range(20):
            r.spin(0.02)
        before = {topic: len(heard) for topic, heard in r.heard.items()}
        r.drive(messages, every=3)
        until(lambda: len(r.heard["landmarks"]) > 1 and r.heard["tf"], r.spin, "landmarks and transforms")
        on_the_way = list(r.heard["landmarks"])
        for _ in range(2):  # what was still on its way when the first was asked for is in the second
            saved = r.save()
            for _ in range(20):
                r.spin(0.02)
        with robot(name="late_joiner") as late:
            until(lambda: all(late.heard[t] for t in ("path", "pose", "landmarks")), late.spin, "latched message")
            late_heard = dict(late.heard)
        for topic in ("path", "pose", "landmarks"):  # on a busy machine the last ones may still be on their way
            until(lambda t=topic: r.heard[t][-1] == late_heard[t][-1], r.spin, f"last {topic}")
        stopped = n.stop()
    return {
        "heard": r.heard,
        "before": before,
        "on_the_way": on_the_way,
        "late": late_heard,
        "saved": saved,
        "stopped": stopped,
        "folder": folder,
    }


def test_nothing_is_published_before_the_first_odometry(session):
    assert session["before"] == {"path": 0, "pose": 0, "landmarks": 0, "tf": 0}


def test_save_answers_with_the_folder_and_the_node_ends_in_time(session):
    assert (session["saved"].success, session["saved"].message) == (True, str(session["folder"]))
    code, took_s = session["stopped"]
    assert code == 0
    assert took_s < lenient(3.0)


def test_the_last_published_path_is_the_saved_one(session):
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in session["heard"]["path"][-1].poses]
    points = [(p.pose.position.x, p.pose.position.y) for p in session["heard"]["path"][-1].poses]
    saved = [line.split() for line in (session["folder"] / "path.tum").read_text().splitlines()]
    assert stamps == [int(line[0].replace(".", "")) for line in saved]
    assert points == [(float(line[1]), float(line[2])) for line in saved]


def test_who_joins_late_gets_the_last_path_pose_and_landmarks(session):
    for topic in ("path", "pose", "landmarks"):
        assert session["late"][topic] == [session["heard"][topic][-1]], topic
    names = {m.text for m in session["late"]["landmarks"][0].markers if m.text}
    table = (session["folder"] / "landmarks.csv").read_text().splitlines()[1:]
    assert names == {line.split(",")[0] for line in table}


def test_landmarks_come_on_the_way_about_every_20_keyframes(session):
    saved = [line.split()[0] for line in (session["folder"] / "path.tum").read_text().splitlines()]
    stamps = [m.markers[0].header.stamp for m in session["on_the_way"]]
    at = [saved.index(f"{stamp.sec}.{stamp.nanosec:09d}") for stamp in stamps]
    assert at == sorted(at)
    assert 1 < len(set(at)) <= 2 + len(saved) / 20
    known = [sum(bool(m.text) for m in message.markers) for message in session["on_the_way"]]
    assert known == sorted(known), "at first perhaps that there are none"
    assert known[-1] > 0


def test_transforms_lead_from_map_to_odom_at_stamps_that_strictly_increase(session):
    sent = [t for m in session["heard"]["tf"] for t in m.transforms]
    assert len(sent) > 3
    assert {(t.header.frame_id, t.child_frame_id) for t in sent} == {("map", "odom")}
    stamps = [t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in sent]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    for t in sent:
        q = t.transform.rotation
        assert math.hypot(q.x, q.y, q.z, q.w) == pytest.approx(1.0)


def test_transforms_are_dated_ahead_of_the_odometry_by_the_tolerance(session, messages):
    stamps = {m.log_ns for m in messages if m.topic == "/odom"}
    for t in (t for m in session["heard"]["tf"] for t in m.transforms):
        assert t.header.stamp.sec * 10**9 + t.header.stamp.nanosec - 100_000_000 in stamps


def test_poses_come_for_every_keyframe_with_a_covariance_that_is_one(session):
    heard = session["heard"]["pose"]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in heard]
    assert stamps == sorted(stamps)  # a solve between two keyframes sends the newest again, corrected
    assert len(set(stamps)) > 10
    for m in heard:
        full = np.reshape(m.pose.covariance, (6, 6))
        assert np.linalg.eigvalsh(full)[0] > 0.0
        assert full == pytest.approx(full.T)


# -- connections ----------------------------------------------------------------------------------------------------


def test_reliable_and_best_effort_publishers_both_connect_by_default(messages, tmp_path):
    some = iter(messages)
    with node(f"output.folder:={tmp_path / 'run'}") as n:
        for reliability in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
            with robot(reliability=reliability, name=reliability.name.lower()) as r:
                r.wait_for_node()
                r.spin(0.1)
                latched = len(r.heard["path"])
                until(
                    lambda r=r, n=latched: len(r.heard["path"]) > n + 1,
                    lambda s, r=r: (r.drive([next(some)]), r.spin(s)),
                    f"path from a {reliability.name} publisher",
                )
        assert n.stop()[0] == 0


def test_garbage_does_not_end_the_node(messages, tmp_path):
    rng = np.random.default_rng(3)
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot() as r:
        r.wait_for_node()
        for size in (4, 5, 8, 12, 40, 700, 4000):
            for topic in ("/odom", "/landmarks"):
                r.send(topic, b"\x00\x01\x00\x00" + rng.bytes(size))
        r.drive(messages[:400])
        until(lambda: r.heard["path"], r.spin, "path after garbage")
        assert r.save().success
        assert n.is_alive
        finish(n, r)
    assert "Traceback" not in n.said
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


# -- start and stop -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_the_run_and_ends_the_node_with_0_within_3_seconds(messages, tmp_path, number):
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", by=INSTALLED) as n,
        robot() as r,
    ):
        r.wait_for_node()
        r.drive(messages[:600])
        until(lambda: r.heard["path"], r.spin, "path")
        code, took_s = n.stop(number)
    assert code == 0
    assert took_s < lenient(3.0)
    assert "Traceback" not in n.said
    run = completed(tmp_path / "run", n.said)
    assert replayed(run, tmp_path) == results(run)


def test_a_node_without_output_folder_runs_and_refuses_to_save(messages, tmp_path):
    with node("output.folder:=''", "inputs.reliable:=true", cwd=tmp_path) as n, robot() as r:
        r.wait_for_node()
        r.drive(messages[:200])
        until(lambda: r.heard["path"], r.spin, "path")
        answer = r.save()
        assert (answer.success, answer.message) == (False, "output.folder is empty: nowhere to save")
        assert n.stop()[0] == 0
    assert list(tmp_path.iterdir()) == []


def test_a_save_that_fails_is_answered_and_the_node_goes_on(messages, tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot() as r:
        r.wait_for_node()
        r.drive(messages[:200])
        until(lambda: r.heard["path"], r.spin, "path")
        shutil.rmtree(tmp_path / "run")
        answer = r.save()
        assert not answer.success
        assert "run" in answer.message
        assert n.is_alive
        (tmp_path / "run").mkdir()
        assert r.save().success
        assert n.stop()[0] == 0


def test_a_node_that_got_nothing_may_start_again_in_its_folder_with_whole_numbers_for_float_parameters(tmp_path):
    for distance in (1, 2):
        folder = f"output.folder:={tmp_path / 'run'}"
        with node(folder, f"keyframes.min_distance_m:={distance}") as n, robot() as r:
            r.wait_for_node()
            assert n.stop()[0] == 0
        assert f"min_distance_m: {distance}.0" in (tmp_path / "run" / "config.yaml").read_text()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_during_start_shows_no_traceback(tmp_path, number):
    with node(f"output.folder:={tmp_path / 'run'}", by=INSTALLED) as n:
        until(lambda: (tmp_path / "run").exists(), time.sleep, "start")
        assert n.stop(number)[0] == 0
    assert "Traceback" not in n.said


@pytest.mark.parametrize(
    "parameter, complaint",
    [
        ("keyframes.min_distnce_m:=1.0", "unknown parameter 'keyframes.min_distnce_m'; did you mean"),
        ("keyframes.min_distance_m:=-1.0", "keyframes.min_distance_m: -1.0 is not in [0.001, 1e+09]"),
        ("frames.map:=3", "frames.map: 3 is not a text"),
        ("output.folder:={foreign}", "{foreign}: not empty and not an earlier run; nothing was written"),
        ("output.folder:={foreign}/file/run", "{foreign}/file/run: Not a directory"),
    ],
)
def test_a_parameter_that_is_refused_ends_the_node_with_one_line_and_code_2(tmp_path, parameter, complaint):
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "file").write_text("mine")
    names = {"foreign": tmp_path / "foreign"}
    with node(parameter.format(**names), cwd=tmp_path) as n:
        code, said = n.ended()
    assert code == 2
    assert said.count("\n") == 1
    assert complaint.format(**names) in said
    assert (tmp_path / "foreign" / "file").read_text() == "mine"


def test_ros_arguments_that_cannot_be_read_are_refused_without_a_traceback(tmp_path):
    with node("nonsense", cwd=tmp_path) as n:
        code, said = n.ended()
    assert code == 2
    assert "Traceback" not in said
    assert "nonsense" in said


def test_the_player_tells_why_its_own_node_did_not_start(bag, tmp_path):
    (tmp_path / "file").write_text("mine")
    done = graph_slam("replay", bag, "--ros", "--out", tmp_path)
    assert done.returncode == 2
    assert done.stderr == f"graph_slam: {tmp_path}: not empty and not an earlier run; nothing was written\n"
