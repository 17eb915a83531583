"""The node as others handle it: transitions, signals, parameters, services; in turn, out of turn, at any moment."""

import functools
import math
import random
import shutil
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from live_drive import TAGS, Drive, earlier_run
from live_nodes import ENVIRONMENT, MODULE, finish, node, numbers, often, replayed, results, robot, server, until
from messages import detection, detections, pose, posed, quaternion
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter as RosParameter
from reliability import tell
from std_msgs.msg import String
from vision_msgs.msg import Detection3DArray

from graph_slam_ros.config.config import parameters
from graph_slam_ros.measurements.types import from_record
from graph_slam_ros.node import bond
from graph_slam_ros.runs.folder import check_room, is_cut_off, is_incomplete
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.slam import Control

SERVICES = "save", "load", "reset", "pause", "resume", "optimize", "clear_closures"


def accepted(folder):
    """The ingest sequence of a run."""
    return [from_record(record) for record in read_ingest(folder, [])]


def is_repeated(run, tmp_path):
    """Whether replay of a run gives its bytes."""
    place = tmp_path / f"of_{run.name}"
    place.mkdir()
    return replayed(run, place) == results(run)


TURNS = {"unconfigured": ("configure",), "inactive": ("activate", "cleanup"), "active": ("deactivate",)}
NUMBERS = {
    name: getattr(Transition, f"TRANSITION_{name.upper()}")
    for name in ("configure", "activate", "deactivate", "cleanup")
}
NUMBERS |= {"dance": 99, "": 0}


def managed(folder, *parameters):
    """A node that waits for its transitions."""
    return node(f"output.folder:={folder}", "inputs.reliable:=true", "node.autostart:=false", *parameters)


