"""The node as others handle it: transitions, signals, parameters, services; in turn, out of turn, at any moment."""

import json
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
from live_nodes import (
    ENVIRONMENT,
    MODULE,
    completed,
    finish,
    node,
    often,
    replayed,
    results,
    robot,
    server,
    until,
)
from messages import detection, detections, pose
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from vision_msgs.msg import Detection3DArray

from graph_slam_ros.config.config import parameters
from graph_slam_ros.maps.merge import merge
from graph_slam_ros.measurements.types import from_record
from graph_slam_ros.runs.folder import check_room, is_cut_off
from graph_slam_ros.runs.journal import read_ingest
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.restore import freeze
from graph_slam_ros.slam import Control

SERVICES = "save", "load", "reset", "pause", "resume", "optimize", "clear_closures"


def numbers(folder):
    return json.loads((folder / "run.json").read_text())


def accepted(folder):
    """The ingest sequence of a run."""
    return [from_record(record) for record in read_ingest(folder, [])]


def is_repeated(run, tmp_path):
    """Whether replay of a run gives its bytes."""
    place = tmp_path / f"of_{run.name}"
    place.mkdir()
    return replayed(run, place) == results(run)


# -- lifecycle ---------------------------------------------------------------------------------------------------------

TURNS = {
    "unconfigured": {"configure": "inactive"},
    "inactive": {"activate": "active", "cleanup": "unconfigured"},
    "active": {"deactivate": "inactive"},
}
NUMBERS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
    "dance": 99,
    "": 0,
}


def managed(folder, *parameters):
    """A node that waits for its transitions."""
    return node(f"output.folder:={folder}", "inputs.reliable:=true", "node.autostart:=false", *parameters)


def weight(process):
    """(resident memory in MiB, open files, threads) of a process."""
    of = Path("/proc") / str(process.pid)
    status = dict(line.split(":", 1) for line in (of / "status").read_text().splitlines())
    return int(status["VmRSS"].split()[0]) / 1024.0, len(list((of / "fd").iterdir())), int(status["Threads"])


def test_P13_a_life_of_many_transitions_leaves_nothing_behind(tmp_path):
    times, warm = often(6), 2
    with managed(tmp_path / "run") as n, robot(hears=("pose", "path", "/tf", "/diagnostics")) as r:
        drive, weights = Drive(), []
        for _ in range(warm + times):
            assert r.change("configure")
            assert r.change("activate")
            r.heard["pose"].clear()
            until(lambda: len(r.heard["pose"]) > 3, drive.pace(r), "poses")
            assert r.change("deactivate")
            drive.go(r, 3)
            assert r.change("cleanup")
            if weights:  # a thread that was told to end may take a moment for it
                until(lambda: weight(n.process)[2] <= weights[0][2], r.spin, "the end of a thread")
            weights.append(weight(n.process))
        assert r.state() == "unconfigured"
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said
    memory, files, _ = zip(*weights[warm:], strict=True)
    assert memory[-1] - memory[0] < 5.0 + 0.05 * times, memory
    assert max(files) <= files[0], files
    last = warm + times - 1
    assert {run.name for run in tmp_path.iterdir()} == {"run", *(f"run-{last - k}" for k in range(5))}


def test_P22_a_transition_out_of_turn_is_refused_by_name_and_by_number_and_the_node_is_as_it_was(tmp_path):
    with managed(tmp_path / "run") as n, robot(hears=("/diagnostics",)) as r:
        rng, state = random.Random(5), "unconfigured"
        for _ in range(often(20)):
            wanted = rng.choice(list(NUMBERS))
            done = r.change(wanted if rng.random() < 0.5 else NUMBERS[wanted])
            assert done == (wanted in TURNS[state]), (state, wanted)
            state = TURNS[state].get(wanted, state)
            assert r.state() == state
            answer = r.call(rng.choice(("pause", "resume", "optimize", "clear_closures")))
            assert answer.success == (state != "unconfigured"), (state, answer.message)
        for wanted in {"active": ("deactivate", "cleanup"), "inactive": ("cleanup",)}.get(state, ()):
            assert r.change(wanted)
        for name in SERVICES:
            answer = r.call(name)
            assert (answer.success, answer.message) == (False, "not configured: the node is unconfigured"), name
        assert r.change("configure")
        assert r.change("activate")
        r.until_it_says("OK", spin=Drive().pace(r))
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said


