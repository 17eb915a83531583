"""The node beside a DDS of another vendor: what crosses the wire is ROS's, not our middleware's."""

import contextlib
import itertools
import json
import math
import subprocess
import sys
import threading

import numpy as np
import pytest
from live_nodes import ENVIRONMENT, PATIENCE_S, lenient, node, robot, until
from places import ROOT

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: no wheel for this machine, or ROS is sourced")


@contextlib.contextmanager
def client(steps):
    """What a robot with Cyclone DDS hears, in a process of its own, and how to wait for it."""
    heard = {"path": [], "pose": [], "tf": [], "sent": [], "fault": []}
    command = [sys.executable, ROOT / "test/other_vendor.py", str(steps)]
    environment = {**ENVIRONMENT, "PYTHONPATH": f"{ROOT}:{ROOT / 'test'}"}
    process = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def read():
        for line in process.stdout:
            what, value = json.loads(line)
            heard[what].append(value)

    def wait(what, condition, patience_s=PATIENCE_S):
        until(lambda: heard["fault"] or condition(), threading.Event().wait, what, patience_s)
        assert not heard["fault"]

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield heard, wait
    finally:
        process.stdin.close()
        process.wait(timeout=lenient(PATIENCE_S))
        reader.join()


def stamp_ns(message):
    stamp = message["header"]["stamp"]
    return stamp["sec"] * 10**9 + stamp["nanosec"]


def numbers(pose):
    return [pose[part][axis] for part, axes in (("position", "xyz"), ("orientation", "xyzw")) for axis in axes]


def rows(path):
    """As path.tum has them."""
    return [[stamp_ns(one), *numbers(one["pose"])] for one in path["poses"]]


def saved_path(folder):
    lines = [line.split() for line in (folder / "path.tum").read_text().splitlines()]
    return [[int(row[0].replace(".", "")), *map(float, row[1:])] for row in lines]


def test_another_vendor_is_heard_and_hears_path_pose_and_transforms_also_where_it_comes_late(tmp_path):
    folder = tmp_path / "run"
    with node(f"output.folder:={folder}", "inputs.reliable:=true") as n, client(250) as (heard, wait):
        wait("end of the drive", lambda: heard["sent"], 60.0)
        wait("transform and pose", lambda: heard["tf"] and heard["pose"])
        with robot(hears=(), sends=()) as saver:
            saver.save_in_turn()
        path = saved_path(folder)
        wait("path as it was saved, to the last digit", lambda: heard["path"] and rows(heard["path"][-1]) == path)
        wait("pose of that", lambda: stamp_ns(heard["pose"][-1]) == path[-1][0])
        with client(0) as (late, wait_late):
            wait_late("latched path and pose", lambda: late["path"] and late["pose"])
        assert n.stop()[0] == 0
    assert (late["path"], late["pose"]) == (heard["path"][-1:], heard["pose"][-1:])

    paths = [rows(one) for one in heard["path"]]
    assert len(paths) > 3
    assert len(path) > 50
    last = {row[0]: row[1:3] for row in path}
    moved = [math.dist(row[1:3], last[row[0]]) for one in paths for row in one if row[0] in last]
    assert max(moved) > 0.005, "earlier keyframes are corrected"
    (sent,) = heard["sent"]
    found = numbers(heard["pose"][-1]["pose"]["pose"])
    assert found == pytest.approx(path[-1][1:], abs=1e-9), "a pose is the correction times odometry"
    assert math.dist(sent["odometry"][:2], sent["truth"][:2]) > 0.5
    assert math.dist(found[:2], sent["truth"][:2]) < 0.5, "it lags by less than a keyframe"

    for one in heard["pose"]:
        assert one["header"]["frame_id"] == "map"
        assert np.linalg.norm(numbers(one["pose"]["pose"])[3:]) == pytest.approx(1.0)
        assert np.linalg.eigvalsh(np.reshape(one["pose"]["covariance"], (6, 6)))[0] > 0.0
    assert (stamps := list(map(stamp_ns, heard["pose"]))) == sorted(stamps)
    transforms = [t for message in heard["tf"] for t in message["transforms"]]
    assert {(t["header"]["frame_id"], t["child_frame_id"]) for t in transforms} == {("map", "odom")}
    assert all(b > a for a, b in itertools.pairwise(map(stamp_ns, transforms)))
