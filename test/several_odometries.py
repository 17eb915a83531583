"""Drives of a robot with several odometries: simulated, without a bag."""

from dataclasses import replace

import numpy as np
from gyroscopes import TICK_S, TRUE_NOISE, with_wrong_wheels

from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sightings
from graph_slam_ros.tools.simulation import simulate
from graph_slam_ros.tools.simulation.motion import VelocityNoise, integrate
from graph_slam_ros.tools.simulation.recording import measurements
from graph_slam_ros.tools.simulation.warehouse import Warehouse

BOTH = {"inputs.names": "odom second detections", "second.type": "nav_msgs/msg/Odometry"}
PARALLEL = {**BOTH, "odometry.fusion": "parallel"}


def true_twists(recording):
    """Velocities of the robot (n, 3): the simulated wheels' less their errors."""
    group_steps = np.diff(recording.T_world_base, axis=0)
    heading = recording.T_world_base[:-1, 2]
    turned = np.arctan2(np.sin(group_steps[:, 2]), np.cos(group_steps[:, 2]))
    middle = heading + 0.5 * turned
    forward = np.cos(middle) * group_steps[:, 0] + np.sin(middle) * group_steps[:, 1]
    return np.stack([forward, np.zeros_like(forward), turned], axis=1) / TICK_S


def second_odometry(recording, seed, name="second"):
    """Another odometry of the same drive, as good as the first, with errors of its own."""
    defaults = Warehouse()
    sigmas = defaults.sigma_speed_m_s, defaults.sigma_sideways_m_s, defaults.sigma_turn_rad_s
    noise = VelocityNoise(sigmas, defaults.correlation_time_s)
    true = true_twists(recording)
    measured = true + noise.draw(np.random.default_rng([seed, len(name), sum(map(ord, name))]), len(true), TICK_S)
    return replace(
        recording,
        twist=np.concatenate([np.zeros((1, 3)), measured]),
        T_odom_base=integrate((3.0, -2.0, 1.0), measured * TICK_S),
    )


def slipping(recording, begin_s, seconds, lost=0.3):
    """The same odometry, with wheels that turn without moving the robot: it has driven farther than it did."""
    twist = recording.twist.copy()
    twist[round(begin_s / TICK_S) : round((begin_s + seconds) / TICK_S), 0] /= 1.0 - lost
    start = tuple(recording.T_odom_base[0].tolist())
    return replace(recording, twist=twist, T_odom_base=integrate(start, twist[1:] * TICK_S))


def odometry(recording, name, every=1, late_ns=0):
    """Messages with the stamps at which they come."""
    covariance = tuple(recording.twist_covariance.ravel().tolist())
    rows = zip(recording.stamps_ns.tolist()[::every], recording.T_odom_base[::every].tolist(), strict=True)
    return [(stamp_ns + late_ns, Odometry(stamp_ns, tuple(pose), covariance, name)) for stamp_ns, pose in rows]


def world(seed, every=20, **options):
    """A drive with few looks: its recording, and what was seen."""
    recording = simulate("warehouse", seed, sensor="position", **options)
    looks = [m for m in measurements(recording) if isinstance(m, Sightings)]
    return recording, [(m.stamp_ns, m) for m in looks[::every]]


def in_order(*streams):
    """All messages as they come."""
    return [m for _, m in sorted((one for stream in streams for one in stream), key=lambda one: one[0])]


def driven(measured, recording, settings):
    """The pipeline after a drive that begins where the robot truly was."""
    start = " ".join(map(repr, recording.T_world_base[0].tolist()))
    slam = GraphSlam(Config.from_mapping({"anchor.pose": start, **TRUE_NOISE, **settings}))
    for m in [*measured, Control("end"), Control("optimize")]:
        slam.process(m)
    return slam


__all__ = ["BOTH", "PARALLEL", "driven", "in_order", "odometry", "second_odometry", "slipping", "with_wrong_wheels"]