def test_what_cannot_be_configured_or_activated_leaves_nothing_and_can_be_once_it_is_mended(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "letter").write_text("mine")
    with managed(tmp_path / "run") as n, robot(hears=("/diagnostics",)) as r:

        def fails(transition):
            assert not r.change(transition)
            assert r.state() == "unconfigured"

        fails("configure")
        (tmp_path / "run" / "letter").unlink()
        assert r.set({"detections.type": "apriltag_msgs/msg/AprilTagDetectionArray"}) == (True, "")
        fails("configure")
        assert r.set({"detections.type": "vision_msgs/msg/Detection3DArray", "odom.topic": "not a/topic"}) == (True, "")
        weights = []
        for _ in range(10):
            assert r.change("configure")
            fails("activate")
            weights.append(weight(n.process)[1:])
        assert weights[-1] <= max(weights[:6]), "open files and threads"
        assert r.set({"odom.topic": "odom"}) == (True, ""), "it is unconfigured"
        assert r.change("configure")
        assert r.change("activate")
        r.until_it_says("OK", spin=Drive().pace(r))
        assert n.stop()[0] == 0
    for why in ("not empty and not an earlier run; nothing was written", "apriltag_msgs is not installed here"):
        assert why in n.said
    assert "Traceback" not in n.said


def test_a_run_that_cannot_be_saved_ends_with_its_cleanup_and_another_may_begin(tmp_path):
    with managed(tmp_path / "run") as n, robot(hears=("pose", "/diagnostics")) as r:
        for is_last in (False, True):
            assert r.change("configure")
            assert r.change("activate")
            r.heard["pose"].clear()
            until(lambda: r.heard["pose"], Drive().pace(r), "pose")
            if not is_last:
                shutil.rmtree(tmp_path / "run")
                (tmp_path / "run").write_text("in its place")
                assert r.change("deactivate")
                assert not r.change("cleanup")
                assert r.state() == "unconfigured"
                (tmp_path / "run").unlink()
        assert r.change("shutdown"), "from whatever state"
        assert numbers(tmp_path / "run")["keyframes"] > 0
        r.until_it_says("FINALIZED")
        assert not r.change("configure")
        assert not r.call("save").success
        assert n.stop()[0] == 0
    assert f"{tmp_path / 'run'}: Not a directory" in n.said
    assert "Traceback" not in n.said


# -- signals -----------------------------------------------------------------------------------------------------------

SIGNALS = signal.SIGINT, signal.SIGTERM
MEANWHILE = "", "save", "optimize", "reset", "clear_closures"


@pytest.mark.parametrize("seed", range(often(2)))
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
        assert not accepted(run) or is_repeated(completed(run, said), tmp_path), (run.name, meanwhile)


