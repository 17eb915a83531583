"""Several publishers on one odometry topic, without ROS: at the border and in recordings."""

import itertools
import math
from collections import Counter
from dataclasses import replace

import numpy as np
from live_drive import TAGS, Drive
from messages import DETECTIONS, odometry, pose, quaternion
from rows import each

from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.messages.one_publisher import OnePublisher
from graph_slam_ros.recordings.bag import BagWriter
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import Odometry

NS = 10**9
ODOMETRY = "nav_msgs/msg/Odometry"


class Publisher:
    """What is handed on of messages, and how many were refused."""

    def __init__(self, timeout_s=0.5):
        self.counts, self.used = Counter(), []
        count = self.counts.update
        self.one = OnePublisher(timeout_s, lambda: count(["refused"]), lambda: count(["ahead"]))

    refused = property(lambda self: self.counts["refused"])
    ahead = property(lambda self: self.counts["ahead"])

    def hear(self, messages):
        for m in messages:
            self.used += self.one.accept(m)
        return self

    def end(self):
        self.used += self.one.finish()
        return self


def circle(t, speed=1.0):
    radius = max(5.0, speed**2 / 5.0)
    angle = speed * t / radius
    return radius * math.sin(angle), radius * (1.0 - math.cos(angle)), angle


def driven(hertz, seconds=10.0, begin=0.0, offset=se2.IDENTITY, late_s=0.0, speed=1.0):
    """Odometry of a robot on a circle, in a frame that is off."""
    times = np.arange(begin, seconds, 1.0 / hertz) + late_s
    return [Odometry(NS + round(t * NS), se2.compose(offset, circle(t, speed)), None, "odom") for t in times]


def mixed(*publishers):
    return sorted(itertools.chain(*publishers), key=lambda m: m.stamp_ns)


@each(
    "begin, mine, others, offset",
    [
        (0.0, 50, 30, (0.3, 0.0, 0.0)),
        (4.0, 10, 100, (0.0, 0.0, 0.4)),
        (0.0, 100, 10, (400.0, 0.0, 3.0)),
        (4.0, 50, 30, (400.0, 0.0, 3.0)),
    ],
)
def test_A34_of_two_publishers_the_first_is_used_and_every_message_of_the_other_is_counted(mine, others, begin, offset):
    used, other = driven(mine), driven(others, 9.0, begin, offset, late_s=0.003)
    p = Publisher().hear(mixed(used, other)).end()
    assert p.used == used
    assert p.refused == len(other)
    third = driven(30, 9.0, 1.0, se2.compose(offset, (1.0, -1.0, 0.5)), late_s=0.004)
    outlier = Odometry(used[-5].stamp_ns + 10**7, (90.0, 0.0, 0.0), None, "odom")
    p = Publisher().hear(mixed(used, other, third, [outlier])).end()
    assert (p.used, p.refused) == (used, len(other) + len(third) + 1)
    p.one.forget_time()
    assert p.hear(used).used == [*used, *used], "where stamps begin anew"


