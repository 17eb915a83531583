"""Motions of several odometries between keyframes: of other rates, late, with gaps, in other frames."""

import numpy as np
import pytest

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Config, Odometry
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.frontend.parallel_odometry import ParallelOdometry

MS = 1_000_000
T0 = 1_700_000_000_000 * MS
TWIST = (0.04, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.02)


def at(ms):
    """Where the robot is: on a circle of 2 m at 1 m/s."""
    return tuple(map(float, se2.exp((ms / 1000.0, 0.0, ms / 2000.0))))


def message(ms, source="second", origin=se2.IDENTITY):
    return Odometry(T0 + ms * MS, tuple(map(float, se2.compose(origin, at(ms)))), TWIST, source)


class Robot:
    def __init__(self, **settings):
        names = {"inputs.names": "odom second", "second.type": "nav_msgs/msg/Odometry"}
        config = Config.from_mapping(names | settings)
        noise = OdometryNoise(config.odometry, config.space)
        self.path = KeyframeList(noise, config.space)
        self.parallel = ParallelOdometry(config, noise)
        self.late_s = config.ordering.late_s

    def keyframe(self, ms):
        self.path.append(len(self.path.keyframes), Step(T0 + ms * MS, at(ms), at(ms)), self.late_s)

    def hears(self, *messages):
        for m in messages:
            self.parallel.add(m, self.path.keyframes)

    def motions(self, used="odom"):
        return list(self.parallel.motions(self.path, used))


def test_a_motion_is_complete_once_messages_surround_both_stamps():
    robot = Robot()
    robot.keyframe(0)
    robot.hears(*(message(ms, origin=(5.0, 1.0, 2.0)) for ms in range(-30, 480, 60)))
    robot.keyframe(250)
    robot.keyframe(500)
    (one,) = robot.motions()
    assert (one.source, one.vertices) == ("second", (0, 1))
    assert one.motion == pytest.approx(se2.between(at(0), at(250)), abs=2e-4)  # interpolated within 60 ms
    expected = np.diag([0.04, 0.01, 0.02]) * 0.25 * 0.25  # of 0.25 s, errors of which last 0.25 s
    assert np.diag(one.covariance)[[0, 2]] == pytest.approx(np.diag(expected)[[0, 2]], rel=0.2)
    assert robot.motions() == []
    robot.hears(message(510, origin=(5.0, 1.0, 2.0)))
    (two,) = robot.motions()
    assert two.vertices == (1, 2)


def test_messages_may_come_late_and_in_any_order():
    usual, mixed = Robot(), Robot()
    for robot in (usual, mixed):
        robot.keyframe(0)
    some = [message(ms) for ms in range(-50, 700, 50)]
    usual.hears(*some)
    mixed.hears(some[2])
    for ms in (250, 500):
        mixed.keyframe(ms)
        usual.keyframe(ms)
    mixed.hears(some[-1], *some[3::-1], *some[4:])
    assert [m.motion for m in mixed.motions()] == [m.motion for m in usual.motions()]


def test_a_silent_odometry_gives_none_and_goes_on_afterwards():
    robot = Robot()
    robot.keyframe(0)
    robot.hears(*(message(ms) for ms in [*range(-50, 400, 50), *range(2000, 3000, 50)]))
    for ms in range(250, 3000, 250):
        robot.keyframe(ms)
    assert [m.vertices for m in robot.motions()] == [(0, 1), (8, 9), (9, 10), (10, 11)]


def test_one_that_is_dead_does_not_hold_keyframes_for_ever():
    robot = Robot()
    robot.keyframe(0)
    robot.hears(message(-10), message(20))
    for ms in range(250, 30_000, 250):
        robot.keyframe(ms)
    assert robot.motions() == []
    robot.hears(*(message(ms) for ms in range(29_000, 30_000, 50)))
    assert [m.vertices for m in robot.motions()][-1] == (118, 119)


def test_a_jump_is_no_motion_nor_one_into_a_segment():
    robot = Robot()
    robot.keyframe(0)
    messages = [message(ms, origin=(0.0, 0.0, 0.0) if ms < 300 else (90.0, 0.0, 0.0)) for ms in range(-50, 800, 50)]
    robot.hears(*messages)
    robot.keyframe(250)
    robot.keyframe(500)
    robot.parallel.disconnect(3)
    robot.keyframe(750)
    assert [m.vertices for m in robot.motions()] == [(0, 1)]


def test_that_in_use_is_not_beside_itself_and_a_factor_widens_its_noise():
    robot = Robot(**{"second.sigma_factor": 3.0})
    plain = Robot()
    for one in (robot, plain):
        one.keyframe(0)
        one.hears(*(message(ms) for ms in range(-50, 400, 50)), *(message(ms, "odom") for ms in range(-50, 400, 50)))
        one.keyframe(250)
    (wide,), (usual,) = robot.motions(), plain.motions()
    assert wide.source == "second"
    assert wide.covariance == pytest.approx(9.0 * usual.covariance)