def hears_signals(process):
    """Whether SIGTERM is caught: Python does that only where it is told to."""
    status = dict(line.split(":", 1) for line in (Path("/proc") / str(process.pid) / "status").read_text().splitlines())
    return bool(int(status["SigCgt"], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize("seed", range(often(2)))
def test_P6_told_to_stop_at_any_moment_of_its_start_it_ends_with_0_and_may_begin_again(tmp_path, seed):
    rng = random.Random(seed)
    with node(f"output.folder:={tmp_path / 'run'}", by=MODULE) as n:
        until(lambda: hears_signals(n.process), time.sleep, "handler of signals")
        time.sleep(rng.uniform(0.0, 1.2))
        code, _ = n.stop(SIGNALS[seed % 2])
    assert code == 0, n.said
    assert "Traceback" not in n.said
    check_room(tmp_path / "run", force=True)


def test_P5_a_second_node_that_would_record_into_the_folder_of_the_first_does_not_start_and_says_why(tmp_path):
    folder = f"output.folder:={tmp_path / 'run'}"
    with node(folder) as n, robot(hears=("/diagnostics",)) as r:
        r.wait_for_node()
        with node(folder, remap=("__node:=second",)) as second:
            code, said = second.ended(30.0)
        assert code == 2
        assert f"{tmp_path / 'run'}: another process records there" in said
        assert n.is_alive
        assert n.stop()[0] == 0


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
    earlier_run(tmp_path / "life", 20_000)  # without its map: the drive is repeated, which takes long
    parameters = f"output.folder:={tmp_path / 'run'}", "output.load:=life", "output.load_at_start:=true"
    with node(*parameters) as n, robot(hears=("/diagnostics",)) as r:
        until(lambda: "kernels ready" in n.said, r.spin, "configured node", 120.0)
        assert n.stop()[0] == 0, n.said
    assert "Traceback" not in n.said
    assert len(accepted(tmp_path / "life")) == 20_000 + 1_000
    assert not accepted(tmp_path / "run")


# -- what outlives it --------------------------------------------------------------------------------------------------


RESUMED = "goes on by odometry alone since the restart, nothing recognised yet"


def transform(r):
    """The last ``map -> odom``, (x, y, yaw)."""
    found = r.heard["tf"][-1].transforms[0].transform
    return found.translation.x, found.translation.y, 2.0 * math.atan2(found.rotation.z, found.rotation.w)


def killed_in_mid_drive(folder, drive):
    """A node drives, sees, and is killed; returns the stamps of its path and its last ``map -> odom``."""
    with node(f"output.folder:={folder}", "inputs.reliable:=true") as n, robot(hears=("/tf", "path", "pose")) as r:
        r.wait_for_node()
        drive.go(r, 120, every=3)
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
        until(lambda: drive.off_by(r) < 0.5, drive.pace(r), "the pose of now")
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
        r.until_it_says("DEGRADED", unknown, spin=drive.pace(r))
        assert not (r.heard["pose"] or r.heard["tf"] or r.heard["odometry"])
        drive.sees = True
        until(lambda: r.heard["pose"] and r.heard["tf"], drive.pace(r), "place in the map")
        until(lambda: drive.off_by(r) < 0.5, drive.pace(r), "the pose of now")
        finish(n, r)
    assert is_repeated(run, tmp_path)
    assert not is_cut_off(run)


# -- parameters --------------------------------------------------------------------------------------------------------

LIVE = {p.name: p for p in parameters() if p.live}
FIXED = [p for p in parameters() if not p.live]


def valid(p, rng):
    """Another value."""
    if p.choices or p.type is bool:
        return rng.choice(p.choices or (False, True))
    if p.type is str:
        return f"{rng.randrange(9)} 0 0.5" if p.name == "output.load_pose" else f"run-{rng.randrange(9)}"
    near = rng.uniform(0.5, 1.5) * (p.default or 1)
    return max(int(near), int(p.low)) if p.type is int else near


def hostile(rng):
    """(name, value, what the refusal says besides the name)"""
    p, fixed = rng.choice(list(LIVE.values())), rng.choice(FIXED)
    number = rng.choice([p for p in LIVE.values() if p.type is float])
    return rng.choice(
        [
            (p.name[:-1], valid(p, rng), f"did you mean '{p.name}'?"),
            (p.name + "_", valid(p, rng), f"did you mean '{p.name}'?"),
            (p.name, [1.0, 2.0], "is not"),
            (p.name, [b"\x00"], "is not"),
            (number.name, "0.1", "is not a number"),
            (number.name, True, "is not a number"),
            (number.name, -1.0, f"is not in {number.range_text()}"),
            (number.name, 10**10, f"is not in {number.range_text()}"),
            (number.name, math.nan, "is not finite"),
            (number.name, math.inf, "is not finite"),
            (fixed.name, fixed.default, "can be changed only before the node is configured"),
            ("output.folder", "/elsewhere", "can be changed only before the node is configured"),
        ]
    )


def test_P15_of_parameters_that_are_set_together_all_or_none_change_and_the_run_repeats_with_them(tmp_path):
    rng, done = random.Random(3), 0
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n,
        robot(hears=("pose", "/diagnostics")) as r,
    ):
        r.wait_for_node()
        drive, now = Drive(), {name: p.default for name, p in LIVE.items()}
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        for _ in range(often(20)):
            wanted = {p.name: valid(p, rng) for p in rng.sample(list(LIVE.values()), rng.randrange(1, 5))}
            culprit, value, why = hostile(rng) if rng.random() < 0.6 else ("", None, "")
            asked = list((wanted | {culprit: value} if culprit else wanted).items())
            rng.shuffle(asked)
            if rng.random() < 0.7:
                said = r.set(dict(asked))
                assert said[0] == (not culprit), (asked, said)
                answers = {culprit: said} if culprit else {}
                now, done = (now, done) if culprit else (now | wanted, done + 1)
            else:
                answers = dict(zip(dict(asked), r.set(dict(asked), together=False), strict=True))
                assert all(answers[name][0] == (name != culprit) for name in answers), (asked, answers)
                taken = {name: value for name, value in asked if name != culprit}
                now, done = now | taken, done + len(taken)
            if culprit:
                reason = answers[culprit][1]
                assert culprit in reason and why in reason, (value, reason)
            assert r.get(LIVE) == now
            drive.go(r, 5, every=2)
        assert r.set({name: p.default for name, p in LIVE.items()}) == (True, "")
        r.until_it_says("OK", spin=drive.pace(r))
        r.settle()
        assert drive.off_by(r) < 1.0
        finish(n, r)
    assert "Traceback" not in n.said
    assert [m.event for m in accepted(tmp_path / "run") if isinstance(m, Control)].count("set") == done + 1
    assert is_repeated(tmp_path / "run", tmp_path)


def test_P16_a_node_that_is_not_configured_takes_what_is_valid_but_neither_folder_nor_inputs(tmp_path):
    with managed(tmp_path / "run") as n, robot(hears=("pose",)) as r:
        for kind in (0, 42, 255):
            nothing = [Parameter(name="tf.publish_tf", value=ParameterValue(type=kind))]
            request = SetParametersAtomically.Request(parameters=nothing)
            assert not r.call("set_parameters_atomically", SetParametersAtomically, request).result.successful
            answer = r.call("set_parameters", SetParameters, SetParameters.Request(parameters=nothing))
            assert not any(one.successful for one in answer.results)
        for name, value in (("output.folder", str(tmp_path / "elsewhere")), ("inputs.names", "odom")):
            done, why = r.set({"frames.map": "world", name: value})
            assert (done, name in why) == (False, True), why
        assert r.set({"frames.map": "world", "tf.max_speed_m_s": 2}) == (True, ""), "a whole number is a number"
        assert r.get(["frames.map", "tf.max_speed_m_s", "output.folder"]) == {
            "frames.map": "world",
            "tf.max_speed_m_s": 2.0,
            "output.folder": str(tmp_path / "run"),
        }
        assert r.get(["tf.publish_tf"]) == {"tf.publish_tf": True}
        assert r.change("configure")
        assert r.change("activate")
        until(lambda: r.heard["pose"], Drive().pace(r), "pose")
        assert r.heard["pose"][0].header.frame_id == "world"
        assert n.stop()[0] == 0
    assert [run.name for run in tmp_path.iterdir()] == ["run"]


# -- services ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loaded", ["newest", "frozen"])
def test_P12_of_a_loaded_map_nothing_is_claimed_until_a_landmark_is_recognised(tmp_path, loaded):
    hears = "pose", "/tf", "odometry", "/diagnostics", "landmarks"
    parameters = f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true"
    named = () if loaded == "newest" else (f"output.load:={loaded}",)
    with node(*parameters, *named) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive = Drive()
        drive.go(r, 120, every=3)
        r.settle()  # or the call may come before what was sent
        assert r.call("reset").success
        if loaded == "frozen":
            drive.go(r, 60, every=3)
            r.settle()
            assert r.call("reset").success
            merge(tmp_path / "run-1", tmp_path / "run-2", tmp_path / "merged")
            freeze(tmp_path / "merged", tmp_path / "frozen")
        assert r.call("load").success
        r.settle()
        assert {m.text for m in r.heard["landmarks"][-1].markers if m.text} == set(TAGS)
        for heard in r.heard.values():
            heard.clear()
        elsewhere = Drive(drive.stamp_ns + 10**9, truth=(1.0, 2.0, 2.5))
        elsewhere.sees = False
        unknown = "where the robot is in the loaded map is not known yet"
        r.until_it_says("DEGRADED", unknown, spin=elsewhere.pace(r))
        elsewhere.go(r, 40, every=2)
        r.until_it_says("DEGRADED", unknown, spin=elsewhere.pace(r))
        assert not (r.heard["pose"] or r.heard["tf"] or r.heard["odometry"])
        elsewhere.sees = True
        until(lambda: r.heard["pose"] and r.heard["tf"] and r.heard["odometry"], elsewhere.pace(r), "place in the map")
        r.until_it_says("OK", spin=elsewhere.pace(r))
        until(lambda: elsewhere.off_by(r) < 0.5, elsewhere.pace(r), "the pose of now")
        r.until_graph(elsewhere.pace(r), landmarks=len(TAGS))
        finish(n, r)
    assert is_repeated(tmp_path / "run", tmp_path)
    if loaded == "frozen":
        frozen, since = (read_map(tmp_path / name, []) for name in ("frozen", "run"))
        assert (since.values[: len(frozen.values)] == frozen.values).all()


def test_X9_reset_saves_first_and_of_what_it_saved_the_last_five_are_kept(tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=("pose",)) as r:
        r.wait_for_node()
        drive = Drive()
        for _ in range(7):
            r.heard["pose"].clear()
            drive.go(r, 15, every=3)
            until(lambda: len(r.heard["pose"]) > 3, drive.pace(r), "poses")
            answer = r.call("reset")
            assert (answer.success, answer.message) == (True, str(tmp_path / "run"))
        finish(n, r)
    kept = {int(run.name.removeprefix("run-")): run for run in tmp_path.glob("run-*")}
    assert sorted(kept) == [3, 4, 5, 6, 7]
    assert all(numbers(run)["keyframes"] > 3 for run in kept.values())
    assert is_repeated(kept[7], tmp_path)


def test_while_it_is_paused_it_takes_nothing_and_its_transform_goes_on(tmp_path):
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n,
        robot(hears=("pose", "/tf", "/diagnostics")) as r,
    ):
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["pose"] and r.heard["tf"], drive.pace(r), "pose and transform")
        r.settle()
        assert r.call("pause").message == "paused"
        r.until_it_says("DEGRADED", "paused")
        before = r.graph()["keyframes"]
        r.heard["tf"].clear()
        drive.go(r, 30, every=2)
        until(lambda: len(r.heard["tf"]) > 5, drive.pace(r), "transforms")
        r.until_it_says("DEGRADED", "paused", spin=drive.pace(r))
        assert r.graph()["keyframes"] == before
        assert r.call("optimize").success
        assert r.call("resume").message == "takes measurements"
        r.until_it_says("OK", spin=drive.pace(r))
        until(lambda: r.graph()["keyframes"] > before, drive.pace(r), "keyframes")
        assert r.graph()["segments"] == 1, "odometry of later tells what was missed"
        finish(n, r)
    counted = numbers(tmp_path / "run")["counters"]
    assert counted["odom"]["paused"] > 30
    assert counted["detections"]["paused"] > 10
    assert is_repeated(tmp_path / "run", tmp_path)


