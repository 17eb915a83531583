"""The map of a running node: held while the robot is located in it, edited by hand; recordings in a saved map."""

import json

import numpy as np
import pytest
from live_drive import Drive, distance
from live_nodes import ENVIRONMENT, node, own_domain, replayed, results, robot, until
from std_msgs.msg import String

from graph_slam_ros.cli import main
from graph_slam_ros.simulation import simulate
from graph_slam_ros.simulation.bag import write_bag


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


def counters(folder):
    return json.loads((folder / "run.json").read_text())["counters"]


def places(message):
    return {one.id: one.results[0].pose.pose.position for one in message.detections}


def test_the_map_is_held_and_edited_while_the_node_runs_and_the_run_repeats(tmp_path):
    hears = "pose", "landmarks_estimate", "/diagnostics"
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=hears) as r:
        remove = r.publisher("/graph_slam/remove", String)
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
        remove.publish(String(data="landmark nobody"))
        remove.publish(String(data="everything, please"))
        remove.publish(String(data=f"landmark {min(held)}"))
        gone = lambda: min(held) not in places(r.heard["landmarks_estimate"][-1])  # noqa: E731
        until(gone, r.spin, "the landmark to be removed")
        drive.go(r, 30, every=2)
        r.settle()
        assert n.stop()[0] == 0
    assert "neither 'edge ID' nor 'landmark NAME'" in n.said
    assert counters(tmp_path / "run")["edit"] == {"removed": 1, "unknown_landmark": 1}
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def test_a_recording_is_located_in_a_map_that_stays(tmp_path, capsys):
    bag = tmp_path / "world.mcap"
    write_bag(simulate("warehouse", 0, aisles=2, laps=1), bag)
    assert main(["replay", str(bag), "--out", str(tmp_path / "first")]) == 0
    assert main(["freeze", str(tmp_path / "first"), "--out", str(tmp_path / "site")]) == 0
    capsys.readouterr()
    assert main(["replay", str(bag), "--map", str(tmp_path / "site"), "--out", str(tmp_path / "second")]) == 0
    site, second = ((tmp_path / name / "landmarks.csv").read_text() for name in ("site", "second"))
    assert _positions(second) == _positions(site)
    (_, new) = json.loads((tmp_path / "second" / "run.json").read_text())["drives"]
    first, path = (np.loadtxt(tmp_path / name / "path.tum") for name in ("first", "second"))
    assert len(path) > len(first)
    assert np.linalg.norm(path[-1, 1:3] - first[-1, 1:3]) < 0.1
    assert (
        main(["export", str(tmp_path / "second"), "--to", "tum", "--last-drive", "--out", str(tmp_path / "a.tum")]) == 0
    )
    assert len(np.loadtxt(tmp_path / "a.tum")) == len(path) - new["keyframe"]


def _positions(text):
    return [line.split(",")[:4] for line in text.splitlines()]


def test_a_map_that_cannot_be_gone_on_in_is_refused_by_name(tmp_path, capsys):
    bag = tmp_path / "world.mcap"
    write_bag(simulate("warehouse", 0, aisles=2, laps=1), bag)
    for words, culprit in (
        (["replay", bag, "--map", tmp_path / "nothing", "--out", tmp_path / "a"], "nothing is not a run folder"),
        (["replay", bag, "--map", tmp_path, "--out", tmp_path / "a"], "is not a run folder"),
    ):
        assert main([str(word) for word in words]) == 2
        assert culprit in capsys.readouterr().err
        assert not (tmp_path / "a").exists()