def weight(process):
    """(resident memory in MiB, open files, threads) of a process."""
    of = Path("/proc") / str(process.pid)
    status = dict(line.split(":", 1) for line in (of / "status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]) / 1024.0, len(list((of / "fd").iterdir())), int(status["Threads"])


def test_P13_P16_P22_of_a_managed_node_transitions_out_of_turn_are_refused_and_a_life_of_many_leaves_nothing(tmp_path):
    lives, warm = often(2), 2
    with managed(tmp_path / "run") as n, robot(hears=("pose", "path", "/tf", "/diagnostics")) as r:
        for name in SERVICES:
            answer = r.call(name)
            assert (answer.success, answer.message) == (False, "not configured: the node is unconfigured"), name
        for kind in (0, 42, 255):
            nothing = [Parameter(name="tf.publish_tf", value=ParameterValue(type=kind))]
            request = SetParametersAtomically.Request(parameters=nothing)
            assert not r.call("set_parameters_atomically", SetParametersAtomically, request).result.successful
            answer = r.call("set_parameters", SetParameters, SetParameters.Request(parameters=nothing))
            assert not any(one.successful for one in answer.results)
        for name, value in (("output.folder", str(tmp_path / "elsewhere")), ("inputs.names", "odom")):
            done, why = r.set({"frames.map": "world", name: value})
            assert (done, name in why) == (False, True), why
        given = {"frames.map": "world", "tf.max_speed_m_s": 2}
        assert r.set(given) == (True, ""), "a whole number is a number"
        unchanged = {"output.folder": str(tmp_path / "run"), "tf.publish_tf": True}
        assert r.get([*given, *unchanged]) == {**given, **unchanged}

        for k, (state, to) in enumerate(TURNS.items()):
            assert r.state() == state
            for wanted, number in NUMBERS.items():
                assert wanted in to or not r.change(number if k % 2 else wanted), (state, wanted)
            answer = r.call("clear_closures")
            assert answer.success == (state != "unconfigured"), (state, answer.message)
            assert r.change(to[0])
        assert r.change("cleanup")

        drive, weights = Drive(), []
        for _ in range(warm + lives):
            assert r.change("configure")
            assert r.change("activate")
            r.heard["pose"].clear()
            until(lambda: len(r.heard["pose"]) > 3, drive.pace(r), "poses")
            assert r.heard["pose"][0].header.frame_id == "world"
            assert r.change("deactivate")
            drive.go(r, 3)
            assert r.change("cleanup")
            if weights:  # a thread that was told to end may take a moment for it
                until(lambda: weight(n.process)[2] <= weights[0][2], r.spin, "the end of a thread")
            weights.append(weight(n.process))
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said
    assert bond.is_installed() or bond.MISSING in n.said
    memory, files, _ = zip(*weights[warm:], strict=True)
    assert memory[-1] - memory[0] < 5.0 + 0.05 * lives, memory
    assert max(files) <= files[0], files
    names = {run.name.partition("-")[0] for run in tmp_path.iterdir()}
    assert (names, len(list(tmp_path.iterdir()))) == ({"run"}, 1 + min(5, warm + lives)), "nothing elsewhere, five kept"


def test_what_cannot_be_configured_activated_or_saved_leaves_nothing_and_can_be_once_it_is_mended(tmp_path):
    run, other = tmp_path / "run", "apriltag_msgs/msg/AprilTagDetectionArray"
    run.mkdir()
    (run / "letter").write_text("mine")
    with managed(run) as n, robot(hears=("pose", "/diagnostics")) as r:

        def fails(transition, why):
            assert not r.change(transition)
            assert r.state() == "unconfigured"
            until(lambda: why in n.said, r.spin, why)

        def drives():
            assert r.change("configure")
            assert r.change("activate")
            r.heard["pose"].clear()
            until(lambda: r.heard["pose"], Drive().pace(r), "pose")

        fails("configure", "not empty and not an earlier run; nothing was written")
        (run / "letter").unlink()
        assert r.set({"detections.type": other}) == (True, "")
        fails("configure", "apriltag_msgs is not installed here")
        assert r.set({"detections.type": "vision_msgs/msg/Detection3DArray", "odom.topic": "not a/topic"}) == (True, "")
        weights = []
        for _ in range(5):
            assert r.change("configure")
            fails("activate", "")
            weights.append(weight(n.process)[1:])
        assert weights[-1] <= max(weights[:4]), "open files and threads"
        assert r.set({"odom.topic": "odom"}) == (True, ""), "it is unconfigured"
        drives()
        shutil.rmtree(run)
        run.write_text("in its place")
        assert r.change("deactivate")
        fails("cleanup", f"{run}: Not a directory")
        run.unlink()
        drives()
        assert r.change("shutdown"), "from whatever state"
        assert numbers(run)["keyframes"] > 0
        r.until_it_says("FINALIZED")
        assert not r.change("configure") and not r.call("save").success
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said


SIGNALS = signal.SIGINT, signal.SIGTERM
MEANWHILE = "", "save", "optimize", "reset", "clear_closures"


@pytest.mark.parametrize("seed", range(often(1)))
def test_P6_told_to_stop_at_any_moment_of_a_drive_it_saves_what_it_has_and_ends_with_0(tmp_path, seed):
    rng, meanwhile = random.Random(seed), MEANWHILE[(seed + 2) % len(MEANWHILE)]
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=("pose",)) as r:
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        drive.go(r, rng.randrange(5, 200), every=3)
        if meanwhile:
            r.ask(meanwhile)
        r.spin(rng.choice((0.0, 0.01, 0.03)))
        n.process.send_signal(SIGNALS[seed % 2])
        until(lambda: not n.is_alive, lambda s: (drive.step(r), r.spin(s / 4)), "end")
        code, said = n.ended()
    assert code == 0, said
    assert "Traceback" not in said
    for run in list(tmp_path.glob("run*")):
        whole = not is_incomplete(run) or "completes the results" not in said
        assert not accepted(run) or not whole or is_repeated(run, tmp_path), (run.name, meanwhile)


def hears_signals(process):
    """Whether SIGTERM is caught: Python does that only where it is told to."""
    status = dict(line.split(":", 1) for line in (Path("/proc") / str(process.pid) / "status").read_text().splitlines())
    return bool(int(status["SigCgt"], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize("seed", range(often(1)))
def test_P6_told_to_stop_at_any_moment_of_its_start_it_ends_with_0_and_may_begin_again(tmp_path, seed):
    rng = random.Random(seed)
    with node(f"output.folder:={tmp_path / 'run'}", by=MODULE) as n:
        until(lambda: hears_signals(n.process), time.sleep, "handler of signals")
        time.sleep(rng.uniform(0.0, 1.2))
        code, _ = n.stop(SIGNALS[seed % 2])
    assert code == 0, n.said
    assert "Traceback" not in n.said
    check_room(tmp_path / "run", force=True)


def test_P6_while_kernels_are_compiled_the_node_answers_says_how_far_it_is_and_ends_when_it_is_told(
    tmp_path, monkeypatch
):
    server()  # with the usual cache
    monkeypatch.setitem(ENVIRONMENT, "GRAPH_SLAM_CACHE", str(tmp_path / "cache"))
    with managed(tmp_path / "run") as n, robot(hears=("/diagnostics",)) as r:
        until(r.client("change_state", ChangeState).service_is_ready, r.spin, "service", 30.0)
        assert r.change("configure")
        r.until_it_says("INACTIVE", "compiling kernels, once per installation: ", " %")
        assert r.change("activate")
        assert r.get(["output.keep_earlier"]) == {"output.keep_earlier": 5}
        Drive().go(r, 30)
        r.until_it_says("WAITING", "compiling kernels")
        assert n.stop(signal.SIGTERM)[0] == 0, n.said
    assert "stopped before all kernels were compiled" in n.said
    assert not any(word in n.said for word in ("FATAL", "ERROR", "Traceback"))
    assert len(accepted(tmp_path / "run")) > 30, "what came meanwhile is in the journal"


def test_P6_told_to_stop_while_a_long_run_is_loaded_it_does_not_wait_for_it(tmp_path):
    earlier_run(tmp_path / "life", steps := 5_000)  # without its map: the drive is repeated, which takes long
    parameters = f"output.folder:={tmp_path / 'run'}", "output.load:=life", "output.load_at_start:=true"
    with node(*parameters) as n, robot(hears=("/diagnostics",)) as r:
        until(lambda: "kernels ready" in n.said, r.spin, "configured node", 120.0)
        assert n.stop()[0] == 0, n.said
    assert "Traceback" not in n.said
    assert len(accepted(tmp_path / "life")) == steps + steps // 20
    assert not accepted(tmp_path / "run")


RESUMED = "goes on by odometry alone since the restart, nothing recognised yet"


def transform(r):
    """The last ``map -> odom``, (x, y, yaw)."""
    found = r.heard["tf"][-1].transforms[0].transform
    return found.translation.x, found.translation.y, 2.0 * math.atan2(found.rotation.z, found.rotation.w)


def killed_in_mid_drive(folder, drive):
    """A node drives, sees, and is killed; returns the stamps of its path and its last ``map -> odom``."""
    with node(f"output.folder:={folder}", "inputs.reliable:=true") as n, robot(hears=("/tf", "path", "pose")) as r:
        r.wait_for_node()
        drive.go(r, 100, every=3)
        r.settle()
        r.heard["tf"].clear()
        drive.step(r)
        until(lambda: r.heard["tf"], r.spin, "transform of the newest estimate")
        r.settle()
        stamps = [pose.header.stamp for pose in r.heard["path"][-1].poses]
        before = transform(r)
    assert n.process.returncode == -signal.SIGKILL
    assert is_cut_off(folder)
    return stamps, before


def test_P2_P12_killed_it_goes_on_where_it_was_if_odometry_goes_on_else_once_a_landmark_is_recognised(tmp_path):
    run, drive = tmp_path / "run", Drive()
    known, before = killed_in_mid_drive(run, drive)
    parameters, hears = (
        (f"output.folder:={run}", "inputs.reliable:=true"),
        ("pose", "/tf", "path", "odometry", "landmarks"),
    )
    with node(*parameters) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive.sees = False
        drive.stamp_ns += 10**9
        until(lambda: r.heard["tf"] and r.heard["pose"], drive.pace(r), "transform without any landmark")
        assert transform(r) == pytest.approx(before, abs=0.1), "as it was"
        assert r.heard["pose"][-1].pose.covariance[0] > 10.0, "as far as odometry can be trusted over a restart"
        r.until_it_says("DEGRADED", RESUMED, "drive past known landmarks", spin=drive.pace(r))
        until(lambda: r.heard["path"], drive.pace(r), "path")
        stamps = [pose.header.stamp for pose in r.heard["path"][-1].poses]
        assert stamps[: len(known)] == known, "what was published before is there"
        assert {m.text for m in r.heard["landmarks"][-1].markers if m.text} == set(TAGS)
        drive.sees = True
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: drive.off_by(r) < 0.5, drive.pace(r), "the pose of now")
    assert "the last run was never ended: going on in its map" in n.said
    assert n.process.returncode == -signal.SIGKILL
    with node(*parameters) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive.sees = False
        drive.stamp_ns += 10**9
        drive.odom = (0.0, 0.0, 0.0)
        unknown = "where the robot is in the loaded map is not known yet"
        r.until_it_says("DEGRADED", unknown, spin=drive.pace(r))
        drive.go(r, 20, every=2)
        r.settle()
        assert not (r.heard["pose"] or r.heard["tf"] or r.heard["odometry"])
        drive.sees = True
        until(lambda: r.heard["pose"] and r.heard["tf"], drive.pace(r), "place in the map")
        until(lambda: drive.off_by(r) < 0.5, drive.pace(r), "the pose of now")
        finish(n, r)
    assert is_repeated(run, tmp_path)
    assert not is_cut_off(run)


LIVE = [p for p in parameters() if p.live]
HOSTILE = (  # name, value, what the refusal says besides the name
    ("tf.publish_t", True, "did you mean 'tf.publish_tf'?"),
    ("tf.publish_tf", [1.0, 2.0], "is not"),
    ("tf.publish_tf", [b"\x00"], "is not"),
    ("tf.max_speed_m_s", "0.1", "is not a number"),
    ("tf.max_speed_m_s", True, "is not a number"),
    ("tf.max_speed_m_s", -1.0, "is not in ["),
    ("tf.max_speed_m_s", math.nan, "is not finite"),
    ("tf.max_speed_m_s", math.inf, "is not finite"),
    ("output.folder", "/elsewhere", "can be changed only at the start of the node"),
    ("frames.odom", "wheels", "can be changed only before the node is configured"),
)


def test_P15_of_parameters_that_are_set_together_all_or_none_change_and_the_run_repeats_with_them(tmp_path):
    good = {"tf.max_speed_m_s": 2.5, "solve.every_keyframes": 3, "keyframes.min_distance_m": 0.3}
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n,
        robot(hears=("pose", "/diagnostics")) as r,
    ):
        r.wait_for_node()
        drive, now = Drive(), {p.name: p.default for p in LIVE}
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        for culprit, value, why in HOSTILE:
            done, reason = r.set(good | {culprit: value})
            assert not done and culprit in reason and why in reason, (culprit, value, reason)
        assert r.get(now) == now
        assert r.set(good) == (True, "")
        assert r.get(now) == now | good
        drive.go(r, 20, every=2)
        assert r.set({"tf.max_speed_m_s": 3.0, "output.folder": "/elsewhere"}, together=False)[0] == (True, "")
        assert r.get(["tf.max_speed_m_s"]) == {"tf.max_speed_m_s": 3.0}, "one by one"
        r.until_it_says("OK", spin=drive.pace(r))
        finish(n, r)
    assert "Traceback" not in n.said
    assert [m.event for m in accepted(tmp_path / "run") if isinstance(m, Control)].count("set") > 1
    assert is_repeated(tmp_path / "run", tmp_path)


def test_X9_paused_it_takes_nothing_and_reset_saves_first_and_keeps_the_last_of_what_it_saved(tmp_path):
    given = f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", "output.keep_earlier:=1"
    with node(*given) as n, robot(hears=("pose", "/tf", "/diagnostics")) as r:
        r.wait_for_node()
        drive = Drive()
        for _ in range(2):
            r.heard["pose"].clear()
            until(lambda: len(r.heard["pose"]) > 3, drive.pace(r), "poses")
            answer = r.call("reset")
            assert (answer.success, answer.message) == (True, str(tmp_path / "run"))
        r.heard["pose"].clear()
        until(lambda: r.heard["pose"] and r.heard["tf"], drive.pace(r), "pose and transform")
        r.settle()
        assert r.call("pause").message == "paused"
        r.until_it_says("DEGRADED", "paused")
        before = r.graph()["keyframes"]
        r.heard["tf"].clear()
        drive.go(r, 30, every=2)
        until(lambda: len(r.heard["tf"]) > 5, drive.pace(r), "transforms: odometry goes on")
        r.until_it_says("DEGRADED", "paused", spin=drive.pace(r))
        assert r.graph()["keyframes"] == before
        assert r.call("resume").message == "takes measurements"
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: r.graph()["keyframes"] > before, drive.pace(r), "keyframes")
        assert r.graph()["segments"] == 1, "odometry of later tells what was missed"
        finish(n, r)
    counted = numbers(tmp_path / "run")["counters"]
    assert counted["odom"]["paused"] > 30
    assert counted["detections"]["paused"] > 10
    assert is_repeated(tmp_path / "run", tmp_path)
    (kept,) = tmp_path.glob("run-*")
    assert kept.name == "run-2"
    assert numbers(kept)["keyframes"] > 3


