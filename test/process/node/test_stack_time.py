"""The node with a clock of its own: played, paused, jumping, played again and again."""

import itertools
import json
import time

import pytest
from live_drive import TAGS, Drive
from live_nodes import ENVIRONMENT, finish, node, often, own_domain, replayed, results, robot, until
from rclpy.clock import ClockType, JumpThreshold
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from graph_slam_ros.formats.cdr import LATEST_NS
from graph_slam_ros.node.node import GraphSlamNode
from graph_slam_ros.node.pose_extrapolator import PoseExtrapolator
from graph_slam_ros.slam import Odometry

NS = 10**9
HEARS = "/diagnostics", "/tf", "pose"


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Of each test its own: what is left of others says nothing here."""
    with own_domain() as number:
        monkeypatch.setitem(ENVIRONMENT, "ROS_DOMAIN_ID", number)
        yield


class Played:
    """A drive with /clock."""

    def __init__(self, r, start_s=5_000, **options):
        self.robot, self.drive = r, Drive(start_s * NS, **options)
        self._clock = r.publisher("/clock", Clock)
        until(self._clock.get_subscription_count, r.spin, "subscriber of /clock")

    def tell(self, stamp_ns=None):
        """The time."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(self.drive.stamp_ns if stamp_ns is None else stamp_ns, NS)
        self._clock.publish(message)

    def step(self, seconds=0.02):
        self.tell()
        self.drive.step(self.robot)
        self.robot.spin(seconds)

    def go(self, steps):
        for _ in range(steps):
            self.step(0.01)


def stamps(r):
    """Of the transforms heard."""
    return [t.header.stamp.sec * NS + t.header.stamp.nanosec for m in r.heard["tf"] for t in m.transforms]


def is_ascending(numbers):
    return all(b > a for a, b in itertools.pairwise(numbers))


def numbers(folder):
    return json.loads((folder / "run.json").read_text())


def simulated(folder, *parameters):
    return node(f"output.folder:={folder}", "inputs.reliable:=true", "use_sim_time:=true", *parameters)


# -- jumps -------------------------------------------------------------------------------------------------------------