@each("offset", [(0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, *so3.exp((0.5, 0.0, 0.0)))])
def test_A34_in_space_they_are_told_apart_by_where_they_are_and_how_they_are_turned(offset):
    path = [(k * NS // 50, (0.02 * k, 0.0, 0.3, *so3.exp((0.0, 0.0, 0.02 * k)))) for k in range(100, 400)]
    used = [Odometry(stamp_ns, T, None, "odom") for stamp_ns, T in path]
    other = [Odometry(stamp_ns, se3.compose(offset, T), None, "odom") for stamp_ns, T in path[50:200]]
    p = Publisher().hear(mixed(used, other)).end()
    assert (p.used, p.refused) == (used, len(other))


def test_an_odometry_that_jumps_goes_on_there_and_loses_nothing():
    before, after = driven(20, 5.0), driven(40, 10.0, 5.0, (7.0, 7.0, 2.0))
    p = Publisher().hear(before)
    p.hear(after[:30])
    assert p.used == [*before, *after[:30]], "within half a second"
    p.hear(after[30:])
    assert (p.used, p.refused) == ([*before, *after], 0)
    assert Publisher().hear(before).hear(after[:2]).end().used == [*before, *after[:2]], "also where it ends there"


def test_a_late_message_of_another_publisher_is_not_used_and_one_of_the_own_is():
    """Of each, those of half a second come after all others of the time until then."""
    own, other = driven(20), driven(20, offset=(8.0, -3.0, 1.0), late_s=0.013, begin=1.0)
    for late in (own, other):
        held = {id(m) for m in late if NS * 6 < m.stamp_ns < NS * 6.5}
        heard = sorted(mixed(own, other), key=lambda m: NS * 6.6 if id(m) in held else m.stamp_ns)
        p = Publisher(timeout_s=5.0).hear(heard).end()
        assert sorted(m.stamp_ns for m in p.used) == [m.stamp_ns for m in own]
        assert p.refused == len(other)


def test_noise_of_two_centimetres_and_fast_robots_are_no_other_publisher():
    rng, steady = np.random.default_rng(1), driven(20, 60.0)
    noise = np.column_stack([rng.normal(0.0, 0.02, (len(steady), 2)), np.zeros(len(steady))])
    noisy = [replace(m, T_odom_base=tuple(m.T_odom_base + off)) for m, off in zip(steady, noise, strict=True)]
    assert Publisher().hear(noisy).end().refused < 0.02 * len(noisy)
    for hertz, speed in ((1, 2.0), (10, 3.0), (10, 30.0), (50, 30.0)):
        fast = driven(hertz, 20.0, speed=speed, begin=0.0)
        assert Publisher().hear(fast).end().used == fast, (hertz, speed)


@each("ahead_s", [3, 55, 3600])
def test_what_is_far_ahead_is_refused_where_odometry_goes_on_without_it_and_used_where_it_goes_on_there(ahead_s):
    used, other = driven(20), driven(20, 10.0, 0.0, (5.0, 5.0, 1.0), late_s=0.01)
    later = [Odometry(m.stamp_ns + (10 + ahead_s) * NS, m.T_odom_base, None, "odom") for m in used]
    p = Publisher().hear(mixed(used[:100], other[:100]))
    for k in range(100, 150):
        p.hear(later[k - 100 : k - 99]).hear(mixed(used[k : k + 1], other[k : k + 1]))
    assert (p.used, p.ahead) == (used[:150], 50)
    p.hear(used[150:])
    p.hear(later)
    assert (p.used, p.ahead) == (used + later, 50)


def test_after_a_gap_what_comes_out_of_order_or_seldom_is_used_and_what_is_last_of_all_and_alone_is_not():
    used, gap = driven(20), driven(20, 40.0, 30.0)
    p = Publisher().hear(used).hear([gap[1], gap[0], *gap[2:]])
    assert (p.used, p.ahead) == ([*used, gap[1], gap[0], *gap[2:]], 0)
    seldom = [Odometry(NS + k * 5 * NS // 2, (0.0, 0.0, 0.0), None, "odom") for k in range(10)]
    assert Publisher().hear(seldom).end().used == seldom
    p = Publisher().hear(used).hear(gap[:1]).end()
    assert (p.used, p.ahead) == (used, 1)


def record(file, ends):
    """A drive of 30 s; the other odometry drifts to the other side, from a start of its own."""
    drive, other, truth = Drive(10**18), (5.0, -2.0, 0.7), []
    with BagWriter(file) as bag:
        for k in range(300):
            if k < ends:
                bag.write("/odom", ODOMETRY, drive.stamp_ns, drive.odometry())
            x, y, yaw = other
            at = pose(x, y, 0.0, quaternion(yaw=yaw))
            bag.write("/odom", ODOMETRY, drive.stamp_ns, odometry(at, stamp_ns=drive.stamp_ns + 40_000_000))
            if k % 3 == 0:
                bag.write("/landmarks", DETECTIONS, drive.stamp_ns, drive.seen())
            truth.append(drive.truth)
            drive.move()
            other = tuple(map(float, se2.compose(other, (0.1, 0.0, 0.98 * drive.turn))))
    return truth


@each("ends", [150, 300])
def test_A34_a_recording_of_two_odometries_on_one_topic_gives_what_one_would_also_where_the_first_ends(tmp_path, ends):
    truth = record(tmp_path / "two.mcap", ends)
    done = replay(tmp_path / "two.mcap", tmp_path / "run")
    assert done.slam.view.segments == [0], "no segment begins"
    k = round((done.slam.view.keyframes[-1].stamp_ns - 10**18) / 10**8)
    assert k > 290 and math.dist(done.slam.view.trajectory()[-1][:2], truth[k][:2]) < 0.3
    counters = done.summary["counters"]
    assert counters["odom#2"]["switched_to"] == 1 if ends < 300 else counters["odom"] == {"other_publisher": 300}
    for name, at in TAGS.items():
        there = done.slam.view.solver.estimate([done.slam.view.landmarks[name].vertex])[0, :2]
        assert math.dist(there, at) < 0.3
