"""Inputs of the running node: who publishes them, what is refused of them, and what is told of that."""

import math

import pytest
from live_drive import Drive
from live_nodes import ENVIRONMENT, node, own_domain, robot, until
from messages import odometry, pose, quaternion

from graph_slam_ros.lie import se2


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own: what is left of others says nothing here."""
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


def test_A34_two_publishers_of_an_odometry_are_named_and_the_robot_stays_where_it_is(tmp_path):
    hears = "/diagnostics", "pose", "path"
    with node("output.folder:=''", "inputs.reliable:=true") as n, robot(name="wheels", hears=hears) as r:
        r.wait_for_node()
        drive, at = Drive(), (8.0, -3.0, 1.0)
        r.until_it_says("OK", spin=drive.pace(r))
        with robot(name="ekf", hears=(), sends=("/odom",)) as other:
            until(other.publishers["/odom"].get_subscription_count, r.spin, "subscriber of the other")

            def both(seconds):
                nonlocal at
                x, y, yaw = at = tuple(map(float, se2.compose(at, (0.1, 0.0, 0.98 * drive.turn))))
                stamp_ns = drive.stamp_ns + 30_000_000
                other.send("/odom", odometry(pose(x, y, 0.0, quaternion(yaw=yaw)), stamp_ns=stamp_ns))
                drive.step(r)
                r.spin(seconds)

            r.until_it_says("DEGRADED", "/odom: /ekf and /wheels publish it, and one of them is used", spin=both)
            sent = drive.steps
            until(lambda: drive.steps - sent > 100, both, "more of both")
        r.until_it_says("OK", spin=drive.pace(r))
        r.settle()
        told = r.said("input odom")[-1][1]
        assert int(told["counted: other_publisher"]) > 100
        assert r.graph()["segments"] == 1
        newest = r.heard["pose"][-1].pose.pose.position
        assert math.dist((newest.x, newest.y), drive.truth[:2]) < 0.5
        assert n.stop()[0] == 0
