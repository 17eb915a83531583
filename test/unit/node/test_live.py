"""Parts of the running node, without a graph: what is told of map -> odom, who is ahead, how it is judged."""

import itertools
import math
import time
from dataclasses import replace

import numpy as np
import pytest
from messages import STAMP_NS
from rows import each

pytest.importorskip("tf2_msgs")

from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.node import diagnostics
from graph_slam_ros.node.diagnostics import Facts, InputFacts, Recent, judge, statuses
from graph_slam_ros.node.estimate import doubted_lately
from graph_slam_ros.node.fact_collector import RecentInputs
from graph_slam_ros.node.ingest import FutureStamps
from graph_slam_ros.node.parameters import files_for_others
from graph_slam_ros.node.pose_extrapolator import PoseExtrapolator
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.tf_broadcaster import MapToOdom
from graph_slam_ros.runs.tables import accepted_lately
from graph_slam_ros.slam import Config, Counters, MapView, Odometry, Sighting, Sightings

NS = 1_000_000_000


def test_what_would_be_dated_before_the_last_is_not_told_and_how_much_earlier_is_known():
    policy, tf = MapToOdom(Config()), Config().tf
    assert policy.next(replace(tf, transform_tolerance=9.0), 0, NS, (0.0,) * 3, (0.0,) * 3) is not None
    assert policy.next(tf, 0, 2 * NS, (0.0,) * 3, (0.0,) * 3) is None
    assert policy.behind_s == pytest.approx(8.0 - tf.transform_tolerance)
    assert policy.next(tf, 0, 20 * NS, (0.0,) * 3, (0.0,) * 3) is not None
    assert policy.behind_s == 0.0


def at_work(**settings):
    """A session without a folder, which uses what comes at once."""
    given = {"ordering.window_s": 0.0, "output.folder": ""} | {k.replace("__", "."): v for k, v in settings.items()}
    return Session(Config.from_mapping(given), Counters(), lambda slam, update: None, lambda *_: None)


def tag(at, name="a", variance=1e-4):
    """A sighting of a position."""
    return Sighting(name, "position", tuple(map(float, at)), (variance, 0.0, 0.0, variance))


def round_a_curve(dimensions, every_m):
    """A robot that goes round a curve, with a keyframe after so many metres."""
    rare = {"keyframes__min_distance_m": every_m, "keyframes__min_angle_rad": 3.0, "keyframes__max_interval_s": 1000.0}
    session = at_work(world__dimensions=dimensions, **rare)
    session.ingest([drive(dimensions, k) for k in range(20)])
    return session


def drive(dimensions, k, source="odometry"):
    x, y, turn = 0.5 * k, 0.02 * k * k, 0.04 * k
    stamp = STAMP_NS + k * 10**8
    if dimensions == 2:
        return Odometry(stamp, (x, y, turn), (4e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 9e-4), source)
    q = so3.exp((0.01 * k, 0.02 * k, turn))
    return Odometry(
        stamp, (x, y, 0.1 * k, *map(float, q)), tuple(np.diag([4e-4, 1e-4, 2e-4, 3e-4, 5e-4, 9e-4]).ravel()), source
    )


@each("dimensions, heard_from", [*itertools.product([2, 3], [0, 19])])
def test_odometry_in_the_map_is_ahead_of_the_keyframes_and_as_uncertain_as_a_keyframe_there(dimensions, heard_from):
    rare, often = round_a_curve(dimensions, 3.2), round_a_curve(dimensions, 0.4)
    reckoning = PoseExtrapolator(rare.config)
    for k in range(heard_from, 21):
        assert reckoning.on_odometry(drive(dimensions, k), rare.estimate)
    at, covariance = reckoning.pose(rare.estimate)
    often.ingest([drive(dimensions, 20)])
    slam = often.slam
    assert (slam.view.keyframes[-1].stamp_ns, len(slam.view.keyframes)) == (drive(dimensions, 20).stamp_ns, 21)
    assert rare.estimate.keyframes < 10
    assert at == pytest.approx(slam.view.trajectory()[-1], abs=1e-9)
    assert at == pytest.approx(
        rare.slam.view.space.group.compose(rare.slam.view.T_map_odom, drive(dimensions, 20).T_odom_base), abs=1e-9
    )
    if heard_from == 0:
        assert covariance == pytest.approx(slam.view.pose_covariance, rel=1e-3, abs=1e-6)  # an edge has a least noise


