"""The node among others: who joins late, what does not fit, several of them, transforms, long paths."""

import itertools
import math
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from live_drive import TAGS, Drive, distance
from live_nodes import LATCHED, node, robot, until
from messages import quaternion, transforms
from nav_msgs.msg import Path
from rclpy.qos import ReliabilityPolicy
from tf2_msgs.msg import TFMessage

NS = 10**9
STATES = ("path", "pose", "landmarks", "landmarks_estimate", "graph", "path_updates")


def stamp_ns(header):
    return header.stamp.sec * NS + header.stamp.nanosec


def rebuilt(updates):
    """The path by stamp that who follows ~/path_updates has."""
    path = {}
    for message in updates:
        if not message.poses:
            path.clear()
        path.update((stamp_ns(one.header), one.pose) for one in message.poses)
    return path


def by_stamp(path):
    return {stamp_ns(one.header): one.pose for one in path.poses}


def test_P8_who_joins_after_the_drive_gets_path_pose_landmarks_and_graph_and_the_whole_path_as_updates(tmp_path):
    parameters = f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", "output.path_period_s:=0.02"
    with node(*parameters) as n, robot(hears=("path", "path_updates", "pose", "landmarks", "/tf")) as r:
        r.wait_for_node()
        r.settle()
        assert not r.heard["pose"] and not r.heard["tf"], "nothing before the first odometry"
        (drive := Drive()).go(r, 100, every=2)
        until(lambda: len(r.heard["path_updates"]) > 1, drive.pace(r), "updates of the path, told as it went")
        until(lambda: len(r.heard["landmarks"]) > 1, drive.pace(r), "landmarks on the way")
        assert r.save().success
        r.settle()
        followed = rebuilt(r.heard["path_updates"])
        with robot(name="late", hears=STATES) as late:
            until(lambda: all(late.heard[topic] for topic in STATES), late.spin, "latched message")
            late.settle()
            r.settle()
        heard, path = late.heard, by_stamp(late.heard["path"][-1])
        assert n.stop()[0] == 0
    assert len(path) > 30
    saved = [line.split() for line in (tmp_path / "run" / "path.tum").read_text().splitlines()]
    assert [(stamp, p.position.x, p.position.y) for stamp, p in path.items()] == [
        (int(t.replace(".", "")), float(x), float(y)) for t, x, y, *_ in saved
    ]
    assert not heard["path_updates"][0].poses, "forget all, then all"
    assert rebuilt(heard["path_updates"]) == path
    assert rebuilt(r.heard["path_updates"]) == path
    assert list(followed) == list(path)
    moved = max(
        distance((followed[k].position.x, followed[k].position.y), (p.position.x, p.position.y))
        for k, p in path.items()
    )
    assert moved <= 0.02, "what has moved by less need not be told"
    newest = heard["pose"][-1]
    assert stamp_ns(newest.header) == list(path)[-1]
    last = list(path.values())[-1].position
    assert (newest.pose.pose.position.x, newest.pose.pose.position.y) == pytest.approx((last.x, last.y), abs=1e-9)
    poses = [stamp_ns(m.header) for m in r.heard["pose"]]
    assert poses == sorted(poses) and len(set(poses)) > 10, "a solve between two keyframes sends the newest again"
    for m in r.heard["pose"]:
        assert np.linalg.eigvalsh(np.reshape(m.pose.covariance, (6, 6)))[0] > 0.0
    assert {(t.header.frame_id, t.child_frame_id) for m in r.heard["tf"] for t in m.transforms} == {("map", "odom")}
    assert {m.text for m in heard["landmarks"][-1].markers if m.text} == set(TAGS)
    assert {d.id for d in heard["landmarks_estimate"][-1].detections} == set(TAGS)
    drawn = {m.ns: len(m.points) for m in heard["graph"][-1].markers}
    assert drawn["edges/odometry"] == 2 * (len(path) - 1), drawn


def test_B23_a_qos_that_does_not_match_and_all_else_that_keeps_odometry_from_coming_is_named():
    asked = "odom.reliability:=reliable", "detections.durability:=transient_local"
    with node("output.folder:=''", *asked) as n, robot(hears=("/diagnostics",), sends=()) as other:
        other.until_it_says("WAITING", "nobody publishes /odom")
        with robot(name="shy", reliability=ReliabilityPolicy.BEST_EFFORT, hears=()):
            reliability = "/odom: shy offers best effort, odom.reliability asks for reliable delivery (QoS)"
            other.until_it_says("WAITING", reliability)
            until(lambda: reliability in n.said, other.spin, "that in the log")
            latched = "shy offers volatile, detections.durability asks for transient_local (QoS)"
            until(
                lambda: latched in [s.message for m in other.heard["diagnostics"] for s in m.status],
                other.spin,
                latched,
            )
        with robot(name="liar", hears=(), sends=()) as liar:
            liar.publisher("/odom", Path)
            other.until_it_says("WAITING", "/odom: liar publishes nav_msgs/msg/Path, not nav_msgs/msg/Odometry")
        with robot(name="driver", hears=(), sends=("/odom",)) as driver:
            other.until_it_says("WAITING", "/odom: /driver publishes it, but nothing has come yet")
            driver.wait_for_node()
            lost = Drive(frames="wheels/")
            lost.sees = False
            unlinked = "no transform links wheels/odom to odom"
            other.until_it_says("WAITING", unlinked, spin=lambda s: (lost.step(driver), other.spin(s)))
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said