def test_B7_when_the_clock_jumps_back_the_map_stays_a_segment_begins_and_transforms_go_on(tmp_path):
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("OK", spin=played.step)
        until(lambda: len(r.heard["pose"]) > 20, played.step, "poses")
        r.settle()
        before = stamps(r)
        r.heard["tf"].clear()
        r.heard["pose"].clear()
        played.drive.stamp_ns -= 60 * NS
        begin_ns = played.drive.stamp_ns
        until(lambda: len(r.heard["pose"]) > 20, played.step, "poses after the jump")
        r.until_it_says("OK", spin=played.step)
        r.until_graph(played.step, segments=2)
        assert played.drive.off_by(r) < 1.0, "still in the same map"
        r.settle()
        after = stamps(r)
        finish(n, r)
    assert is_ascending(before)
    assert is_ascending(after)
    assert len(after) > 10
    assert begin_ns <= after[0] < begin_ns + 2 * NS
    told = numbers(tmp_path / "run")
    assert (told["segments"], told["landmarks"]) == (2, len(TAGS))
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def test_messages_of_before_the_jump_that_come_after_it_hold_nothing_up(tmp_path):
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("OK", spin=played.step)
        late = played.drive.odometry()
        played.drive.stamp_ns -= 60 * NS
        begin_ns = played.drive.stamp_ns
        for _ in range(3):
            played.tell()
            r.spin(0.1)
            r.send("/odom", late)
            played.step()
        r.heard["pose"].clear()
        until(lambda: len(r.heard["pose"]) > 10, played.step, "poses after the jump")
        assert played.drive.off_by(r) < 1.0
        r.heard["tf"].clear()
        until(lambda: len(stamps(r)) > 5, played.step, "transforms after the jump")
        assert played.drive.stamp_ns < begin_ns + 30 * NS, "at once"
        assert max(stamps(r)) < played.drive.stamp_ns + NS
        finish(n, r)
    assert numbers(tmp_path / "run")["segments"] == 2
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def test_B8_a_clock_that_goes_back_a_little_is_no_jump(tmp_path):
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("OK", spin=played.step)
        for _ in range(10):
            played.tell(played.drive.stamp_ns - NS // 8)
            played.go(3)
        r.until_it_says("OK", spin=played.step)
        assert r.graph()["segments"] == 1
        assert n.stop()[0] == 0
    assert "jumped" not in n.said


def test_B14_odometry_that_comes_before_the_clock_is_of_the_same_segment(tmp_path):
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        until(lambda: r.heard["pose"], lambda s: (played.drive.step(r), r.spin(s)), "pose")
        r.until_it_says("DEGRADED", "nothing comes on /clock")
        r.until_it_says("OK", spin=played.step)
        assert r.graph()["segments"] == 1
        until(lambda: stamps(r), played.step, "transform")
        assert n.stop()[0] == 0


def test_B7_where_no_clock_tells_that_stamps_have_gone_back_odometry_does(tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        drive.stamp_ns -= 600 * NS
        begin_ns = drive.stamp_ns
        until(lambda: "odometry has gone back in time" in n.said, drive.pace(r), "word of it")
        r.settle()
        for heard in r.heard.values():
            heard.clear()
        until(lambda: len(r.heard["pose"]) > 10 and len(stamps(r)) > 5, drive.pace(r), "poses and transforms")
        r.until_it_says("OK", spin=drive.pace(r))
        r.until_graph(drive.pace(r), segments=2)
        assert drive.off_by(r) < 1.0, "still in the same map"
        assert is_ascending(stamps(r))
        assert begin_ns < min(stamps(r)) < max(stamps(r)) < drive.stamp_ns + NS
        finish(n, r)
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def test_B14_where_another_clock_is_used_a_segment_begins_and_the_map_stays(tmp_path):
    with node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        r.settle()
        assert r.set({"use_sim_time": True}) == (True, "")
        played = Played(r)
        played.drive.truth, played.drive.odom = drive.truth, drive.odom
        r.heard["pose"].clear()
        r.until_it_says("OK", spin=played.step)
        until(lambda: len(r.heard["pose"]) > 10, played.step, "poses by the other clock")
        r.until_graph(played.step, segments=2)
        assert played.drive.off_by(r) < 1.0, "still in the same map"
        finish(n, r)
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def test_B15_what_is_raised_after_a_jump_reaches_nobody_and_is_counted(monkeypatch):
    context = Context()
    context.init(args=[], domain_id=int(ENVIRONMENT["ROS_DOMAIN_ID"]))
    monkeypatch.setattr(PoseExtrapolator, "forget", lambda self: 1 // 0)
    parameters = [Parameter("output.folder", value=""), Parameter("use_sim_time", value=True)]
    slam = GraphSlamNode(context=context, parameter_overrides=parameters)
    called = []
    try:
        slam.trigger_configure()
        slam.trigger_activate()
        back = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        after = slam.get_clock().create_jump_callback(back, post_callback=called.append)
        for seconds in (100, 40):
            slam.get_clock().set_ros_time_override(Time(seconds=seconds, clock_type=ClockType.ROS_TIME))
            for k in range(2):
                slam._run._ingest.receive([Odometry((seconds + k) * NS, (float(k), 0.0, 0.0), None, "odom")], b"")
            until(lambda: slam._run._session.estimate is not None, time.sleep, "estimate")
        assert len(called) == 1, "those who come after it are called"
        assert slam._run.counters["node", "ZeroDivisionError"] == 1
        after.unregister()
    finally:
        slam.finish(1.0)
        slam.destroy_node()
        context.try_shutdown()


def test_B7_where_that_is_asked_for_a_jump_back_saves_the_run_and_begins_another(tmp_path):
    with simulated(tmp_path / "run", "time.on_jump:=reset") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("OK", spin=played.step)
        played.go(60)
        before = r.graph()["keyframes"]
        played.drive.stamp_ns -= 60 * NS
        until((tmp_path / "run-1" / "path.tum").exists, played.step, "new run")
        r.until_it_says("OK", spin=played.step)
        finish(n, r)
    earlier, later = numbers(tmp_path / "run-1"), numbers(tmp_path / "run")
    assert earlier["keyframes"] >= before
    assert (earlier["segments"], later["segments"]) == (1, 1)
    for run in ("run-1", "run"):
        (tmp_path / f"of_{run}").mkdir()
        assert replayed(tmp_path / run, tmp_path / f"of_{run}") == results(tmp_path / run)


def test_B7_where_that_is_asked_for_nothing_is_taken_after_a_jump_until_reset(tmp_path):
    with simulated(tmp_path / "run", "time.on_jump:=stop") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("OK", spin=played.step)
        played.drive.stamp_ns -= 60 * NS
        r.until_it_says("ERROR", "stopped when the clock jumped back", "~/reset begins anew", spin=played.step)
        before = r.graph()["keyframes"]
        played.go(60)
        r.until_it_says("ERROR", spin=played.step)
        assert r.graph()["keyframes"] == before
        assert r.call("reset").success
        r.until_it_says("OK", spin=played.step)
        assert n.stop()[0] == 0
    assert before <= numbers(tmp_path / "run-1")["keyframes"] <= before + 1, "what waited for its turn"


def test_B6_odometry_from_the_future_is_refused_and_holds_no_transform_up(tmp_path):
    with (
        node(f"output.folder:={tmp_path / 'run'}", "inputs.reliable:=true") as n,
        robot(hears=(*HEARS, "odometry")) as r,
    ):
        r.wait_for_node()
        drive = Drive()
        r.until_it_says("OK", spin=drive.pace(r))
        now_ns, drive.stamp_ns = drive.stamp_ns, drive.stamp_ns + 7_200 * NS
        r.send("/odom", drive.odometry())
        drive.stamp_ns = now_ns
        r.spin(0.1)
        for heard in r.heard.values():
            heard.clear()
        until(lambda: len(stamps(r)) > 5 and len(r.heard["odometry"]) > 5, drive.pace(r), "transforms and odometry")
        assert max(stamps(r)) < drive.stamp_ns + NS
        r.settle()
        finish(n, r)
    told = numbers(tmp_path / "run")
    assert told["counters"]["odom"] == {"future": 1}
    assert "odom: future, ahead of the clock: is use_sim_time to be set" in n.said
    assert told["segments"] == 1
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


def test_B25_stamps_at_both_ends_of_time_count_and_the_robot_goes_on_by_a_clock_that_stops_leaps_and_is_zero(tmp_path):
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r, start_s=2**31 - 400)
        r.until_it_says("OK", spin=played.step)
        drive, right_ns = played.drive, played.drive.stamp_ns
        for wrong_ns in (1, NS, right_ns + 300 * NS, LATEST_NS):
            played.go(3)
            right_ns, drive.stamp_ns = drive.stamp_ns, wrong_ns
            r.send("/odom", drive.odometry())
            r.send("/landmarks", drive.seen())
            drive.stamp_ns = right_ns
        for clock_ns in (drive.stamp_ns + 60 * NS, drive.stamp_ns + 120 * NS):
            played.tell(clock_ns)  # forth, and with the next step back: a segment each
            r.spin(0.1)
            played.go(20)
            r.until_it_says("OK", spin=played.step)
        played.tell(0)
        r.spin(0.1)
        played.go(40)
        r.until_it_says("OK", spin=played.step)
        assert r.save().success
        assert drive.off_by(r) < 1.0
        finish(n, r)
        assert "Traceback" not in n.said
    counters = numbers(tmp_path / "run")["counters"]
    assert counters["odom"]["late"] == 2
    assert counters["odom"]["future"] == 2
    assert "node" not in counters
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")


# -- pauses and loops --------------------------------------------------------------------------------------------------


def test_B12_while_the_clock_is_paused_nothing_is_silent_and_services_answer(tmp_path):
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        r.until_it_says("OK", spin=played.step)
        played.go(20)
        r.settle()
        r.heard["diagnostics"].clear()
        until(lambda: len(r.said()) > 3, r.spin, "diagnostics")
        assert {values["state"] for _, values in r.said()} == {"OK"}
        assert r.save().success
        assert r.call("optimize").success
        played.go(40)
        r.until_it_says("OK", spin=played.step)
        assert r.graph()["segments"] == 1
        assert n.stop()[0] == 0


def test_B11_a_recording_that_is_played_again_and_again_adds_segments_to_one_map(tmp_path):
    loops = often(3)
    with simulated(tmp_path / "run") as n, robot(hears=HEARS) as r:
        r.wait_for_node()
        played = Played(r)
        for _ in range(loops):
            played.drive = Drive(5_000 * NS)
            played.tell()
            r.spin(0.1)
            until(lambda: played.drive.steps >= 120, played.step, "end of the recording")
            r.until_it_says("OK")
        r.settle()
        r.until_graph(segments=loops)
        assert played.drive.off_by(r) < 1.0
        finish(n, r)
    told = numbers(tmp_path / "run")
    assert (told["segments"], told["landmarks"]) == (loops, len(TAGS))
    assert told["keyframes"] > 30 * loops
    assert replayed(tmp_path / "run", tmp_path) == results(tmp_path / "run")