def seen(stamp_ns):
    return [Sightings(stamp_ns, "landmarks", (Sighting("a", "position", (1.0, 0.0), (1.0, 0.0, 0.0, 1.0)),))]


def test_B6_what_is_ahead_of_the_clock_waits_for_it_and_keeps_its_order(monkeypatch):
    clock, refused = [10 * NS], []
    ahead = FutureStamps(1.0, lambda: clock[0], refused.append)
    now, soon, then = seen(11 * NS), seen(13 * NS), seen(5 * NS)
    assert list(ahead.pass_on(now)) == [now]
    assert list(ahead.pass_on(soon)) == []
    assert list(ahead.pass_on(then)) == []  # behind the other
    clock[0] = 12 * NS
    assert ahead.due() == [soon, then]
    assert refused == []
    assert list(ahead.pass_on(seen(20 * NS))) == []
    since = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: since + 1.1)
    assert ahead.due() == []
    assert refused == [seen(20 * NS)]


def test_the_weakest_direction_of_the_newest_pose_and_the_way_without_a_landmark_are_among_the_diagnostics():
    """A robot drives east, sees a tag until 3 m, and then none for 20 m; a jump of its odometry is no way."""
    session = at_work()

    def status(inputs):
        estimate = session.estimate
        facts = Facts("active", inputs, estimate, estimate.weakest(session.config.space))
        return next(
            one for one in statuses(facts, judge(facts, Config()), "node") if one.name == "node: weak directions"
        )

    for k in range(240):
        stamp, x = STAMP_NS + k * NS // 10, 0.1 * k + (50.0 if k > 200 else 0.0)
        session.ingest([Odometry(stamp, (x, 0.0, 0.0), None, "odom")])
        if k <= 30:
            both = tag((5.0 - x, 1.0), variance=5e-3), tag((4.0 - x, -1.0), "surer")
            session.ingest([Sightings(stamp, "tags", both)])
        if k == 30:
            assert session.estimate.unseen.length_m == pytest.approx(0.0, abs=0.5)
            assert "no landmark" not in status((tags(),)).message
    assert session.slam.view.segments[-1] > 0
    assert session.estimate.unseen.length_m == pytest.approx(20.7, abs=0.7)
    seen = status((odom(), tags()))
    for_m = f"; position and heading weak for {session.estimate.unseen.length_m:.0f} m: no landmark seen"
    assert seen.message.endswith(for_m)
    (landmark,), covariance = session.slam.view.landmark_covariances(["a"]), session.slam.view.pose_covariance
    known, sigma = (float(np.sqrt(np.linalg.eigvalsh(one[:2, :2])[-1])) for one in (landmark, covariance))
    assert seen.values["landmark"].startswith(f"landmark a {known:.3f} m ")
    assert "no landmark" not in status((odom(),)).message, "none is used"
    assert seen.values["position"].startswith(f"{sigma:.3f} m ")
    assert seen.values["orientation"] == f"{math.degrees(covariance[2, 2] ** 0.5):.2f} deg heading"


def odom(**values):
    return InputFacts(**{"name": "odom", "topic": "/odom", "use": "odometry", "publishers": ("/driver",)} | values)


def tags(**values):
    return InputFacts(**{"name": "tags", "topic": "/tags", "use": "landmarks", "publishers": ("/eye",)} | values)


def refused(came, **reasons):
    return Recent(came, reasons, goes_on=True)


def active(*inputs, **values):
    return Facts("active", inputs, **values)


STOPPED, LOADING = Finding("stopped", "error"), Finding("loading", "note", text="run-1")


@each(
    "facts, state, reason",
    [
        (Facts("unconfigured"), "UNCONFIGURED", "nobody has configured it: ros2 lifecycle set NODE configure"),
        (Facts("inactive"), "INACTIVE", "nobody has activated it: ros2 lifecycle set NODE activate"),
        (Facts("finalized"), "FINALIZED", ""),
        (active(odom(received=3, recent=refused(3, late=3))), "WAITING", "/odom: all refused in 10 s (late): newer"),
        (active(odom(), of_node=(LOADING,)), "WAITING", "loads the map of run-1"),
        (active(of_node=(LOADING, STOPPED)), "ERROR", "time jumped back and time.on_jump is stop: ~/reset"),
    ],
)
def test_what_is_wrong_before_the_first_estimate_is_named(facts, state, reason):
    verdict = judge(facts, Config())
    assert verdict.state == state
    assert verdict.level == {"WAITING": diagnostics.WARN, "ERROR": diagnostics.ERROR}.get(state, diagnostics.OK)
    assert ("; ".join(verdict.reasons)).startswith(reason)