def test_closures_bend_the_path_until_they_are_cleared_and_optimize_says_how_much_it_solved(tmp_path):
    kind = "inputs.names:=odom closures", "closures.type:=vision_msgs/msg/Detection3DArray", "closures.use:=closure"
    believed = "robust.decide:=false", "robust.loss:=none"  # what it says is wrong, and shall bend the path
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", *kind, *believed) as n,
        robot(hears=("pose", "/diagnostics"), sends=("/odom",)) as r,
    ):
        r.wait_for_node()
        found = r.publisher("closures", Detection3DArray)
        until(found.get_subscription_count, r.spin, "subscriber of closures")
        drive = Drive(turn=0.0)
        drive.sees = False
        begin_ns = drive.stamp_ns
        drive.go(r, 60, every=2)
        until(lambda: r.heard["pose"], drive.pace(r), "drive")
        r.settle()
        straight = r.heard["pose"][-1].pose.pose.position.x
        back = detection(pose(-straight / 2), np.eye(6) * 1e-6, str(begin_ns))  # the base of then, seen from now
        found.publish(detections(back, stamp_ns=drive.stamp_ns))
        until(lambda: r.heard["pose"][-1].pose.pose.position.x < 0.8 * straight, drive.pace(r), "correction")
        assert r.call("clear_closures").success
        until(lambda: drive.off_by(r) < 0.2, drive.pace(r), "straight path again")
        answer = r.call("optimize")
        assert answer.success and int(answer.message.removesuffix(" keyframes")) >= 20
        finish(n, r)
    assert is_repeated(tmp_path / "run", tmp_path)


