"""Stamps at the ends of what a message can say: what is wrong counts, and what is right gives what it gives without."""

from dataclasses import replace

import numpy as np
import pytest
from messages import (
    STAMP_NS,
    border,
    counted,
    detection,
    detections,
    gnss,
    odometry,
    pose,
    quaternion,
    record_drive,
    transforms,
)
from reliability import tell
from rows import each

from graph_slam_ros.formats.cdr import LATEST_NS
from graph_slam_ros.messages import to_msg
from graph_slam_ros.overview.chosen_inputs import choose_inputs
from graph_slam_ros.recordings.bag import open_bag
from graph_slam_ros.runs.replay import RecordedRuns
from graph_slam_ros.slam import Config, Control, GraphSlam

S = 1_000_000_000
FIX = "sensor_msgs/msg/NavSatFix"
CONFIG = Config.from_mapping(
    {"inputs.names": "odom detections gps", "gps.type": FIX, "gps.topic": "fix", "ordering.max_waiting": 100}
)
AT = 10  # odometry messages, before what is wrong comes
TURRET = "base_link", "turret", (0.0, 0.0, 0.0), quaternion(yaw=1.0)


class Recording:
    """A drive of 4 s in memory, read as a bag is; what is wrong is put in after odometry messages."""

    def __init__(self, bag, wrong, times):
        self._bag, self._wrong, self._times = bag, wrong, times
        self.topics, self.warnings = bag.topics, []

    def messages(self, topics):
        heard = 0
        for m in self._bag.messages(topics):
            yield m
            heard += m.topic == "/odom"
            if m.topic == "/odom" and AT <= heard < AT + self._times:
                for topic, make in self._wrong:
                    yield replace(m, topic=topic, cdr=make(heard))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return open_bag(record_drive(tmp_path_factory.mktemp("drive") / "drive.mcap", 4))


def run(bag):
    slam, runs = GraphSlam(CONFIG), RecordedRuns(bag, choose_inputs(bag, CONFIG), CONFIG)
    for _, some in runs:
        for m in some:
            slam.process(m)
    for event in ("end", "optimize"):
        slam.process(Control(event))
    runs.counters.update(slam.counters)
    return slam, runs.counters.as_dict()


@pytest.fixture(scope="module")
def clean(drive):
    return run(drive)


def odom(stamp_ns=STAMP_NS, **stamp):
    return ("/odom", lambda k: odometry(pose(6.0, 0.3), stamp_ns=stamp_ns + k, **stamp))


def seen(stamp_ns):
    return ("/landmarks", lambda k: detections(detection(), frame="base_link", stamp_ns=stamp_ns + k))


def turned(stamp_ns):
    return ("/tf", lambda k: transforms(TURRET, stamp_ns=stamp_ns + k))


def fixed(stamp_ns):
    return ("/fix", lambda k: gnss(48.001, 11.001, stamp_ns=stamp_ns + k))


END_NS = LATEST_NS - 1000
WRONG = {
    "odometry at the end of time": ([odom(END_NS)], 1, "odom", {"future": 1}),
    "odometry an hour ahead": ([odom(STAMP_NS + 3600 * S)], 5, "odom", {"future": 5}),
    "odometry half a minute ahead": ([odom(STAMP_NS + 33 * S)], 1, "odom", {"future": 1}),
    "odometry at the beginning of time": ([odom(1)], 5, "odom", {"late": 5}),
    "detections at the end of time": ([seen(END_NS)] , 3, "detections", {"after_odometry": 3}),
    "so many that nothing else could wait": (
        [seen(END_NS - 60 * j) for j in range(10)], 20, "detections", {"after_odometry": None, "overflow": None}
    ),
    "detections at the beginning of time": ([seen(1)], 3, "detections", {"before_odometry": 3}),
    "a joint at the end of time": ([turned(END_NS)], 1, "tf", {"far_in_time": 1}),
    "a joint again and again": ([turned(END_NS)], 20, "tf", {"far_in_time": 20}),
    "a joint at the beginning of time": ([turned(1)], 1, "tf", {"far_in_time": 1}),
    "fixes at the end of time": ([fixed(END_NS)], 3, "gps", {"after_odometry": 3}),
    "fixes at the beginning of time": ([fixed(1)], 3, "gps", {"before_odometry": 3}),
}  # fmt: skip


@each("name", WRONG)
def test_B25_what_is_dated_beyond_all_else_counts_and_the_rest_gives_what_it_gives_without(drive, clean, name):
    wrong, times, source, expected = WRONG[name]
    slam, counts = run(Recording(drive, wrong, times))
    found = {reason: n for reason, n in counts[source].items() if n != clean[1].get(source, {}).get(reason)}
    assert found.keys() == expected.keys()
    assert sum(found.values()) == times * len(wrong), "each is counted once"
    assert all(n is None or n == found[reason] for reason, n in expected.items())
    np.testing.assert_array_equal(slam.view.trajectory(), clean[0].view.trajectory())
    tell("extreme_stamps", tried=times * len(wrong), failed=0)


@each("start_ns", [1, S - 1, LATEST_NS - 7 * S])
def test_B25_a_drive_that_begins_or_ends_where_time_does_is_the_same_drive(tmp_path, monkeypatch, clean, start_ns):
    monkeypatch.setattr("messages.STAMP_NS", start_ns)
    slam, counts = run(open_bag(record_drive(tmp_path / f"{start_ns}.mcap", 4)))
    assert counts == clean[1]
    np.testing.assert_allclose(slam.view.trajectory(), clean[0].view.trajectory(), atol=1e-9)


def test_B25_an_offset_does_not_lead_beyond_the_end_of_time_and_results_are_not_dated_there():
    for offset_s, reason in ((2.0, "bad_stamp"), (-2.0, "")):
        b = border(odom={"offset_s": offset_s})
        assert len(b.convert("odom", odometry(stamp_ns=LATEST_NS - S))) == (not reason)
        assert counted(b) == ({"odom": {reason: 1}} if reason else {})
    late, latest = (to_msg.transform(ns, "map", "odom", (0.0,) * 3) for ns in (LATEST_NS + 1, LATEST_NS))
    assert late == latest
