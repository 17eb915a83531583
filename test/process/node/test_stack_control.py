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


def test_P13_P16_P22_of_a_managed_node_transitions_out_of_turn_are_refused_and_a_life_of_many_leaves_nothing(tmp_path):
    lives, warm = often(4), 2
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

        rng, state = random.Random(5), "unconfigured"
        for _ in range(often(15)):
            wanted = rng.choice(list(NUMBERS))
            done = r.change(wanted if rng.random() < 0.5 else NUMBERS[wanted])
            assert done == (wanted in TURNS[state]), (state, wanted)
            state = TURNS[state].get(wanted, state)
            assert r.state() == state
            answer = r.call(rng.choice(("pause", "resume", "optimize", "clear_closures")))
            assert answer.success == (state != "unconfigured"), (state, answer.message)
        for wanted in {"active": ("deactivate", "cleanup"), "inactive": ("cleanup",)}.get(state, ()):
            assert r.change(wanted)

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
        assert r.state() == "unconfigured"
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said
    memory, files, _ = zip(*weights[warm:], strict=True)
    assert memory[-1] - memory[0] < 5.0 + 0.05 * lives, memory
    assert max(files) <= files[0], files
    names = {run.name.partition("-")[0] for run in tmp_path.iterdir()}
    assert (names, len(list(tmp_path.iterdir()))) == ({"run"}, 1 + 5), "nothing elsewhere, five are kept"


def test_what_cannot_be_configured_activated_or_saved_leaves_nothing_and_can_be_once_it_is_mended(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "letter").write_text("mine")
    with managed(tmp_path / "run") as n, robot(hears=("pose", "/diagnostics")) as r:

        def fails(transition):
            assert not r.change(transition)
            assert r.state() == "unconfigured"

        def drives():
            assert r.change("configure")
            assert r.change("activate")
            r.heard["pose"].clear()
            until(lambda: r.heard["pose"], Drive().pace(r), "pose")

        fails("configure")
        (tmp_path / "run" / "letter").unlink()
        assert r.set({"detections.type": "apriltag_msgs/msg/AprilTagDetectionArray"}) == (True, "")
        fails("configure")
        assert r.set({"detections.type": "vision_msgs/msg/Detection3DArray", "odom.topic": "not a/topic"}) == (True, "")
        weights = []
        for _ in range(8):
            assert r.change("configure")
            fails("activate")
            weights.append(weight(n.process)[1:])
        assert weights[-1] <= max(weights[:6]), "open files and threads"
        assert r.set({"odom.topic": "odom"}) == (True, ""), "it is unconfigured"
        drives()
        shutil.rmtree(tmp_path / "run")
        (tmp_path / "run").write_text("in its place")
        assert r.change("deactivate")
        fails("cleanup")
        (tmp_path / "run").unlink()
        drives()
        assert r.change("shutdown"), "from whatever state"
        assert numbers(tmp_path / "run")["keyframes"] > 0
        r.until_it_says("FINALIZED")
        assert not r.change("configure")
        assert not r.call("save").success
        assert n.stop()[0] == 0
    for why in (
        "not empty and not an earlier run; nothing was written",
        "apriltag_msgs is not installed here",
        f"{tmp_path / 'run'}: Not a directory",
    ):
        assert why in n.said
    assert "Traceback" not in n.said


# -- signals -----------------------------------------------------------------------------------------------------------

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
        assert not accepted(run) or is_repeated(completed(run, said), tmp_path), (run.name, meanwhile)


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
    earlier_run(tmp_path / "life", 8_000)  # without its map: the drive is repeated, which takes long
    parameters = f"output.folder:={tmp_path / 'run'}", "output.load:=life", "output.load_at_start:=true"
    with node(*parameters) as n, robot(hears=("/diagnostics",)) as r:
        until(lambda: "kernels ready" in n.said, r.spin, "configured node", 120.0)
        assert n.stop()[0] == 0, n.said
    assert "Traceback" not in n.said
    assert len(accepted(tmp_path / "life")) == 8_000 + 400
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

LIVE = {p.name: p for p in parameters() if p.live and p.name != "tf.stamp"}  # by the clock, and then not: none is sent
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
        for _ in range(often(5)):
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


# -- services ----------------------------------------------------------------------------------------------------------


def test_P12_of_a_loaded_map_nothing_is_claimed_until_a_landmark_is_recognised(tmp_path):
    hears = "pose", "/tf", "odometry", "/diagnostics", "landmarks"
    parameters = f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", "output.load:=frozen"
    with node(*parameters) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive = Drive()
        for _ in range(2):
            drive.go(r, 90, every=3)
            r.settle()  # or the call may come before what was sent
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
    frozen, since = (read_map(tmp_path / name, []) for name in ("frozen", "run"))
    assert (since.values[: len(frozen.values)] == frozen.values).all()


def test_X9_paused_it_takes_nothing_and_reset_saves_first_and_keeps_the_last_of_what_it_saved(tmp_path):
    given = f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", "output.keep_earlier:=2"
    with node(*given) as n, robot(hears=("pose", "/tf", "/diagnostics")) as r:
        r.wait_for_node()
        drive = Drive()
        for _ in range(3):
            r.heard["pose"].clear()
            drive.go(r, 15, every=3)
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
    kept = {int(run.name.removeprefix("run-")): run for run in tmp_path.glob("run-*")}
    assert sorted(kept) == [2, 3]
    assert all(numbers(run)["keyframes"] > 3 for run in kept.values())


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
