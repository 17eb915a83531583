"""A gyro as part of odometry: what its messages add up to, its bias, and whom to believe."""

import math

import numpy as np
import pytest

from graph_slam_ros.config.pipeline import GyroConfig
from graph_slam_ros.slam import AngularVelocity, Config, Counters
from graph_slam_ros.slam.frontend.gyro import GyroFusion, GyroSamples
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise
from graph_slam_ros.slam.frontend.odometry_selector import Step

MS = 1_000_000
T0 = 1_700_000_000_000 * MS


def sample(ms, *rate):
    return AngularVelocity(T0 + ms * MS, "imu", tuple(map(float, rate)), None)


def samples(*some, counters=None):
    out = GyroSamples(GyroConfig(), 1, Counters() if counters is None else counters)
    for one in some:
        out.add(one)
    return out


def turned(gyro, a_ms, b_ms):
    found = gyro.turn(T0 + a_ms * MS, T0 + b_ms * MS)
    return None if found is None else found.angle


def test_a_rate_that_changes_evenly_is_integrated_exactly_whatever_the_stamps():
    stamps = [0, 7, 20, 33, 34, 60, 90]
    gyro = samples(*(sample(ms, 0.01 * ms) for ms in stamps))
    assert turned(gyro, 5, 40) == pytest.approx((0.01 * (40**2 - 5**2) / 2 / 1000,))
    assert turned(gyro, 40, 85) == pytest.approx((0.01 * (85**2 - 40**2) / 2 / 1000,))
    gyro = samples(*(sample(ms, 1.0) for ms in (0, 50, 100, 400, 450, 500)))
    for a_ms, b_ms, angle in ((0, 100, 0.1), (100, 300, None), (300, 420, None), (420, 480, 0.06), (480, 800, None)):
        assert turned(gyro, a_ms, b_ms) == (angle and pytest.approx((angle,))), "a gap is no turn"


def test_each_message_is_counted_once():
    counters = Counters()
    gyro = samples(*(sample(ms, 0.0) for ms in range(0, 100, 10)), counters=counters)
    gyro.begin(T0 + 25 * MS)
    turned(gyro, 25, 55)
    gyro.add(sample(60, 0.0))
    gyro.add(sample(60, 1.0))
    gyro.add(sample(30, 1.0))
    gyro.forget()
    expected = {"before_odometry": 2, "duplicate": 1, "duplicate_stamp": 1, "late": 1, "after_odometry": 4}
    assert (counters.used["imu"], counters.as_dict()) == (3, {"imu": expected})
    # 10 messages: 2 before, 3 used (20, 30, 40), 50 in use, 4 that odometry did not reach


class Robot:
    """Wheels and a gyro, each with its own opinion of how the robot turns; 50 Hz and 100 Hz."""

    def __init__(self, dimensions=2, **settings):
        names = {"inputs.names": "odom imu", "imu.type": "sensor_msgs/msg/Imu", "imu.use": "gyro"}
        config = Config.from_mapping({"world.dimensions": dimensions, **names, **settings})
        self.space, self.counters = config.space, Counters()
        self.config, self.noise = config, OdometryNoise(config.odometry, config.space)
        self.gyro = GyroFusion(config, self.noise, self.counters)
        self.axes = 1 if dimensions == 2 else 3
        self.ms, self.pose, self.fused = 0, self.space.identity, self.space.identity
        self.gyro.fuse(Step(T0, self.pose, self.pose), 0.0)
        self.speaks = True

    def drive(self, seconds, *, speed=0.0, wheels=0.0, gyro=0.0):
        """Go on for a time; the last step is returned."""
        axis = np.eye(self.axes)[-1]
        for _ in range(round(seconds * 50)):
            for ms in (self.ms, self.ms + 10, self.ms + 20) if self.speaks else ():
                if ms == self.ms + 20 or self.ms == 0 or ms % 20:
                    self.gyro.add(sample(ms, *(gyro * axis)))
            self.ms += 20
            moved = (speed * 0.02, *[0.0] * (self.space.dimensions - 1), *(wheels * 0.02 * axis))
            motion = tuple(map(float, self.space.group.exp(moved)))
            self.pose = self.space.normalized(self.space.group.compose(self.pose, motion))
            step = self.gyro.fuse(Step(T0 + self.ms * MS, motion, self.pose), 0.02)
            self.fused = self.space.normalized(self.space.group.compose(self.fused, step.T_last_base))
        return step

    def heading(self):
        return self.space.heading(self.fused)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_bias_is_found_at_rest_and_its_sigma_grows_afterwards(dimensions):
    robot = Robot(dimensions)
    robot.drive(5.0, gyro=0.012)
    after_rest = robot.gyro.state
    assert after_rest.bias[-1] == pytest.approx(0.012, abs=3.0 * after_rest.sigma[-1] + 1e-6)
    assert after_rest.sigma[-1] < 1e-3
    assert robot.heading() == 0.0
    robot.speaks = False
    step = robot.drive(100.0, speed=0.5, wheels=0.3)
    later = robot.gyro.state
    assert later.sigma[-1] == pytest.approx(math.hypot(after_rest.sigma[-1], 1e-4 * math.sqrt(100.0)), rel=1e-3)
    assert later.state == "silent"
    assert step.turn_variance is None and robot.space.angle(step.T_last_base) == pytest.approx(0.006), "the wheels'"
    assert robot.counters["imu", "gyro_silent"] == 4995, "0.1 s are bridged"


