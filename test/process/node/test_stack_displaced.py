"""The running node, where the landmarks say that the robot is elsewhere: on the real middleware."""

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")

from geometry_msgs.msg import PoseWithCovarianceStamped
from live_drive import Drive
from live_nodes import finish, node, replayed, results, robot, until


def slowly(r, drive):
    """For ``until``: the alarm must last for longer than diagnostics are apart."""
    return lambda seconds: (drive.step(r), r.spin(0.1))


def test_a_robot_that_was_carried_or_is_told_to_be_elsewhere_is_degraded_until_it_is_found(tmp_path):
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n,
        robot(hears=("pose", "path", "/diagnostics", "events")) as r,
    ):
        r.wait_for_node()
        given = r.publisher("initialpose", PoseWithCovarianceStamped)
        until(given.get_subscription_count, r.spin, "subscriber of initialpose")
        drive = Drive()

        def is_found(segments):
            r.until_it_says("DEGRADED", "elsewhere", spin=slowly(r, drive))
            r.until_it_says("OK", spin=drive.pace(r))
            until(lambda: drive.off_by(r) < 0.5, drive.pace(r), "the pose that the landmarks show")
            r.until_graph(drive.pace(r), segments=segments)

        until(lambda: drive.steps > 150 and r.heard["path"], drive.pace(r), "a map")
        assert r.set({"output.path_max_poses": 20}) == (True, "")
        until(lambda: 10 <= len(r.heard["path"][-1].poses) <= 20, drive.pace(r), "a path of fewer poses")
        r.until_it_says("OK", spin=drive.pace(r))
        drive.truth = drive.truth[0] + 30.0, drive.truth[1] - 2.0, drive.truth[2] + 1.0
        is_found(segments=2)
        told = [s for m in r.heard["events"] for s in m.status if s.name == "graph_slam: displaced"]
        assert any("segment" in {v.key for v in s.values} for s in told)
        said = PoseWithCovarianceStamped()
        said.header.frame_id = "map"
        said.pose.pose.position.x, said.pose.pose.orientation.w = 88.0, 1.0
        said.pose.covariance = (1e-2 * np.eye(6)).ravel()
        given.publish(said)
        until(lambda: drive.off_by(r) > 10.0, drive.pace(r), "the pose that was given")
        is_found(segments=3)
        finish(n, r)
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")