WELL = odom(received=9, silent_s=0.0)
LOST = tags(received=4, silent_s=0.0, recent=refused(4, frame_unknown=4), frames=(("c", "base_link"),))


@each(
    "values, inputs, reason",
    [
        ({}, (odom(received=9, silent_s=0.9), tags(received=3, silent_s=59.0)), ""),
        ({}, (odom(received=9, silent_s=1.1),), "/odom: silent for 1.1 s"),
        ({}, (WELL, tags(received=3, silent_s=61.0)), "/tags: silent for 61.0 s"),
        ({}, (WELL, tags()), ""),  # nothing was ever seen: there may be nothing
        (
            {},
            (WELL, LOST),
            "/tags: all refused in 10 s (frame_unknown): no transform links c to base_link:"
            " publish the transform on /tf_static, or tags.mount, or frames.base as the messages name it",
        ),
        ({}, (WELL, tags(received=9, silent_s=0.0, recent=refused(90, late=9))), ""),
        ({}, (replace(WELL, late_s=0.2),), ""),
        (
            {},
            (replace(WELL, late_s=0.5),),
            "/odom: comes 0.5 s after its stamps, and so does map -> odom: tf.transform_tolerance:=0.6 dates it ahead;"
            " odom.offset_s for a clock that differs",
        ),
        ({}, (replace(WELL, late_s=3600.0),), ""),  # a recording that is played without its clock
        (
            {"of_node": (Finding("worker_restarted", "warning"),)},
            (),
            "a job would have ended the solver's thread, which",
        ),
    ],
)
def test_at_work_it_is_well_or_degraded_with_the_reason(values, inputs, reason):
    estimate = round_a_curve(2, 3.2).estimate
    verdict = judge(Facts("active", inputs or (WELL,), estimate, **values), Config())
    assert (verdict.state, len(verdict.reasons)) == (("DEGRADED", 1) if reason else ("OK", 0))
    told = list(statuses(Facts("active", inputs, estimate, **values), verdict, "slam"))
    assert told[0].values["healthy"] == str(not reason)
    assert told[0].message.startswith("; ".join(("DEGRADED", reason) if reason else ("OK",)))
    assert told[-1].values["keyframes"] == str(estimate.keyframes)


@each("names", ["a{}", "b{}"])
def test_a_detector_that_begins_anew_is_named(names):
    robot, trees = round_a_curve(2, 0.4), [(4.0 * k, 3.0 + k % 2) for k in range(6)]
    for k in range(20, 60):
        robot.ingest([drive(2, k)])
        here, name = se2.inverse(drive(2, k).T_odom_base), "a{}" if k < 40 else names
        some = tuple(tag(se2.act(here, at), name.format(j)) for j, at in enumerate(trees))
        robot.ingest([Sightings(drive(2, k).stamp_ns, "tags", some)])
    robot.evaluate()
    reasons = judge(Facts("active", (), robot.estimate), Config()).reasons
    said = "all ids are new, and 6 of 6 landmarks lie where others were"
    assert [said in one for one in reasons if one.startswith("ids_renewed: ")] == [True] * (names == "b{}")


def test_an_input_of_which_most_is_not_accepted_lately_is_named():
    robot = round_a_curve(2, 0.4)
    for k in range(20, 60):
        at = (5.0, 1.0) if k < 26 else (5.0 + 3.0 * (k % 3), 9.0 - 4.0 * (k % 2))
        robot.ingest([drive(2, k)])
        seen = (tag(se2.act(se2.inverse(drive(2, k).T_odom_base), at)),)
        robot.ingest([Sightings(drive(2, k).stamp_ns, "tags", seen)])
        assert k != 26 or doubted_lately(robot.slam.view) == (), "of a few nothing is said"
    believed, count = accepted_lately(robot.slam.view)["tags"]
    assert believed < 0.5 * count
    robot.evaluate()
    said = f"tags: only {believed} of {count} are believed: graph_slam explain RUN says why. "
    assert str(robot.estimate.doubted[0]).startswith(said)
    (reason,) = (one for one in judge(Facts("active", (), robot.estimate), Config()).reasons if "believed" in one)
    assert "--set" not in reason and "tags.noise=sigmas tags.sigma_m=..." in reason
    assert "believed" not in str(judge(Facts("active", (LOST,), robot.estimate), Config()))


