"""Inputs of the running node: who publishes them, what is refused of them, and what is told of that."""

import time

import numpy as np
from live_drive import TAGS, Drive, earlier_run
from live_nodes import LATCHED, node, robot, until
from messages import detection, detections, odometry, pose, quaternion, transforms
from rclpy.qos import ReliabilityPolicy
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray

from graph_slam_ros.lie import se2


def seen(drive, ids=True, unit=1.0, times=1, **options):
    """What a robot sees now of the tags, each so many times under other names: a median soon tells."""
    local = {name: se2.act(se2.inverse(drive.truth), at) for name, at in TAGS.items()}
    here = [(f"{name}{k or ''}", (unit * x, unit * y)) for name, (x, y) in local.items() for k in range(times)]
    of = [detection(pose(*map(float, at)), np.eye(2) * 0.01, name if ids else "") for name, at in here]
    return detections(*of, **{"stamp_ns": drive.stamp_ns, **options})


def test_A35_an_input_that_is_refused_is_degraded_with_the_remedy_while_it_is_and_not_longer():
    quiet = {"hears": ("/diagnostics",), "sends": ("/odom",)}
    with node("output.folder:=''", "inputs.reliable:=true") as n, robot(**quiet) as r:
        until(r.publishers["/odom"].get_subscription_count, r.spin, "subscriber")
        drive, _tags = Drive(), r.publisher("/tags", Detection3DArray)
        drive.sees = False
        r.until_it_says("WAITING", "publishes it, but nothing has come yet")
        what = "nothing corrects odometry: nobody publishes /landmarks: /tags has this type: detections.topic:=/tags"
        r.until_it_says("DEGRADED", what, spin=drive.pace(r))
        landmarks = r.publisher("/landmarks", Detection3DArray)
        r.until_it_says("OK", spin=drive.pace(r))

        def with_tags(**options):
            def step(seconds):
                landmarks.publish(seen(drive, **options))
                drive.pace(r)(seconds)

            return step

        unlinked = with_tags(frame="camera")
        r.until_it_says(
            "DEGRADED", "/landmarks: all refused in 10 s (frame_unknown)", "camera to base_link", spin=unlinked
        )
        linked = transforms(("base_link", "camera", (0.0, 0.0, 0.0), quaternion()))
        r.publisher("/tf_static", TFMessage, LATCHED).publish(linked)
        r.until_it_says("OK", spin=unlinked)
        before = r.said("input detections")[-1][1]
        r.until_it_says(
            "DEGRADED", "(no_id): the detection has no identity: landmarks.association=joint", spin=with_tags(ids=False)
        )
        assert r.said("input detections")[-1][1]["measurements used"] >= before["measurements used"]
        r.until_it_says("OK", spin=with_tags())

        def late(seconds):
            drive.stamp_ns = time.time_ns() - 2 * 10**9
            with_tags()(seconds)

        r.until_it_says("DEGRADED", "/odom: comes ", "tf.transform_tolerance:=", spin=late)
        assert r.set({"tf.transform_tolerance": 10.0}) == (True, "")
        r.until_it_says("OK", spin=late)
        r.until_it_says("DEGRADED", "units: /landmarks: the median distance", spin=with_tags(unit=1e3, times=20))
        assert "elsewhere" not in r.verdict, "they say that the robot was carried"
        r.until_it_says("DEGRADED", "/odom: silent for")
        assert n.stop()[0] == 0
    assert [s for s in ("WAITING", "DEGRADED", "OK") if s in n.said] == ["WAITING", "DEGRADED", "OK"], "the log, too"


def test_A36_a_map_that_cannot_be_loaded_at_the_start_is_an_error_until_another_is(tmp_path):
    earlier_run(tmp_path / "life", 60)
    parameters = "output.load:=lief", "output.load_at_start:=true", "solve.every_keyframes:=100"
    with node(f"output.folder:={tmp_path / 'run'}", *parameters), robot(hears=("/diagnostics",)) as r:
        r.until_it_says("ERROR", "output.load: the map was not loaded: lief: not a run; did you mean 'life'?")
        assert r.set({"output.load": "life"}) == (True, "")
        r.settle()
        loaded = r.ask("load")
        until(loaded.done, r.spin, "loaded map", 60.0)
        assert loaded.result().success
        r.until_it_says("DEGRADED", "where the robot is in the loaded map is not known yet")


