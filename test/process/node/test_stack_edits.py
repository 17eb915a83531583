"""The map of a running node: held while the robot is located in it, edited by hand; recordings in a saved map."""

import json
import signal

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from live_drive import Drive, distance, earlier_run
from live_nodes import finish, node, replayed, results, robot, until
from std_msgs.msg import String

from graph_slam_ros.runs.map_journal import read_map


def counters(folder):
    return json.loads((folder / "run.json").read_text())["counters"]


def places(message):
    return {one.id: one.results[0].pose.pose.position for one in message.detections}


def test_the_map_is_held_and_edited_while_the_node_runs_and_the_run_repeats(tmp_path):
    hears = "pose", "landmarks_estimate", "/diagnostics", "events"
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=hears) as r:
        remove = r.publisher("/graph_slam/remove", String)
        given = r.publisher("initialpose", PoseWithCovarianceStamped)
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["landmarks_estimate"] and r.heard["pose"], drive.pace(r), "landmarks")
        drive.go(r, 60, every=2)
        r.settle()
        assert r.set({"map.localize": True}) == (True, "")
        drive.go(r, 10, every=2)
        r.settle()
        held = places(r.heard["landmarks_estimate"][-1])
        drive.go(r, 60, every=2)
        r.settle()
        assert held and places(r.heard["landmarks_estimate"][-1]) == held
        at = r.heard["pose"][-1].pose.pose.position
        assert distance((at.x, at.y), drive.truth) < 1.0
        assert r.set({"map.localize": False}) == (True, "")
        wrong = PoseWithCovarianceStamped()
        wrong.header.frame_id, wrong.pose.pose.orientation.w = "odom", 1.0
        for _ in range(2):
            remove.publish(String(data="landmark nobody"))
            given.publish(wrong)
        remove.publish(String(data="landmark nort"))
        remove.publish(String(data="everything, please"))
        remove.publish(String(data=f"landmark {min(held)}"))
        gone = lambda: min(held) not in places(r.heard["landmarks_estimate"][-1])  # noqa: E731
        until(gone, r.spin, "the landmark to be removed")
        drive.go(r, 30, every=2)
        r.settle()
        until(lambda: r.said("asked"), r.spin, "answer on /diagnostics")
        finish(n, r)
    asked = [s.message for m in r.heard["events"] for s in m.status if s.name == "graph_slam: asked"]
    assert f"~/remove: landmark {min(held)}: done" in asked
    assert sum(one.startswith("initialpose: not used: ") for one in asked) == 2
    assert any(one.startswith("~/remove: landmark nort: ") and "did you mean 'north'?" in one for one in asked)
    assert "neither 'edge ID' nor 'landmark NAME'" in n.said
    why = "~/remove named a landmark that is not in the map (unknown_landmark): ros2 topic echo"
    assert n.said.count(f"~/remove: landmark nobody: {why}") == 2, "each time"
    assert f"~/remove: landmark {min(held)}" not in n.said
    assert n.said.count("initialpose: not used: ") == 2, "each time"
    assert counters(tmp_path / "run")["edit"] == {"removed": 1, "unknown_landmark": 3}
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def text(pose):
    return " ".join(f"{number:.3f}" for number in pose)


def test_a_map_is_saved_by_name_and_loaded_with_the_pose_of_the_robot(tmp_path):
    hears = "pose", "/tf", "/diagnostics", "landmarks_estimate"
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive = Drive()
        drive.go(r, 90, every=3)
        r.settle()
        for name, value, why in (
            ("save_as", "../site", "output.save_as: '../site' is not the name of a run"),
            ("load_pose", "1 2", "output.load_pose: '1 2' is not 3 numbers"),
        ):
            done, said = r.set({f"output.{name}": value})
            assert not done and why in said
        for name, why in (
            ("run-3", "run is saved; run-3: earlier runs are called so"),
            ("run", "run: is there already"),
        ):
            assert r.set({"output.save_as": name}) == (True, "")
            answer = r.save()
            assert not answer.success and why in answer.message
        assert r.set({"output.save_as": "site"}) == (True, "")
        answer = r.save()
        assert (answer.success, answer.message) == (True, f"{tmp_path / 'run'}, {tmp_path / 'site'}")
        assert np.allclose(landmarks(tmp_path / "site"), landmarks(tmp_path / "run"), atol=1e-6)
        answer = r.save()
        assert not answer.success and "run is saved; site: is there already" in answer.message
        drive.sees = False
        drive.stamp_ns += 10**9
        assert r.set({"output.load": "site", "output.load_pose": text(drive.truth)}) == (True, "")
        answer = r.call("load")
        assert answer.success and "the robot is taken to be at" in answer.message
        r.settle()  # the end of the run before has poses, too
        r.heard["pose"].clear()
        r.heard["tf"].clear()
        located(r, drive)
        finish(n, r)
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")
    assert not (tmp_path / "run-3").exists()


def located(r, drive):
    """Nothing was seen: pose and transform are there with the first odometry, and the pose is the given one."""
    at = drive.truth
    until(lambda: r.heard["pose"] and r.heard["tf"], drive.pace(r), "place in the map")
    said = r.heard["pose"][0].pose.pose.position
    assert distance((said.x, said.y), at) < 0.01


def test_a_map_is_loaded_at_the_start_with_the_pose_of_the_robot(tmp_path):
    earlier_run(tmp_path / "site", 100)
    at = f"output.folder:={tmp_path / 'run'}", "output.load:=site", "output.load_at_start:=true"
    drive = Drive(truth=(2.0, 1.0, 0.5))
    given = f"output.load_pose:='{text(drive.truth)}'", "inputs.reliable:=true"
    with node(*at, *given) as n, robot(hears=("pose", "/tf", "/diagnostics")) as r:
        r.wait_for_node()
        drive.sees = False
        located(r, drive)
        drive.sees = True
        drive.go(r, 60, every=3)
        r.until_it_says("OK", spin=drive.pace(r))
    assert n.process.returncode == -signal.SIGKILL
    with node(*at, *given) as n, robot(hears=("pose", "/diagnostics")) as r:
        r.wait_for_node()
        assert n.stop()[0] == 0
    assert "going on in its map; output.load_pose is not used: it has driven since" in n.said
    assert len(np.loadtxt(tmp_path / "run" / "path.tum")) >= len(read_map(tmp_path / "run-1", []).keyframes)


def landmarks(folder):
    rows = _positions((folder / "landmarks.csv").read_text())[1:]
    return [list(map(float, row[2:])) for row in rows]


def _positions(text):
    return [line.split(",")[:4] for line in text.splitlines()]