def test_P5_P19_a_second_node_with_the_folder_of_the_first_does_not_start_and_two_of_one_name_say_so(tmp_path):
    folder = f"output.folder:={tmp_path / 'run'}"
    with node(folder) as one, robot(hears=("/diagnostics",)) as r:
        r.wait_for_node()
        with node(folder, remap=("__node:=second",)) as second:
            code, said = second.ended(30.0)
        assert code == 2
        assert f"{tmp_path / 'run'}: another process records there" in said
        with node("output.folder:=''") as other:
            r.until_it_says("ERROR", "another node has this node's name")
            assert other.stop()[0] == 0
        r.until_it_says("OK", spin=Drive().pace(r), patience_s=30.0)
        assert one.stop()[0] == 0


def test_P18_another_broadcaster_of_map_to_odom_is_named_also_where_it_is_static_until_it_has_gone():
    with node("output.folder:=''") as n, robot(hears=("/diagnostics", "/tf")) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        with robot(name="amcl", hears=()) as other:
            rival = other.publisher("/tf", TFMessage)

            def both(seconds):
                rival.publish(transforms(("map", "odom", (9.0, 0.0, 0.0), quaternion()), stamp_ns=drive.stamp_ns))
                drive.step(r)
                r.spin(seconds)

            def ours():
                return sum(t.transform.translation.x != 9.0 for m in r.heard["tf"] for t in m.transforms)

            r.until_it_says("ERROR", "somebody else broadcasts map -> odom: /amcl", spin=both)
            r.heard["tf"].clear()
            until(lambda: ours() > 3, both, "transforms of ours: we only report")
        r.until_it_says("OK", spin=drive.pace(r))
        r.publisher("/tf_static", TFMessage, LATCHED).publish(
            transforms(("base_link", "arm", (0.0, 0.0, 1.0), quaternion()))
        )
        with robot(name="still", hears=(), sends=()) as other:
            here = ("map", "odom", (0.0, 0.0, 0.0), quaternion())
            still = other.publisher("/tf_static", TFMessage, LATCHED)
            still.publish(transforms(("base_link", "laser", (0.0, 0.0, 1.0), quaternion()), here))
            what = "somebody else publishes map -> odom on /tf_static: one of /robot, /still, which publish /tf_static"
            r.until_it_says("ERROR", what, spin=drive.pace(r))
            assert r.set({"tf.publish_tf": False}) == (True, "")
            r.until_it_says("OK", spin=drive.pace(r))
            assert r.set({"tf.publish_tf": True}) == (True, "")
        r.until_it_says("OK", spin=drive.pace(r))
        assert n.stop()[0] == 0


def told(r):
    """(stamp, x, y, heading) of each transform heard."""
    return [
        (stamp_ns(t.header), t.transform.translation.x, t.transform.translation.y, 2.0 * math.atan2(q.z, q.w))
        for m in r.heard["tf"]
        for t in m.transforms
        for q in [t.transform.rotation]
    ]


def test_P20_transforms_are_told_once_for_an_odometry_stamp_or_by_the_clock_and_no_faster_than_allowed():
    with node("output.folder:=''", "tf.transform_publish_period:=0.01") as n, robot(hears=("/tf", "/diagnostics")) as r:
        r.wait_for_node()
        there = r.publisher("initialpose", PoseWithCovarianceStamped)
        drive, sent, late_s = Drive(step_s=0.05), set(), []
        until(lambda: len(told(r)) > 3, standing(r, drive), "transforms")
        assert r.set({"tf.max_speed_m_s": 1.0}) == (True, "")
        there.publish(here_is(3.0))
        until(lambda: told(r)[-1][1] == pytest.approx(3.0, abs=1e-3), standing(r, drive), "correction")
        steps = [((b[0] - a[0]) * 1e-9, distance(a[1:], b[1:])) for a, b in itertools.pairwise(told(r))]
        assert 0.9 < max(moved / dt for dt, moved in steps) <= 1.0 + 1e-6
        r.settle()
        r.heard["tf"].clear()

        def twice(seconds):
            sent.add(drive.stamp_ns)
            for _ in range(2):
                r.send("/odom", drive.odometry())
            drive.move()
            for _ in range(3):
                r.spin(seconds)

        until(lambda: len(told(r)) > 15, twice, "transforms")
        r.settle()
        stamps = [stamp for stamp, *_ in told(r)]
        assert all(b > a for a, b in itertools.pairwise(stamps))
        assert {stamp - NS // 10 for stamp in stamps} <= sent, "of odometry's stamps, a tenth of a second ahead"
        assert r.set({"tf.stamp": "now", "tf.transform_tolerance": 0.3}) == (True, "")
        r.settle()
        r.heard["tf"].clear()

        def step(seconds):
            heard = len(told(r))
            drive.pace(r)(seconds)
            late_s.extend((time.time_ns() - stamp) * 1e-9 for stamp, *_ in told(r)[heard:])

        until(lambda: len(late_s) > 10, step, "transforms")
        assert all(b[0] > a[0] for a, b in itertools.pairwise(told(r)))
        assert -0.3 - 1e-3 <= min(late_s) < -0.1, late_s
        assert n.stop()[0] == 0


def here_is(x):
    """Somebody says where the robot is."""
    said = PoseWithCovarianceStamped()
    said.header.frame_id = "map"
    said.pose.pose.position.x, said.pose.pose.orientation.w = x, 1.0
    said.pose.covariance = (0.01 * np.eye(6)).ravel()
    return said


def standing(r, drive):
    """For ``until``: odometry of a robot that stands."""

    def step(seconds):
        at = drive.odom
        r.send("/odom", drive.odometry())
        drive.move()
        drive.odom = at
        r.spin(seconds)

    return step
