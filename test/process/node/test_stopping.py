"""Stopping a node while measurements wait for the solver: nothing accepted is lost, and the next start completes it."""

import json
import signal

import numpy as np
from live_drive import Drive, distance
from live_nodes import graph_slam, node, robot, until

from graph_slam_ros.runs.folder import is_cut_off, is_incomplete
from graph_slam_ros.runs.journal import read_ingest

BEHIND_S = 4.0  # twice what a node that is told to stop still works


def parameters(folder):
    return f"output.folder:={folder}", "inputs.reliable:=true", "keyframes.min_distance_m:=0.02"


def used(r):
    """Messages of odometry that were handed on, by the last of /diagnostics."""
    said = r.said("input odom")
    return int(said[-1][1]["measurements used"]) if said else 0


def behind_s(r):
    """How long ago what the worker has in hand was handed over, by the last of /diagnostics."""
    return float(r.said()[-1][1]["lag [s]"]) if r.said() else 0.0


def test_P6_stopped_with_a_backlog_it_ends_and_recover_or_the_next_start_makes_the_results_of_the_whole_drive(tmp_path):
    run = tmp_path / "run"
    with node(*parameters(run)) as n, robot(hears=("pose", "/diagnostics")) as r:
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        drive.go(r, 300)

        def press(seconds):
            """Go on, with more solves of everything in between than it can do: what waits is also tested."""
            if int(r.said()[-1][1]["messages waiting"]) < 300 if r.said() else True:
                for _ in range(10):
                    r.ask("optimize")
            drive.go(r, 5)
            r.spin(seconds)

        until(lambda: behind_s(r) > BEHIND_S and used(r) > 300, press, "backlog", 60.0)
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
