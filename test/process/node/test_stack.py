"""The node among others: who joins late, what does not fit, several of them, transforms, odometry, long paths."""

import contextlib
import csv
import itertools
import json
import math
import re
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from live_drive import TAGS, Drive, distance, earlier_run
from live_nodes import ENVIRONMENT, finish, lenient, node, own_domain, replayed, results, robot, until
from nav_msgs.msg import Path
from places import ROOT
from rclpy.qos import ReliabilityPolicy
from reliability import times
from tf2_msgs.msg import TFMessage

from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.runs.folder import is_run

NS = 10**9
STATES = ("path", "pose", "landmarks", "landmarks_estimate", "graph", "path_updates")


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own: what is left of others says nothing here."""
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


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


# -- who joins late ----------------------------------------------------------------------------------------------------


def test_who_joins_after_the_drive_gets_path_pose_landmarks_and_graph_and_the_whole_path_as_updates(tmp_path):
    parameters = f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true", "output.path_period_s:=0.02"
    with node(*parameters) as n, robot(hears=("path", "path_updates")) as r:
        r.wait_for_node()
        Drive().go(r, 250, every=2)
        until(lambda: len(r.heard["path_updates"]) > 1, r.spin, "updates of the path, told as it went")
        assert r.save().success
        r.settle()
        followed = rebuilt(r.heard["path_updates"])
        with robot(name="late", hears=STATES) as late:
            until(lambda: all(late.heard[topic] for topic in STATES), late.spin, "latched message")
            late.settle()
            r.settle()
        heard, path = late.heard, by_stamp(late.heard["path"][-1])
        assert n.stop()[0] == 0
    assert len(path) > 80
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
    assert {m.text for m in heard["landmarks"][-1].markers if m.text} == set(TAGS)
    assert {d.id for d in heard["landmarks_estimate"][-1].detections} == set(TAGS)
    drawn = {m.ns: len(m.points) for m in heard["graph"][-1].markers}
    assert drawn["edges/odometry"] == 2 * (len(path) - 1), drawn


# -- what does not fit -------------------------------------------------------------------------------------------------


def test_B23_a_qos_that_does_not_match_and_all_else_that_keeps_odometry_from_coming_is_named(tmp_path):
    parameters = "output.folder:=''", "inputs.reliable:=true"
    with node(*parameters) as n, robot(hears=("/diagnostics",), sends=()) as other:
        other.until_it_says("WAITING", "nobody publishes /odom")
        with robot(name="shy", reliability=ReliabilityPolicy.BEST_EFFORT, hears=()):
            other.until_it_says(
                "WAITING", "/odom: shy offers best effort, inputs.reliable asks for reliable", patience_s=3.0
            )
        with robot(name="liar", hears=(), sends=()) as liar:
            liar.publisher("/odom", Path)
            other.until_it_says(
                "WAITING", "/odom: liar publishes nav_msgs/msg/Path, not nav_msgs/msg/Odometry", patience_s=3.0
            )
        with robot(name="driver", hears=()) as driver:
            other.until_it_says("WAITING", "/odom: /driver publishes it, but nothing has come yet", patience_s=3.0)
            driver.wait_for_node()
            lost = Drive(frames="wheels/")
            other.until_it_says(
                "WAITING",
                "no transform links wheels/odom to odom",
                spin=lambda s: (lost.step(driver), other.spin(s)),
                patience_s=3.0,
            )
        assert n.stop()[0] == 0
    assert "Traceback" not in n.said


def test_the_qos_of_one_input_is_its_own_and_a_publisher_that_does_not_connect_is_named_with_the_parameter():
    asked = "odom.reliability:=reliable", "detections.durability:=transient_local"
    with node("output.folder:=''", *asked) as n, robot(hears=("/diagnostics",), sends=()) as other:
        with robot(name="shy", reliability=ReliabilityPolicy.BEST_EFFORT, hears=()):
            reliability = "offers best effort, odom.reliability asks for reliable delivery (QoS)"
            other.until_it_says("WAITING", f"/odom: shy {reliability}")
            until(lambda: f"/odom: shy {reliability}" in n.said, other.spin, "that in the log")
            latched = "shy offers volatile, detections.durability asks for transient_local (QoS)"
            until(
                lambda: latched in [s.message for m in other.heard["diagnostics"] for s in m.status],
                other.spin,
                latched,
            )
        assert n.stop()[0] == 0
    with node("output.folder:=''", "odom.reliability:=sometimes") as n:
        code, said = n.ended()
    assert code != 0
    assert "odom.reliability: 'sometimes' is not one of auto, reliable, best_effort" in said


def test_frames_that_nothing_links_to_the_robot_are_named_and_the_rest_goes_on(tmp_path):
    with node("output.folder:=''") as n, robot(hears=("/diagnostics", "path")) as r:
        r.wait_for_node()
        drive = Drive()

        def with_a_camera_of_its_own(seconds):
            r.send("/odom", drive.odometry())
            r.send("/landmarks", drive.seen(frame="camera_of_its_own"))
            drive.move()
            r.spin(seconds)

        r.until_it_says(
            "DEGRADED",
            "/landmarks: all refused in 10 s",
            "no transform links camera_of_its_own to base_link",
            spin=with_a_camera_of_its_own,
        )
        until(lambda: r.heard["path"], with_a_camera_of_its_own, "path of odometry alone")
        assert n.stop()[0] == 0


def test_it_waits_is_well_is_degraded_while_odometry_is_silent_and_well_again():
    with node("output.folder:=''") as n, robot(hears=("/diagnostics",)) as r:
        r.wait_for_node()
        r.until_it_says("WAITING", "publishes it, but nothing has come yet")
        until(lambda: re.search(r"\[WARN\].*WAITING", n.said), r.spin, "a warning that it waits still")
        assert re.search(r"\[(\w+)\].*WAITING", n.said)[1] == "INFO", "at first that is no reason to warn"
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        r.until_it_says("DEGRADED", "/odom: silent for")
        r.until_it_says("OK", spin=drive.pace(r))
        assert n.stop()[0] == 0
    assert [s for s in ("WAITING", "OK", "DEGRADED") if s in n.said] == ["WAITING", "OK", "DEGRADED"], "the log, too"


def test_B13_a_clock_that_does_not_come_is_named_where_simulated_time_is_used():
    with node("output.folder:=''", "use_sim_time:=true") as n, robot(hears=("/diagnostics", "/tf", "path")) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("WAITING", "use_sim_time is set and nothing comes on /clock")
        r.until_it_says("DEGRADED", "use_sim_time is set and nothing comes on /clock", spin=drive.pace(r))
        assert n.stop()[0] == 0


def test_after_eight_seconds_of_detections_at_1e8_m_every_solve_succeeds_as_before(tmp_path):
    run = tmp_path / "run"
    parameters = f"output.folder:={run}", "inputs.reliable:=true", "world.dimensions:=3"
    with node(*parameters) as n, robot(hears=("/diagnostics", "pose")) as r:
        r.wait_for_node()
        drive = Drive()
        drive.go(r, 60)
        drive.claims = {"far": (0.0, 0.0, 1e8)}
        drive.go(r, 80)
        drive.claims = {}
        drive.go(r, 60)
        r.until_it_says("OK", spin=drive.pace(r))
        assert r.save().success
        finish(n, r)
    record = json.loads((run / "run.json").read_text())
    assert record["counters"]["detections"]["beyond_max_distance"] == 27
    assert "solver" not in record["counters"]
    found = {row["id"]: row for row in csv.DictReader((run / "landmarks.csv").read_text().splitlines())}
    assert found.keys() == TAGS.keys()
    for name, at in TAGS.items():
        assert distance(at, (float(found[name]["x"]), float(found[name]["y"]))) < 0.1
    assert replayed(run, tmp_path) == results(run)


# -- several nodes -----------------------------------------------------------------------------------------------------


def test_two_robots_in_namespaces_do_not_see_each_other(tmp_path):
    frames = {"map": "map", "odom": "odom", "base": "base_link"}

    def started(name):
        named = (f"frames.{key}:={name}/{frame}" for key, frame in frames.items())
        return node("output.folder:=''", "inputs.reliable:=true", *named, remap=[f"__ns:=/{name}"])

    hears = "/diagnostics", "/tf", "pose", "path"
    with (
        started("a") as one,
        started("b") as other,
        robot(of="/a/graph_slam", hears=hears) as r,
        robot(of="/b/graph_slam", hears=hears) as q,
    ):
        drives = {r: Drive(frames="a/"), q: Drive(frames="b/", turn=-0.02)}
        for each in drives:
            each.wait_for_node()

        def both(seconds):
            for each, drive in drives.items():
                drive.step(each)
                each.spin(seconds / 2)

        for each in drives:
            each.until_it_says("OK", spin=both)
        until(lambda: all(len(each.heard["pose"]) > 20 for each in drives), both, "poses of both")
        for each, name in ((r, "a"), (q, "b")):
            assert {m.header.frame_id for m in each.heard["pose"]} == {f"{name}/map"}
            assert each.heard["pose"][-1].pose.pose.position.y * (1.0 if name == "a" else -1.0) > 0.0
        told = {(t.header.frame_id, t.child_frame_id) for m in r.heard["tf"] for t in m.transforms}
        assert told == {("a/map", "a/odom"), ("b/map", "b/odom")}
        assert {s.hardware_id for m in r.heard["diagnostics"] for s in m.status} == {"a/graph_slam", "b/graph_slam"}
        for n in (one, other):
            assert n.stop()[0] == 0
            assert "WARN" not in n.said.replace("WAITING", "").replace("[WARN]", "", n.said.count("WAITING")), n.said


def test_P19_two_nodes_of_one_name_say_so_until_one_has_gone():
    with node("output.folder:=''") as one, node("output.folder:=''") as other, robot(hears=("/diagnostics",)) as r:
        r.wait_for_node()
        r.until_it_says("ERROR", "another node has this node's name")
        assert other.stop()[0] == 0
        r.until_it_says("OK", spin=Drive().pace(r), patience_s=30.0)
        assert one.stop()[0] == 0


def foreign_correction(stamp_ns, x=9.0):
    """map -> odom as another localiser tells it."""
    message = TFMessage()
    message.transforms.append(TransformStamped())
    message.transforms[0].header.frame_id, message.transforms[0].child_frame_id = "map", "odom"
    message.transforms[0].header.stamp.sec, message.transforms[0].header.stamp.nanosec = divmod(stamp_ns, NS)
    message.transforms[0].transform.translation.x = x
    return message


def test_P18_another_broadcaster_of_map_to_odom_is_named():
    with node("output.folder:=''") as n, robot(hears=("/diagnostics", "/tf")) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        with robot(name="amcl", hears=()) as other:
            rival = other.publisher("/tf", TFMessage)

            def both(seconds):
                rival.publish(foreign_correction(drive.stamp_ns))
                drive.step(r)
                r.spin(seconds)

            def ours():
                return sum(t.transform.translation.x != 9.0 for m in r.heard["tf"] for t in m.transforms)

            r.until_it_says("ERROR", "somebody else broadcasts map -> odom: /amcl", spin=both)
            r.heard["tf"].clear()
            until(lambda: ours() > 3, both, "transforms of ours: we only report")
        r.until_it_says("OK", spin=drive.pace(r))
        assert n.stop()[0] == 0


# -- transforms --------------------------------------------------------------------------------------------------------


def told(r):
    """(stamp, x, y, heading) of each transform heard."""
    return [
        (stamp_ns(t.header), t.transform.translation.x, t.transform.translation.y, 2.0 * math.atan2(q.z, q.w))
        for m in r.heard["tf"]
        for t in m.transforms
        for q in [t.transform.rotation]
    ]


def test_P20_transforms_begin_with_the_first_solution_and_are_told_once_for_an_odometry_stamp():
    with node("output.folder:=''", "tf.transform_publish_period:=0.01") as n, robot(hears=("/tf", "/diagnostics")) as r:
        r.wait_for_node()
        drive, sent = Drive(), set()
        for _ in range(30):
            r.send("/landmarks", drive.seen())
            r.spin()
        assert told(r) == [], "what is seen says nothing without odometry"

        def twice(seconds):
            sent.add(drive.stamp_ns)
            for _ in range(2):
                r.send("/odom", drive.odometry())
            if drive.steps % 3 == 0:
                r.send("/landmarks", drive.seen())
            drive.move()
            for _ in range(3):
                r.spin(seconds)

        until(lambda: len(told(r)) > 40, twice, "transforms")
        r.settle()
        stamps = [stamp for stamp, *_ in told(r)]
        assert all(b > a for a, b in itertools.pairwise(stamps))
        assert {stamp - NS // 10 for stamp in stamps} <= sent, "of odometry's stamps, a tenth of a second ahead"
        before = len(stamps)
        r.until_it_says("DEGRADED", "/odom: silent for")
        assert len(told(r)) == before, "silent with odometry"
        assert r.set({"tf.publish_tf": False}) == (True, "")
        for _ in range(30):
            twice(0.01)
        r.settle()
        assert len(told(r)) == before, "silent when told to be"
        assert n.stop()[0] == 0


def test_P20_transforms_dated_by_the_clock_are_ahead_of_it_by_the_tolerance():
    with node("output.folder:=''", "tf.stamp:=now", "tf.transform_tolerance:=0.3") as n, robot(hears=("/tf",)) as r:
        r.wait_for_node()
        drive, late_s = Drive(), []

        def step(seconds):
            heard = len(told(r))
            drive.pace(r)(seconds)
            late_s.extend((time.time_ns() - stamp) * 1e-9 for stamp, *_ in told(r)[heard:])

        until(lambda: len(told(r)) > 20, step, "transforms")
        assert n.stop()[0] == 0
    stamps = [stamp for stamp, *_ in told(r)]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    assert -0.3 - 1e-3 <= min(late_s) < -0.1, late_s


@pytest.mark.parametrize("most", [0.0, 1.0])
def test_a_correction_moves_the_robot_no_faster_than_allowed(most):
    with node("output.folder:=''", f"tf.max_speed_m_s:={most}") as n, robot(hears=("/tf",)) as r:
        r.wait_for_node()
        there = r.publisher("initialpose", PoseWithCovarianceStamped)
        drive = Drive(step_s=0.05)
        until(lambda: len(told(r)) > 3, standing(r, drive), "transforms")
        said = PoseWithCovarianceStamped()
        said.header.frame_id = "map"
        said.pose.pose.position.x, said.pose.pose.orientation.w = 3.0, 1.0
        said.pose.covariance = (0.01 * np.eye(6)).ravel()
        there.publish(said)
        until(lambda: told(r)[-1][1] == pytest.approx(3.0, abs=1e-3), standing(r, drive), "correction")
        assert n.stop()[0] == 0
    steps = [((b[0] - a[0]) * 1e-9, distance(a[1:], b[1:])) for a, b in itertools.pairwise(told(r))]
    fastest = max(moved / dt for dt, moved in steps)
    if most:
        assert 0.9 * most < fastest <= most * (1.0 + 1e-6)
    else:
        assert max(moved for _, moved in steps) == pytest.approx(3.0, abs=1e-3)


def standing(r, drive):
    """For ``until``: odometry of a robot that stands."""

    def step(seconds):
        at = drive.odom
        r.send("/odom", drive.odometry())
        drive.move()
        drive.odom = at
        r.spin(seconds)

    return step


# -- odometry in the map -----------------------------------------------------------------------------------------------


def test_odometry_in_the_map_comes_at_each_message_and_grows_less_certain_until_the_next_keyframe():
    rare = "keyframes.min_distance_m:=2.05", "keyframes.min_angle_rad:=3.1", "keyframes.max_interval_s:=1000.0"
    with node("output.folder:=''", "inputs.reliable:=true", *rare) as n, robot(hears=("odometry", "pose")) as r:
        r.wait_for_node()
        drive, sent = Drive(), {}
        drive.sees = False
        until(lambda: r.heard["odometry"], drive.pace(r), "odometry in the map")
        r.settle()
        r.heard["odometry"].clear()
        for _ in range(100):
            sent[drive.stamp_ns] = drive.odom
            drive.pace(r)(0.005)
        until(lambda: len(r.heard["odometry"]) >= 100, r.spin, "all of it")
        heard, keyframes = list(r.heard["odometry"]), {stamp_ns(m.header) for m in r.heard["pose"]}
        assert n.stop()[0] == 0
    stamps = [stamp_ns(m.header) for m in heard]
    assert stamps == list(sent), "each once, in order"
    assert len(keyframes & set(stamps)) >= 4
    for m in heard:
        assert (m.header.frame_id, m.child_frame_id) == ("map", "base_link")
        at = sent[stamp_ns(m.header)]
        assert distance((m.pose.pose.position.x, m.pose.pose.position.y), at) < 1e-6, "nothing corrects it here"
    spread = [m.pose.covariance[0] + m.pose.covariance[7] for m in heard]
    assert all(b > a for a, b in itertools.pairwise(spread))
    assert spread[-1] > 2.0 * spread[0]


# -- a long life -------------------------------------------------------------------------------------------------------


MOST = times(2_000, 10_000)
PATH_AT_MOST = f"output.path_max_poses:={MOST}"


@pytest.fixture(scope="module")
def veteran(tmp_path_factory):
    """A node with a life behind it: (its robot, a drive, the first and last stamp of that life)."""
    folder, keyframes = tmp_path_factory.mktemp("veteran"), times(3_000, 100_000)
    stamps = earlier_run(folder / "life", keyframes)
    parameters = f"output.folder:={folder / 'run'}", "output.load:=life", "solve.every_keyframes:=200", PATH_AT_MOST
    hears = "path", "odometry", "/tf", "/diagnostics"
    with node(*parameters), robot(hears=hears, raw=("path",)) as r:
        r.wait_for_node()
        answer = r.call("load", patience_s=keyframes / 200)
        assert answer.success, answer.message
        r.settle(2.0)
        assert r.heard["path"]
        assert not r.heard["tf"], "where it is now is not known"
        assert r.set({"solve.every_keyframes": 1}) == (True, "")
        drive = Drive()
        until(lambda: r.heard["tf"], drive.pace(r), "a place in the old map")
        yield r, drive, (stamps[0], stamps[-1])


def test_P8_of_a_path_that_is_too_long_some_poses_are_published_the_first_and_last_among_them(veteran):
    r, drive, earlier = veteran
    path = typestore().deserialize_cdr(r.heard["path"][0], "nav_msgs/msg/Path")
    stamps = [stamp_ns(one.header) for one in path.poses]
    assert MOST / 2 < len(stamps) <= MOST
    assert (stamps[0], stamps[-1]) == earlier
    assert stamps == sorted(stamps)
    r.heard["path"].clear()
    assert r.set({"output.path_max_poses": 100}) == (True, "")
    until(lambda: r.heard["path"], drive.pace(r), "path")
    until(lambda: len(r.heard["path"][-1]) < 20_000, drive.pace(r), "shorter path")

    def newest():
        return typestore().deserialize_cdr(r.heard["path"][-1], "nav_msgs/msg/Path").poses

    until(lambda: stamp_ns(newest()[-1].header) > drive.stamp_ns - NS, r.spin, "path up to now")
    assert 50 < len(newest()) <= 100
    assert stamp_ns(newest()[0].header) == stamps[0]


def test_P9_while_everything_is_solved_and_saved_transforms_odometry_and_diagnostics_go_on(veteran):
    r, drive, _ = veteran
    drive.go(r, 20)
    r.settle()
    for topic in r.heard.values():
        topic.clear()
    futures, since, heard = [r.ask("optimize"), r.ask("save")], time.monotonic(), []

    def step(seconds):
        drive.pace(r)(seconds)
        heard.append((time.monotonic() - since, len(r.heard["odometry"]), len(r.heard["tf"])))

    until(lambda: all(future.done() for future in futures), step, "solution", 60.0)
    took_s, counts = time.monotonic() - since, {topic: len(some) for topic, some in r.heard.items()}
    assert all(future.result().success for future in futures)
    assert took_s > 0.2, "or nothing is shown"
    assert counts["odometry"] >= 0.9 * len(heard) - 5, (counts, len(heard))
    assert counts["tf"] >= 0.5 * min(len(heard), took_s / 0.05) - 5, (counts, len(heard), took_s)
    assert counts["diagnostics"] >= 0.5 * took_s - 1, (counts, took_s)
    assert longest_gap(heard, 1) < lenient(0.5), "odometry comes evenly"
    assert longest_gap(heard, 2) < lenient(0.5), "and so do transforms"


def longest_gap(heard, column):
    """How long a count did not grow."""
    at = [b[0] for a, b in itertools.pairwise(heard) if b[column] > a[column]]
    return max(b - a for a, b in itertools.pairwise(at))


def test_two_robots_with_the_shipped_parameters_record_each_into_a_folder_of_its_own(tmp_path):
    shipped = ROOT / "config" / "planar.yaml"
    with contextlib.ExitStack() as stack:
        for name in ("robot1", "fleet/robot2"):
            words = ("--params-file", str(shipped), "-r", f"__ns:=/{name}")
            stack.enter_context(node(cwd=tmp_path, words=words))
        robots = [stack.enter_context(robot(of=f"/{name}/graph_slam")) for name in ("robot1", "fleet/robot2")]
        for r in robots:
            r.wait_for_node()
        names = [r.get(["output.folder"])["output.folder"] for r in robots]
        assert names == ["robot1_graph_slam_run", "fleet_robot2_graph_slam_run"]
        for name in names:
            assert is_run(tmp_path / name)
