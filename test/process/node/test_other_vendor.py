"""The node beside a DDS of another vendor: what crosses the wire is ROS's, not our middleware's."""

import itertools
import json
import math
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from places import ROOT

pytest.importorskip("rclpy")
pytest.importorskip("vision_msgs")
pytest.importorskip("tf2_msgs")
pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: no wheel for this machine, or ROS is sourced")

from live_nodes import ENVIRONMENT, PATIENCE_S, lenient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

from graph_slam_ros.warmup import warmup

CLIENT = ROOT.joinpath("test", "other_vendor.py")


class Client:
    """A robot with Cyclone DDS, in a process of its own; all that it hears is kept."""

    def __init__(self, what):
        self.heard = {"path": [], "pose": [], "tf": [], "sent": [], "fault": []}
        self._process = subprocess.Popen(
            [sys.executable, CLIENT, what], env=ENVIRONMENT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self._process.stdout:
            what, value = json.loads(line)
            self.heard[what].append(value)

    def until(self, what, condition, patience_s=PATIENCE_S):
        deadline = time.monotonic() + lenient(patience_s)
        while not condition(self.heard):
            assert self._process.poll() is None, "the client has ended"
            assert not self.heard["fault"], self.heard["fault"]
            assert time.monotonic() < deadline, f"no {what} in {patience_s} s"
            time.sleep(0.02)

    def end(self):
        self._process.stdin.close()
        self._process.wait(timeout=lenient(PATIENCE_S))
        self._reader.join()


def save():
    """Call ~/save, with rclpy: its answer.

    Asked again where none comes: of a client that is new to it, a busy server may not know yet where answers go.
    """
    context = Context()
    context.init(args=[], domain_id=int(ENVIRONMENT["ROS_DOMAIN_ID"]))
    executor = SingleThreadedExecutor(context=context)
    try:
        node = Node("saver", context=context)
        executor.add_node(node)
        client = node.create_client(Trigger, "/graph_slam/save")
        assert client.wait_for_service(timeout_sec=lenient(PATIENCE_S))
        for _ in range(3):
            future = client.call_async(Trigger.Request())
            executor.spin_until_future_complete(future, timeout_sec=lenient(PATIENCE_S))
            if future.done():
                return future.result()
        raise AssertionError("no answer of ~/save")
    finally:
        executor.shutdown()
        context.try_shutdown()


def saved_path(folder):
    rows = [line.split() for line in (folder / "path.tum").read_text().splitlines()]
    return [[int(row[0].replace(".", "")), *map(float, row[1:])] for row in rows]


def near(a, b):
    """But for the rounding of a product: a pose is the correction times odometry."""
    return np.allclose(a, b, rtol=0.0, atol=1e-9)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """One drive of a robot on Cyclone with our node; what it heard, and a listener that came late."""
    warmup()  # so that no patience is spent on compiling
    folder = tmp_path_factory.mktemp("other_vendor") / "run"
    words = ("-p", f"output.folder:={folder}", "-p", "inputs.reliable:=true")
    command = [sys.executable, "-m", "graph_slam_ros.node.node", "--ros-args", *words]
    node = subprocess.Popen(command, env=ENVIRONMENT)
    clients = [Client("drive")]
    try:
        robot = clients[0]
        robot.until("end of the drive", lambda heard: heard["sent"], 10 * PATIENCE_S)
        robot.until("transform and pose", lambda heard: heard["tf"] and heard["pose"])
        answer = save()
        assert answer.success, answer.message
        path = saved_path(folder)
        robot.until("path as it was saved", lambda heard: heard["path"] and heard["path"][-1]["poses"] == path)
        robot.until("pose of that", lambda heard: near(heard["pose"][-1]["pose"], path[-1][1:]))
        clients.append(Client("listen"))
        clients[1].until("latched path and pose", lambda heard: heard["path"] and heard["pose"])
        yield {"robot": robot.heard, "late": clients[1].heard, "path": path}
    finally:
        for client in clients:
            client.end()
        node.send_signal(signal.SIGINT)
        try:
            assert node.wait(timeout=lenient(PATIENCE_S)) == 0
        finally:
            if node.poll() is None:
                node.kill()
                node.wait()


def test_another_vendor_hears_a_path_that_grows_and_moves(session):
    paths = [heard["poses"] for heard in session["robot"]["path"]]
    assert {heard["frame"] for heard in session["robot"]["path"]} == {"map"}
    assert len(paths) > 10
    assert np.isfinite([pose for path in paths for pose in path]).all()
    assert len(paths[-1]) > 50
    points = np.array(paths[-1])[:, 1:3]
    assert np.ptp(points, axis=0) == pytest.approx([6.0, 6.0], abs=0.5)
    last = {row[0]: row[1:3] for row in paths[-1]}
    moved = [math.dist(row[1:3], last[row[0]]) for path in paths for row in path]
    assert max(moved) > 0.01, "earlier keyframes are corrected"


def test_what_it_sends_is_used_landmarks_take_odometrys_drift_away(session):
    (sent,) = session["robot"]["sent"]
    found = session["robot"]["pose"][-1]["pose"][:2]
    drift = math.dist(sent["odometry"][:2], sent["truth"][:2])
    assert drift > 1.0
    assert math.dist(found, sent["truth"][:2]) < 0.5, "it lags by less than a keyframe"


def test_it_hears_poses_with_a_covariance_that_is_one(session):
    for heard in session["robot"]["pose"]:
        covariance = np.reshape(heard["covariance"], (6, 6))
        assert heard["frame"] == "map"
        assert np.linalg.norm(heard["pose"][3:]) == pytest.approx(1.0)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
    stamps = [heard["stamp_ns"] for heard in session["robot"]["pose"]]
    assert stamps == sorted(stamps)


def test_the_last_path_and_pose_are_the_saved_ones(session):
    path, pose = session["robot"]["path"][-1]["poses"], session["robot"]["pose"][-1]
    assert path == session["path"], "to the last digit"
    assert pose["stamp_ns"] == path[-1][0]
    assert near(pose["pose"], path[-1][1:])


def test_it_hears_transforms_from_map_to_odom(session):
    transforms = [t for message in session["robot"]["tf"] for t in message]
    assert {(parent, child) for parent, child, _, _ in transforms} == {("map", "odom")}
    stamps = [stamp for _, _, stamp, _ in transforms]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    assert np.isfinite([x for *_, x in transforms]).all()


def test_a_late_listener_of_another_vendor_gets_the_latched_path_and_pose(session):
    assert session["late"]["path"] == [session["robot"]["path"][-1]]
    assert session["late"]["pose"] == [session["robot"]["pose"][-1]]