REMOVALS = "", "edge", "edge -1", "edge 999999999999999999", "edge 1e9", "landmark nobody", "landmark west", "edge 12"
EXTREME = 0.0, -1.0, 5e-324, 1e9, 1.7e308, math.nan, math.inf


def test_P25_whatever_is_asked_of_a_driving_node_in_whatever_order_it_answers_and_goes_on(tmp_path):
    rng, pending = random.Random(17), []
    parameters = f"output.folder:={tmp_path / 'data' / 'run'}", "inputs.reliable:=true", "journal.resume:=false"
    with node(*parameters) as n, robot(hears=("/diagnostics", "pose", "/tf"), name="asker") as r:
        r.wait_for_node()
        drive, remove = Drive(), r.publisher("/graph_slam/remove", String)
        given = r.publisher("/initialpose", PoseWithCovarianceStamped)

        def set_to(name, value):
            request = SetParametersAtomically.Request(parameters=[RosParameter(name, value=value).to_parameter_msg()])
            pending.append(r.ask("set_parameters_atomically", SetParametersAtomically, request))

        def place(x):
            q, frame = quaternion(norm=rng.choice((1.0, 0.0, x))), rng.choice(("map", "/map", "nowhere", "map " * 100))
            given.publish(
                posed("PoseWithCovarianceStamped", pose(x, -x, 0.0, q), frame, np.diag([rng.choice(EXTREME)] * 6))
            )

        limits = [(p.name, p.type(one)) for p in LIVE for one in (p.low, p.high) if one is not None]
        names = [
            (f"output.{key}", one) for key in ("save_as", "load") for one in ("../up", "site", "x" * 300, "\x1b[31m")
        ]
        asks = [
            functools.partial(set_to, *one) for one in (*limits, *names, *((name, value) for name, value, _ in HOSTILE))
        ]
        asks += [lambda name=name: pending.append(r.ask(name)) for name in SERVICES * 4]
        asks += [functools.partial(place, x) for x in EXTREME]
        asks += [lambda what=what: remove.publish(String(data=what)) for what in (*REMOVALS, "landmark " + "y" * 2000)]
        for _ in range(often(1)):
            for ask in rng.sample(asks, len(asks)):
                drive.step(r)
                ask()
                if len(pending) > 20:
                    until(lambda: all(one.done() for one in pending), r.spin, "answers", 60.0)
        until(lambda: all(one.done() for one in pending), r.spin, "answers", 60.0)
        assert all(one.result() is not None for one in pending)
        assert r.state() == "active"
        assert r.set({p.name: p.default for p in LIVE}) == (True, "")
        for name in ("reset", "resume"):
            assert r.call(name, patience_s=60.0).success
        for name in ("deactivate", "activate"):  # its transforms may have been dated in the future
            assert r.change(name)
        for heard in r.heard.values():
            heard.clear()
        r.until_it_says("OK", spin=drive.pace(r), patience_s=30.0)
        until(lambda: len(r.heard["pose"]) > 5 and len(r.heard["tf"]) > 5, drive.pace(r), "pose and transforms")
        assert all(math.isfinite(m.pose.pose.position.x) for m in r.heard["pose"])
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said, n.said
    assert {p.name for p in tmp_path.iterdir()} == {"data"}, "nothing is written elsewhere"
    tell("service_bursts", tried=often(len(asks)), failed=0)
