"""The check of the inputs while the robot drives: the finding of a replay, with what mends it."""

import math

import pytest

from graph_slam_ros.lie import se2
from graph_slam_ros.node.input_check import InputCheck
from graph_slam_ros.slam import Config, Counters, Odometry, Sighting, Sightings

NS = 1_000_000_000
TAGS = {f"t{k}": (4.0 * math.cos(k), 4.0 * math.sin(k)) for k in range(6)}


def checked(steps, unit=1.0, y=1.0, check=None, rate_hz=20):
    """A robot that drives in a circle and sees six tags all the time, with its sensor's unit, and direction of y."""
    check = check or InputCheck(Config(), {"odom": "/odom", "detections": "/tags"}, Counters())
    for k in range(steps):
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
    run_job(check)
    return check


def run_job(check):
    check._due_s = 0.0
    job = check.job()
    assert check.job() is None, "the next is due later"
    job()


@pytest.mark.parametrize(
    "sensor, text",
    [
        ({}, None),
        ({"unit": 1000.0}, "units: /tags: the median distance of landmarks is "),
        ({"y": -1.0}, "mirrored: /tags: in turns, two sightings of a landmark differ by "),
    ],
)
def test_an_input_that_contradicts_odometry_is_named_with_what_mends_it(sensor, text):
    findings = checked(400, **sensor).findings
    assert len(findings) == (text is not None)
    for one in findings:
        assert one.startswith(text)
        assert "correct the driver (REP 103" in one


def test_of_a_few_sightings_nothing_is_said_and_a_driver_that_was_corrected_is_believed_again():
    assert checked(20, unit=1000.0).findings == ()
    check = checked(400, unit=1000.0)
    check.forget()
    assert checked(400, check=check).findings, "not of a part"
    check.forget()
    assert checked(3100, check=check).findings == ()
    assert not len(check._collector.columns(Counters()).path_ns), "it has begun anew"


def test_of_odometry_at_a_high_rate_a_part_is_collected():
    check = checked(400, rate_hz=200)
    assert len(check._collector.columns(Counters()).path_ns) == 40, "in two seconds"