def test_A38_what_the_middleware_loses_before_the_node_is_counted_and_degrades():
    with node("output.folder:=''") as n, robot(reliability=ReliabilityPolicy.BEST_EFFORT, hears=("/diagnostics",)) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        large, sent = seen(drive, ids=False, frame="x" * 120_000), 0

        def too_much(seconds):
            nonlocal sent
            for _ in range(20):
                r.send("/landmarks", large)
            sent += 20
            drive.pace(r)(seconds)

        def lost():
            told = r.said("input detections")
            return int(told[-1][1].get("counted: lost_in_transport", 0)) if told else 0

        until(lambda: lost() > 100, too_much, "losses")
        r.until_it_says("DEGRADED", "/landmarks: ", "refused in 10 s", spin=too_much)
        assert lost() < sent, "what was never sent is not lost"
        assert n.stop()[0] == 0


def test_A34_two_publishers_of_an_odometry_are_named_and_the_robot_stays_where_it_is():
    """On a busy machine DDS loses messages and sends them again later: until then the other goes on alone."""
    patient = "inputs.reliable:=true", "odometry.timeout_s:=10.0"
    with node("output.folder:=''", *patient) as n, robot(name="wheels", hears=("pose",)) as r:
        r.wait_for_node()
        drive, at = Drive(step_s=0.03), (80.0, -30.0, 1.0)  # stamps go as time does
        r.until_it_says("OK", spin=drive.pace(r))
        with robot(name="ekf", hears=(), sends=("/odom",)) as other:
            until(other.publishers["/odom"].get_subscription_count, drive.pace(r), "its subscriber")

            def both(seconds):
                nonlocal at
                x, y, yaw = at = tuple(map(float, se2.compose(at, (0.1, 0.0, 0.98 * drive.turn))))
                stamp_ns = drive.stamp_ns + 10_000_000
                other.send("/odom", odometry(pose(x, y, 0.0, quaternion(yaw=yaw)), stamp_ns=stamp_ns))
                drive.step(r)
                r.spin(seconds)

            r.until_it_says("DEGRADED", "/odom: /ekf and /wheels publish it, and one of them is used", spin=both)
            until(lambda: int(r.said("input odom")[-1][1]["counted: other_publisher"]) > 20, both, "their count")
        r.until_it_says("OK", spin=drive.pace(r))
        assert r.graph()["segments"] == 1, f"{r.said('input odom')[-1][1]}, {n.said}"
        assert drive.off_by(r) < 0.5
        assert n.stop()[0] == 0


def test_A39_odometry_on_tf_that_never_comes_or_stops_is_missed_though_tf_goes_on():
    on_tf = "odom.type:=tf2_msgs/msg/TFMessage", "odom.topic:=/tf"
    with node("output.folder:=''", *on_tf) as n, robot(hears=("/diagnostics", "pose"), sends=("/landmarks",)) as r:
        r.wait_for_node()
        drive, tf = Drive(), r.publisher("/tf", TFMessage)

        def tell(parent):
            def step(seconds):
                x, y, yaw = drive.odom
                at = (parent, "base_link", (x, y, 0.0), quaternion(yaw=yaw))
                arm = ("base_link", "arm", (0.0, 0.0, 1.0), quaternion())
                tf.publish(transforms(*([at, arm] if parent else [arm]), stamp_ns=drive.stamp_ns))
                drive.move()
                r.spin(seconds)

            return step

        r.until_it_says("WAITING", "/tf: no transform odom -> base_link has come", spin=tell(""))
        r.until_it_says("WAITING", "but wheels -> base_link: correct frames.odom or frames.base", spin=tell("wheels"))
        r.until_it_says("OK", spin=tell("odom"))
        r.until_it_says("DEGRADED", "/tf: silent for", spin=tell("wheels"))
        assert n.stop()[0] == 0
