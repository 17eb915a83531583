"""A satellite receiver and an IMU on the robot of any world.

The world's x points east, y north and z up; its origin is at ``DATUM``.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import Generator

from graph_slam_ros.lie import se3, so3
from graph_slam_ros.messages.inputs.fixes import geodetic
from graph_slam_ros.tools.simulation.options import checked, option, random
from graph_slam_ros.tools.simulation.recording import Gnss, Imu, Recording, Stamps, VelocityNoise
from graph_slam_ros.typing import Array

DATUM = (47.4, 8.55, 440.0)  # latitude [deg], longitude [deg], height above the ellipsoid [m] of the world's origin
ANTENNA_M = (0.3, 0.1, 0.8)  # in base_link
T_BASE_IMU = (0.1, 0.0, 0.2, 0.0, 0.0, float(np.sqrt(0.5)), float(np.sqrt(0.5)))  # turned to the left
UP = 2.0  # a fix is so many times worse upwards
SIGMA_RAD, CORRELATION_S = 0.02, 5.0  # of the orientation of the IMU, and how long such an error lasts (1/e)
SIGMA_RATE_RAD_S, SIGMA_ACCELERATION_M_S2 = 0.002, 0.02
GRAVITY_M_S2 = 9.81
_STREAM = 1  # of the seed: the drive is the same with and without instruments


@checked("instruments")
def with_instruments(
    recording: Recording,
    seed: int,
    rest_s: float = option(0.0, "the robot stands so long before it moves", "s", 0, 1e4),
    landmarks: bool = option(True, "whether the robot sees landmarks at all"),
    apriltag: bool = option(False, "tags are published as apriltag_ros does: on /tf, below the frame of a camera"),
    gnss: float = option(0.0, "fixes of a satellite receiver, on /gps/fix; 0: there is none", "Hz", 0, 100),
    gnss_sigma_m: float = option(0.3, "error of a fix east and north; twice that upwards", "m", 1e-3, 100),
    gnss_correlation_s: float = option(2.0, "how long such an error lasts (1/e)", "s", 0, 1e4),
    gnss_outage_s: float = option(0.0, "time without a fix, in the middle of the drive", "s", 0),
    imu: float = option(0.0, "messages of an IMU with orientation, on /imu/data; 0: there is none", "Hz", 0, 1000),
    imu_drift_rad_s: float = option(0.0, "its heading drifts besides: there is no compass", "rad/s", -1, 1),
    imu_bias_rad_s: float = option(0.0, "bias of its turn rates, about each axis", "rad/s", -10, 10),
    imu_bias_walk: float = option(0.0, "random walk of that", "rad/s/sqrt(s)", 0, 1),
) -> Recording:
    """A satellite receiver and an IMU are added; or landmarks are left out."""
    recording = _stood(recording, rest_s) if rest_s else recording
    added: dict[str, Any] = {"apriltag": apriltag} if landmarks else {"seen": ()}
    if gnss > 0.0:
        sigmas = gnss_sigma_m * np.array([1.0, 1.0, UP])
        noise = VelocityNoise(tuple(sigmas.tolist()), gnss_correlation_s)
        added["gnss"] = _gnss(random(seed, _STREAM, 0), recording, gnss, noise, gnss_outage_s)
    if imu > 0.0:
        measured = _imu(random(seed, _STREAM, 1), recording, imu, imu_drift_rad_s)
        steps = imu_bias_walk * np.sqrt(1.0 / imu) * random(seed, _STREAM, 2).standard_normal(measured.rate.shape)
        added["imu"] = replace(measured, rate=measured.rate + imu_bias_rad_s + np.cumsum(steps, axis=0))
    return replace(recording, **added)


def _stood(recording: Recording, rest_s: float) -> Recording:
    """The same drive after some time at rest."""
    first_ns, second_ns = recording.stamps_ns[:2].tolist()
    count = round(rest_s * 1e9 / (second_ns - first_ns))
    names = ("T_odom_base", "twist", "odom_covariance", "T_world_base")
    kept = {name: getattr(recording, name) for name in names}
    longer: dict[str, Any] = {k: np.concatenate([np.repeat(rows[:1], count, axis=0), rows]) for k, rows in kept.items()}
    return replace(
        recording,
        stamps_ns=first_ns + (second_ns - first_ns) * np.arange(len(recording.stamps_ns) + count),
        seen=tuple(replace(one, stamp_ns=one.stamp_ns + count * (second_ns - first_ns)) for one in recording.seen),
        **longer,
    )


def _gnss(rng: Generator, recording: Recording, rate_hz: float, noise: VelocityNoise, outage_s: float) -> Gnss:
    stamps_ns, poses = _true_poses(recording, rate_hz)
    antenna = np.stack(se3.act(tuple(poses.T), ANTENNA_M), axis=1)
    measured = antenna + noise.draw(rng, len(poses), 1.0 / rate_hz)
    from_middle_s = np.abs(stamps_ns - (stamps_ns[0] + stamps_ns[-1]) // 2) * 1e-9
    has_fix = from_middle_s >= 0.5 * outage_s
    return Gnss(stamps_ns, geodetic(measured, DATUM), noise.covariance, has_fix, ANTENNA_M)


def _imu(rng: Generator, recording: Recording, rate_hz: float, drift_rad_s: float) -> Imu:
    stamps_ns, poses = _true_poses(recording, rate_hz)
    dt_s = 1.0 / rate_hz
    noise = VelocityNoise((SIGMA_RAD,) * 3, CORRELATION_S)
    error = noise.draw(rng, len(poses), dt_s)
    error[:, 2] += drift_rad_s * dt_s * np.arange(len(poses))
    true = se3.compose(tuple(poses.T), T_BASE_IMU)
    turned = se3.rotation(true)
    orientation = so3.normalize(so3.compose(so3.exp(tuple(error.T)), turned))
    next_, last = (tuple(column[part] for column in true) for part in (slice(1, None), slice(None, -1)))
    rate = np.zeros((len(poses), 3))
    rate[1:] = np.stack(se3.local(next_, last)[3:], axis=1) / dt_s
    felt = _second_derivative(np.stack(se3.position(true), axis=1), dt_s) + np.array([0.0, 0.0, GRAVITY_M_S2])
    acceleration = np.stack(so3.act(so3.inverse(turned), tuple(felt.T)), axis=1)
    rate += SIGMA_RATE_RAD_S * rng.standard_normal(rate.shape)
    acceleration += SIGMA_ACCELERATION_M_S2 * rng.standard_normal(acceleration.shape)
    return Imu(stamps_ns, np.stack(orientation, axis=1), noise.covariance, rate, acceleration, T_BASE_IMU)


def _second_derivative(positions: Array, dt_s: float) -> Array:
    """The second derivative of positions (n, 3) over time. The ends get the values of their neighbours."""
    out = np.zeros_like(positions)
    if len(positions) > 2:
        out[1:-1] = np.diff(positions, 2, axis=0) / dt_s**2
        out[0], out[-1] = out[1], out[-2]
    return out


def _true_poses(recording: Recording, rate_hz: float) -> tuple[Stamps, Array]:
    """Stamps from the first odometry on, and the true poses (n, 7) then, interpolated between stamps of odometry."""
    ticks_ns = recording.stamps_ns
    count = int((ticks_ns[-1] - ticks_ns[0]) * 1e-9 * rate_hz) + 1
    stamps_ns = ticks_ns[0] + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    before = np.clip(np.searchsorted(ticks_ns, stamps_ns, side="right") - 1, 0, len(ticks_ns) - 2)
    fraction = (stamps_ns - ticks_ns[before]) / (ticks_ns[before + 1] - ticks_ns[before])
    poses = se3.in_space(recording.T_world_base)
    between = se3.interpolate(tuple(poses[before].T), tuple(poses[before + 1].T), fraction)
    return stamps_ns, np.stack(between, axis=1)
