"""The check of the inputs while the robot drives: the finding of a replay, with what mends it."""

import math

import numpy as np
import pytest
from messages import TWIST, covariance6, encode, header, make, pose, quaternion, vector
from rows import each

from graph_slam_ros.lie import se2
from graph_slam_ros.messages.from_msg import MessageConverter
from graph_slam_ros.messages.inputs.odometry import TYPE
from graph_slam_ros.node import input_check
from graph_slam_ros.node.input_check import InputCheck
from graph_slam_ros.slam import Config, Counters, Odometry, Sighting, Sightings

NS = 1_000_000_000
TAGS = {f"t{k}": (4.0 * math.cos(k), 4.0 * math.sin(k)) for k in range(6)}


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """The time, which each message moves by a second, so that all are looked at."""
    now_s = [100.0]
    monkeypatch.setattr(input_check.time, "monotonic", lambda: now_s[0])
    return now_s


def new_check(**settings):
    """A check of /odom and /tags, and what converts messages for it."""
    config, counters = Config.from_mapping({"inputs.tf": False, **settings}), Counters()
    check = InputCheck(Config(), {"odom": "/odom", "detections": "/tags"}, counters)
    return check, MessageConverter(config, counters), counters


def checked(clock, steps, unit=1.0, y=1.0, check=None, rate_hz=20):
    """A robot that drives in a circle and sees six tags all the time, with its sensor's unit, and direction of y."""
    check = check or new_check()[0]
    for k in range(steps):
        clock[0] += 1.0
        stamp_ns, yaw = 10**15 + k * NS // rate_hz, 0.02 * k
        T = (2.0 * math.sin(yaw), 2.0 - 2.0 * math.cos(yaw), yaw)
        check.add("/odom", ["odom"], stamp_ns, [Odometry(stamp_ns, T, None, "odom")])
        local = {name: se2.act(se2.inverse(T), at) for name, at in TAGS.items()}
        seen = [
            Sighting(name, "position", (unit * at[0], y * unit * at[1]), (0.01, 0.0, 0.0, 0.01))
            for name, at in local.items()
        ]
        if k % 5 == 0:
            check.add("/tags", ["detections"], stamp_ns, [Sightings(stamp_ns, "detections", tuple(seen))])
    run_job(check, clock)
    return check


def run_job(check, clock):
    clock[0] += 1e6
    job = check.job()
    assert check.job() is None, "the next is due later"
    if job is not None:  # so little is not looked at
        job()


@each(
    "sensor, text",
    [
        ({}, None),
        ({"unit": 1000.0}, "units: /tags: the median distance of landmarks is "),
        ({"y": -1.0}, "mirrored: /tags: in turns, two sightings of a landmark differ by "),
    ],
)
def test_an_input_that_contradicts_odometry_is_named_with_what_mends_it(sensor, text, clock):
    findings = checked(clock, 400, **sensor).findings
    assert len(findings) == (text is not None)
    for one in map(str, findings):
        assert one.startswith(text)
        assert "correct the driver (REP 103" in one


def odometry(k, stamp_ns=None, unit=1.0, x=0.0, yaw=None, twist=None, covariance=TWIST):
    """A message of a robot that drives in a circle at 2 m/s."""
    turned = 0.05 * k
    x, y = x + 2.0 * math.sin(turned), 2.0 - 2.0 * math.cos(turned)
    speed = make("geometry_msgs/msg/Twist", linear=vector(0, 0), angular=vector(0, 0))
    speed.linear.x, speed.linear.y, speed.angular.z = map(float, twist(turned) if twist else (2.0, 0.0, 1.0))
    where = pose(unit * x, unit * y, 0.0, quaternion(yaw=turned if yaw is None else yaw(turned)))
    return encode(
        make(
            TYPE,
            header=header(10**15 + k * NS // 20 if stamp_ns is None else stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=covariance6(TWIST, 0.0)),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=speed, covariance=covariance6(covariance, 0.0)),
        )
    )


@each(
    "wrong, text",
    [
        ({}, None),
        ({"unit": 1000.0}, "units: /odom: the robot drives at 2000 m/s: is its position in metres?"),
        ({"yaw": math.degrees}, "units: /odom: the orientation turns at "),
        ({"yaw": lambda _: 0.0}, "no_orientation_of_odometry: /odom: its orientation never changes in "),
        ({"stamp_ns": 10**15}, "constant_stamps: /odom: all of its 396 messages have the stamp 1000000.000 s"),
        ({"twist": lambda a: (2 * math.cos(a), 2 * math.sin(a), 1.0)}, "twist_frame: /odom: the twist is given along"),
        ({"twist": lambda _: (2.0, 0.0, 57.3)}, "twist_scale: /odom: the pose moves 0.0175 times as far as the turn"),
        ({"twist": lambda _: (0.0, 0.0, 0.0)}, None),
        ({"unit": 0.0, "yaw": lambda _: 0.0}, "pose_stands: /odom: its pose never changes, though its twist says 2.0"),
        ({"covariance": 1e4 * TWIST}, "covariance_useless: /odom: the sigma of the twist is 20 m/s, but the robot"),
    ],
)
def test_odometry_is_checked_by_itself_with_its_twist(wrong, text, clock):
    check, converter, _ = new_check()
    for k in range(400):
        clock[0] += 1.0
        measured = converter.convert("odom", odometry(k, **wrong))
        check.add("/odom", ["odom"], 10**15 + k * NS // 20, measured, converter.decoded)
    run_job(check, clock)
    assert len(check.findings) == (text is not None), check.findings
    for one in map(str, check.findings):
        assert one.startswith(text)


def test_two_publishers_on_a_busy_machine_have_no_wrong_units(clock):
    """A lost message is sent again up to 0.6 s later; until then none of its publisher comes."""
    rng, at_s, arrivals, again_s = np.random.default_rng(0), 100.0, [], [0.0, 0.0]
    for k in range(1000):
        at_s += 0.022 + (rng.exponential(0.2) if rng.random() < 0.1 else 0.0)
        for which in (0, 1) if 200 < k < 800 else (0,):
            if rng.random() < 0.02:
                again_s[which] = max(again_s[which], at_s + rng.uniform(0.05, 0.6))
            arrivals.append((max(at_s, again_s[which]), which, k))
    check, converter, counters = new_check(**{"odometry.timeout_s": 10.0})
    for clock[0], which, k in sorted(arrivals):
        stamp_ns = 10**15 + k * 30_000_000 + which * 10_000_000
        cdr = odometry(0.6 * k, stamp_ns=stamp_ns, x=80.0 * which)
        check.add("/odom", ["odom"], stamp_ns, converter.convert("odom", cdr), converter.decoded)
        if (job := check.job()) is not None:
            job()
        assert check.findings == ()
    assert counters["odom", "other_publisher"] > 300