@pytest.mark.parametrize("dimensions", [2, 3])
def test_wheels_that_slip_in_a_turn_have_no_part_in_it(dimensions):
    robot = Robot(dimensions)
    robot.drive(5.0, gyro=0.01)
    robot.drive(20.0, speed=0.5, gyro=0.01)
    before = robot.heading()
    step = robot.drive(2.0, speed=0.5, wheels=1.0, gyro=0.51)
    assert robot.heading() - before == pytest.approx(1.0, abs=0.01)  # the gyro: 0.5 rad/s for 2 s
    assert np.linalg.norm(step.T_last_base[:2]) == pytest.approx(0.01, rel=1e-3)  # as far as the wheels say
    of_bias = robot.gyro.state.sigma[-1] ** 2 * 10.0  # its error is common to 10 s
    assert step.turn_variance[-1] == pytest.approx(1e-6 + 5e-5 * 0.51 + of_bias, rel=1e-6)


@pytest.mark.parametrize(
    ("factor", "cause"),
    [
        (180.0 / math.pi, "57.3 times as much as odometry; the gyro is not used. It must be in rad/s: are these"),
        (-1.0, "-1 times as much as odometry; the gyro is not used. It must be counter-clockwise positive"),
        (0.0, "0 times as much as odometry; the gyro is not used. Its axis is not that of the robot"),
    ],
)
def test_a_gyro_that_is_wrong_in_turns_is_not_used_though_the_robot_mostly_goes_straight(factor, cause):
    robot = Robot()
    robot.drive(2.0)
    for rate in (0.5, -0.5, 0.5, -0.5):
        robot.drive(10.0, speed=0.5)
        robot.drive(2.0, speed=0.5, wheels=rate, gyro=factor * rate)
    robot.drive(5.0, speed=0.5)
    assert robot.gyro.state.state == "doubted"
    assert cause in robot.gyro.state.fault
    assert robot.counters["imu", "gyro_doubted"] > 500
    step = robot.drive(1.0, speed=0.5, wheels=0.5, gyro=factor * 0.5)
    assert step.turn_variance is None
    assert robot.space.angle(step.T_last_base) == pytest.approx(0.01)
    for rate in (0.5, -0.5) * 12 if factor < 0.0 else ():  # it is mended
        robot.drive(2.0, speed=0.5, wheels=rate, gyro=rate)
    assert robot.gyro.state.state == ("used" if factor < 0.0 else "doubted")


@pytest.mark.parametrize("wheels", [1.8, 0.6])
def test_wheels_that_slip_in_every_turn_are_no_fault_of_the_gyro(wheels):
    robot = Robot()
    robot.drive(5.0)
    for rate in (0.5, -0.5) * 6:
        robot.drive(2.0, speed=0.5)
        robot.drive(2.0, speed=0.5, wheels=wheels * rate, gyro=rate)
    assert robot.gyro.state.state == "used"
    assert robot.gyro.state.ratio == pytest.approx(1.0 / wheels, abs=0.05)
