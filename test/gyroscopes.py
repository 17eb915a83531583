"""Drives of a robot whose wheels are wrong, with a gyro: simulated, without a bag."""

from dataclasses import replace

import numpy as np

from graph_slam_ros.lie import so3
from graph_slam_ros.slam import AngularVelocity, Config, Control, GraphSlam, Odometry, Sightings
from graph_slam_ros.tools.simulation import simulate, with_instruments
from graph_slam_ros.tools.simulation.recording import integrate, measurements

TICK_NS, TICK_S = 20_000_000, 0.02
GYRO = {"inputs.names": "odom detections imu", "imu.type": "sensor_msgs/msg/Imu", "imu.use": "gyro"}
TRUE_NOISE = {"odometry.twist_correlation_s": 1.0}  # of the simulated wheels: errors last 0.5 s to either side
SLIPPING = 1.4  # turns of wheels for each turn of the robot


def with_wrong_wheels(recording, factor=1.0, *, slips=False):
    """Wheels that turn by a factor more than the robot, or slip in every other turn."""
    twist = recording.twist.copy()
    twist[:, 2] *= factor
    if slips:
        is_turning = np.convolve(np.abs(twist[:, 2]), np.full(25, 0.04), "same") > 0.3
        number = np.cumsum(np.diff(is_turning, prepend=False) & is_turning)
        twist[is_turning & (number % 2 == 1), 2] *= SLIPPING
    return replace(recording, twist=twist, T_odom_base=integrate((0.0, 0.0, 0.0), twist[1:] * TICK_S))


def drive(seed, *, rest_s=0.0, bias=0.0, every=20, factor=1.0, slips=False, walk=2e-5, **options):
    """What a robot with a gyro measures, in order of stamp, and its recording; few tags are seen."""
    world = simulate("warehouse", seed, sensor="position", rest_s=rest_s, **options)
    recording = with_wrong_wheels(world, factor, slips=slips)
    recording = with_instruments(recording, seed, imu=100.0, imu_bias_rad_s=bias, imu_bias_walk=walk)
    out = [
        replace(m, source="odom") if isinstance(m, Odometry) else m
        for k, m in enumerate(measurements(recording))
        if not isinstance(m, Sightings) or m.stamp_ns // (8 * TICK_NS) % every == 0
    ]
    return sorted([*out, *rates(recording.imu)], key=lambda m: m.stamp_ns), recording


def rates(imu):
    turn = imu.T_base_imu[3:]
    for stamp_ns, rate in zip(imu.stamps_ns.tolist(), imu.rate.tolist(), strict=True):
        yield AngularVelocity(stamp_ns, "imu", (float(so3.act(turn, tuple(rate))[2]),))


def driven(measured, recording, settings):
    """The pipeline after a drive that begins where the robot truly was."""
    start = " ".join(map(repr, recording.T_world_base[0].tolist()))
    slam = GraphSlam(Config.from_mapping({"anchor.pose": start, **TRUE_NOISE, **settings}))
    has_gyro = "imu" in slam.view.config.inputs.names
    for m in [*measured, Control("end"), Control("optimize")]:
        if has_gyro or not isinstance(m, AngularVelocity):
            slam.process(m)
    return slam


def errors(slam, recording):
    """RMS of the position's error [m], and the mean of the squares of some poses' errors in their sigmas (NEES)."""
    at = np.searchsorted(recording.stamps_ns, slam.view.keyframes.stamps_ns)
    truth, found = recording.T_world_base[at], slam.view.trajectory()
    squares = []
    for k in range(5, len(found), 7):
        (covariance,) = slam.view.solver.marginal([int(slam.view.keyframes.ids[k])])
        d = np.array(slam.view.space.group.local(tuple(found[k].tolist()), tuple(truth[k].tolist())))
        squares.append(d @ np.linalg.solve(covariance, d))
    return float(np.sqrt(np.mean(np.sum((found - truth)[:, :2] ** 2, axis=1)))), float(np.mean(squares))
