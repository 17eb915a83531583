"""A node that is behind: what it tells while messages wait, and that nothing accepted is lost where it is stopped."""

import json
import signal
import time

import numpy as np
import pytest
from live_drive import Drive, distance
from live_nodes import graph_slam, node, robot, until

from graph_slam_ros.runs.folder import is_cut_off, is_incomplete
from graph_slam_ros.runs.journal import read_ingest

BEHIND_S = 4.0  # twice what a node that is told to stop still works


def parameters(folder):
    slow = "keyframes.min_distance_m:=0.02", "tf.report_jump_m:=0.0"
    return f"output.folder:={folder}", "inputs.reliable:=true", *slow


def used(r):
    """Messages of odometry that were handed on, by the last of /diagnostics."""
    said = r.said("input odom")
    return int(said[-1][1]["measurements used"]) if said else 0


def health(r, name):
    """A number by the last of /diagnostics: how many messages wait, how long ago what is in hand was handed over."""
    return float(r.said()[-1][1][name]) if r.said() else 0.0


def test_A37_P6_behind_it_tells_what_there_is_and_stopped_then_it_ends_and_the_next_start_makes_the_results(tmp_path):
    run, hears = tmp_path / "run", ("/diagnostics", "path", "landmarks", "graph", "pose")
    with node(*parameters(run)) as n, robot(hears=hears) as r:
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        drive.go(r, 300)
        since = time.monotonic()

        def press(seconds):
            """Go on, with more solves of everything in between than it can do: what waits is also tested."""
            if health(r, "messages waiting") < 300:
                for _ in range(20):
                    r.ask("optimize")
            drive.go(r, 5)
            r.spin(seconds)

        until(lambda: health(r, "lag [s]") > BEHIND_S and used(r) > 300, press, "backlog", 60.0)
        results = [r.heard[name] for name in ("path", "landmarks", "graph")]
        for heard in results:
            heard.clear()
        until(lambda: all(results), press, "results while messages wait", 30.0)
        assert n.said.count("map -> odom moved") <= (time.monotonic() - since) / 5.0 + 2
        sigmas = np.sqrt(np.diag(r.heard["pose"][-1].pose.covariance.reshape(6, 6)))
        assert sigmas[[2, 3, 4]] == pytest.approx(0.5), "what the plane leaves open can be drawn"
        until(lambda: health(r, "lag [s]") > BEHIND_S, press, "backlog", 60.0)
        accepted = used(r)
        code, _ = n.stop(signal.SIGTERM)
    assert code == 0, n.said
    assert "Traceback" not in n.said
    assert "measurements waited: all are in the journal" in n.said
    losses, odometry = [], []
    for record in read_ingest(run, losses):
        odometry += [record["stamp_ns"]] if record["type"] == "odometry" else []
    assert losses == []
    assert len(odometry) >= accepted > 300
    summary = json.loads((run / "run.json").read_text())
    assert summary["ended"]
    assert summary["unprocessed"] > 0
    assert max(summary["load"]["backlog"]) > 0
    assert is_incomplete(run)
    assert not is_cut_off(run), "somebody ended it"

    done = graph_slam("recover", run, "--out", tmp_path / "recovered", timeout=60.0)
    assert done.returncode == 0, done.stderr
    recovered, whole = np.loadtxt(tmp_path / "recovered" / "path.tum"), Drive(odometry[0])
    while whole.stamp_ns < recovered[-1, 0] * 1e9 - 1e6:
        whole.move()
    assert odometry[-1] - whole.stamp_ns < 10**9
    assert distance(recovered[-1, 1:3], whole.truth) < 0.2

    with node(*parameters(run)) as n, robot(hears=("/diagnostics",)) as r:
        until(lambda: "run-1: its results are complete" in n.said, r.spin, "results", 60.0)
        assert n.stop()[0] == 0
    assert "run-1 was stopped while measurements waited" in n.said
    assert "the last run was never ended" not in n.said
    assert not is_incomplete(tmp_path / "run-1")
    assert abs(np.loadtxt(tmp_path / "run-1" / "path.tum")[-1, 0] * 1e9 - odometry[-1]) < 10**9