def closure(stamp_ns, earlier_ns, x):
    """The base of an earlier time, seen from now so far ahead."""
    return detections(detection(pose(x), np.eye(6) * 1e-6, str(earlier_ns)), stamp_ns=stamp_ns)


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
        until(lambda: drive.steps > 60 and r.heard["pose"], drive.pace(r), "drive")
        r.settle()
        straight = r.heard["pose"][-1].pose.pose.position.x
        found.publish(closure(drive.stamp_ns, begin_ns, -straight / 2))
        until(lambda: r.heard["pose"][-1].pose.pose.position.x < 0.8 * straight, drive.pace(r), "correction")
        answer = r.call("clear_closures")
        assert answer.success
        until(lambda: drive.off_by(r) < 0.2, drive.pace(r), "straight path again")
        answer = r.call("optimize")
        r.until_it_says("OK", spin=drive.pace(r))
        assert answer.success
        solved = int(answer.message.removesuffix(" keyframes"))
        assert solved >= 20
        until(lambda: r.graph()["keyframes"] >= solved, drive.pace(r), "as many keyframes")
        finish(n, r)
    assert is_repeated(tmp_path / "run", tmp_path)


def test_a_pose_that_somebody_gives_begins_a_segment(tmp_path):
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n,
        robot(hears=("pose", "/diagnostics")) as r,
    ):
        r.wait_for_node()
        given = r.publisher("initialpose", PoseWithCovarianceStamped)
        until(given.get_subscription_count, r.spin, "subscriber of initialpose")
        drive = Drive()
        drive.sees = False
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        said = PoseWithCovarianceStamped()
        said.header.frame_id = "map"
        said.pose.pose.position.x, said.pose.pose.position.y, said.pose.pose.orientation.w = 2.0, -1.0, 1.0
        said.pose.covariance = (1e-4 * np.eye(6)).ravel()
        drive.truth = 2.0, -1.0, 0.0
        given.publish(said)
        until(lambda: drive.off_by(r) < 0.4, drive.pace(r), "pose where it was told to be")
        r.until_it_says("OK", spin=drive.pace(r))
        r.until_graph(drive.pace(r), segments=2)
        finish(n, r)
    assert is_repeated(tmp_path / "run", tmp_path)