def test_odometry_that_is_late_is_no_fault_where_map_to_odom_is_dated_ahead_or_not_sent():
    late = Facts("active", (odom(received=9, silent_s=0.0, late_s=0.5),), round_a_curve(2, 3.2).estimate)
    assert judge(late, Config()).state == "DEGRADED"
    for values in ({"transform_tolerance": 0.6}, {"stamp": "now"}, {"publish_tf": False}):
        config = Config.from_mapping({f"tf.{name}": value for name, value in values.items()})
        assert judge(late, config).state == "OK"


@each("late_s, odometry_s", [(2.0, 0.0), (7.0, 0.0), (7.0, 6.0), (7.0, math.nan), (12.0, 0.0)])
def test_observations_that_are_nearly_too_late_are_named_before_any_is_refused(late_s, odometry_s):
    late = InputFacts("tags", "/tags", "landmarks", 9, 9, silent_s=0.0, publishers=("/camera",), late_s=late_s)
    main = odom(received=9, silent_s=0.0, late_s=odometry_s)
    config = Config.from_mapping({"tf.stamp": "now"})
    verdict = judge(Facts("active", (main, late), round_a_curve(2, 3.2).estimate), config)
    expected = (
        "/tags: comes 7.0 s later than odometry of its time, and is soon refused:"
        " ordering.late_s:=20, or a faster detector; tags.offset_s for a clock that differs"
    )
    assert verdict.reasons == ((expected,) if (late_s, odometry_s) == (7.0, 0.0) else ())


def test_a_detector_that_is_silent_or_sees_nothing_is_named_once_the_robot_has_driven_far():
    estimate = round_a_curve(2, 3.2).estimate
    way = replace(estimate.unseen, length_m=40.0, since_ns=1)
    blind = tags(silent_s=0.0)
    for far, one, reason in (
        (True, replace(blind, received=50), "nothing corrects odometry: /tags: 50 messages came, and nothing in them"),
        (True, blind, "nothing corrects odometry: /tags: /eye publishes it, but nothing has come yet"),
        (True, replace(blind, received=50, used=1), ""),
        (False, blind, ""),
    ):
        facts = Facts("active", (WELL, one), replace(estimate, unseen=way))
        facts = facts if far else replace(facts, estimate=replace(estimate, unseen=replace(way, length_m=20.0)))
        verdict = judge(facts, Config())
        assert verdict.reasons[0].startswith(reason) if reason else verdict.state == "OK", verdict


def test_a_parameter_file_for_other_nodes_is_named(tmp_path):
    file = tmp_path / "p.yaml"
    of = {"graph_slam": True, "/**": True, "/*": True, "slam": False, "robot1: {graph_slam": False, "- what": True}
    for name, is_ours in of.items():
        file.write_text(name if name[0] == "-" else f"{name}: {{ros__parameters: {{}}}}" + "}" * name.count("{"))
        said = list(files_for_others(["--ros-args", "--params-file", str(file)], "/graph_slam"))
        assert len(said) == (not is_ours), name


def test_A35_what_is_refused_is_judged_by_the_last_seconds_wherever_it_was_refused():
    recent, accepted, before, after = RecentInputs(), {}, {"tags": {}}, {"tags": {}}

    def seconds(begin, end, good=0, unlinked=0, unnamed=0):
        for now_s in range(begin, end):
            accepted["tags"] = accepted.get("tags", 0) + good + unnamed
            for counts, reason, times in ((before, "frame_unknown", unlinked), (after, "no_id", unnamed)):
                counts["tags"][reason] = counts["tags"].get(reason, 0) + times
            now = recent.observe(100.0 + now_s, accepted, before, after)["tags"]
        return now.is_bad, now.is_nothing_used

    assert seconds(0, 20, unlinked=5) == (True, True)
    assert [seconds(20 + k, 21 + k, good=5)[0] for k in range(4)] == [True, True, False, False], "within three seconds"
    assert seconds(24, 44, good=17, unnamed=3) == (True, False)
    assert seconds(44, 64, good=19, unnamed=1) == (False, False), "a twentieth"


def test_while_an_association_is_not_to_be_believed_the_node_is_degraded(monkeypatch):
    report = {"is_whole": True, "is_doubtful": True, "missing_part": 0.11, "lost_part": 0.013, "clocks": {}}
    monkeypatch.setattr(MapView, "association_report", property(lambda slam: report))
    verdict = judge(Facts("active", (WELL,), round_a_curve(2, 3.2).estimate), Config())
    assert verdict.state == "DEGRADED"
    assert verdict.reasons[0].startswith("sightings without identity: 11 % of the landmarks that should be seen")
