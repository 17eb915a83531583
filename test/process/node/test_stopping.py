"""Stopping a node while measurements wait for the solver: nothing accepted is lost, and the next start completes it."""

import json
import signal
import time

import numpy as np
import pytest
from live_drive import Drive, distance
from live_nodes import ENVIRONMENT, graph_slam, lenient, node, own_domain, robot, until

from graph_slam_ros.runs.folder import is_cut_off, is_incomplete
from graph_slam_ros.runs.journal import read_ingest


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own: what is left of others says nothing here."""
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


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


def duration_of_a_solve(r):
    """Of everything, where nothing waits [s]."""
    begun = time.monotonic()
    r.call("optimize")
    return time.monotonic() - begun


def stopped_with_a_backlog(folder, number=signal.SIGTERM):
    """Of a node that is stopped while it solves and messages wait: exit code, time, what it said, what it had used."""
    with node(*parameters(folder)) as n, robot(hears=("pose", "/diagnostics")) as r:
        r.wait_for_node()
        drive = Drive()
        until(lambda: r.heard["pose"], drive.pace(r), "pose")
        drive.go(r, 300)
        solve_s = min(duration_of_a_solve(r) for _ in range(3))

        def press(seconds):
            """Go on, with solves of everything in between, twice as many as it can do: what waits is also tested."""
            for _ in range(4):
                r.ask("optimize")
            drive.go(r, 5)
            r.spin(max(seconds, 2.0 * solve_s))

        until(lambda: behind_s(r) > BEHIND_S, press, "backlog", 30.0)
        accepted = used(r)
        code, took_s = n.stop(number)
        return code, took_s, n.said, accepted


def check_left(run, told):
    """It ended in time, and the run says that all is in its journal and not in its results."""
    code, took_s, said, accepted = told
    assert code == 0, said
    assert took_s < lenient(4.0)
    assert "Traceback" not in said
    assert "measurements waited: all are in the journal" in said
    losses = []
    odometry = [record["stamp_ns"] for record in read_ingest(run, losses) if record["type"] == "odometry"]
    assert losses == []
    assert len(odometry) >= accepted > 300
    summary = json.loads((run / "run.json").read_text())
    assert summary["ended"]
    assert summary["unprocessed"] > 0
    assert max(summary["load"]["backlog"]) > 0
    assert is_incomplete(run)
    assert not is_cut_off(run), "somebody ended it"
    return odometry


def stamps(run):
    """Of the path, in nanoseconds."""
    return np.round(np.loadtxt(run / "path.tum")[:, 0] * 1e9).astype(np.int64)


def test_P6_stopped_with_a_backlog_it_ends_in_4_s_and_the_next_start_completes_the_results(tmp_path):
    run, kept = tmp_path / "run", tmp_path / "run-1"
    odometry = check_left(run, stopped_with_a_backlog(run, signal.SIGTERM))
    with node(*parameters(run)) as n, robot(hears=("/diagnostics",)) as r:
        until(lambda: "run-1: its results are complete" in n.said, r.spin, "results", 60.0)
        assert n.stop()[0] == 0
    assert "run-1 was stopped while measurements waited" in n.said
    assert "the last run was never ended" not in n.said
    assert not is_incomplete(kept)
    assert abs(stamps(kept)[-1] - odometry[-1]) < 10**9


def test_P6_interrupted_with_a_backlog_recover_makes_the_results_of_the_whole_drive(tmp_path):
    run = tmp_path / "run"
    odometry = check_left(run, stopped_with_a_backlog(run, signal.SIGINT))
    done = graph_slam("recover", run, "--out", tmp_path / "recovered", timeout=60.0)
    assert done.returncode == 0, done.stderr
    path = np.loadtxt(tmp_path / "recovered" / "path.tum")
    drive = Drive(odometry[0])
    while drive.stamp_ns < stamps(tmp_path / "recovered")[-1]:
        drive.move()
    assert odometry[-1] - drive.stamp_ns < 10**9
    assert distance(path[-1, 1:3], drive.truth) < 0.2
