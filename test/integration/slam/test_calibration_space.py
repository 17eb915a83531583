"""Mounts in space: position and orientation of a sensor are found, or refused with the reason."""

import numpy as np
import pytest
from imperfect import SECOND_NS, START_NS

from graph_slam_ros.lie import se3, so3
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings

MOUNT = {"x": 0.07, "y": -0.06, "z": 0.08, "roll": 0.03, "pitch": -0.04, "yaw": 0.05}
GROUPS = ("yaw", "mount")
STEP_S, SIGMA_M = 0.05, 0.03


def drive(mount, *, tilts, seed=0, seconds=34.0):
    """Measurements by a sensor that is not as configured, of a robot that rolls and pitches by ``tilts`` [rad/s]."""
    random, out = np.random.default_rng(seed), []
    landmarks = 5.0 * random.uniform(-1.0, 1.0, (12, 3)) + (1.0, 2.0, 0.0)
    turned = so3.exp(tuple(mount.get(name, 0.0) for name in ("roll", "pitch", "yaw")))
    T_base_sensor = (*(mount.get(name, 0.0) for name in "xyz"), *map(float, turned))
    pose = odom = se3.IDENTITY
    noise = np.array([0.01, 0.002, 0.002, 0.005, 0.005, 0.01]) * np.sqrt(STEP_S)
    for k in range(round(seconds / STEP_S)):
        t = k * STEP_S
        rates = tilts * np.cos(0.9 * t), tilts * np.cos(0.6 * t), 0.7 * np.sin(0.45 * t) + 0.2
        step = np.array([0.5 + 0.2 * np.sin(0.7 * t), 0.0, 0.0, *rates]) * STEP_S
        pose = se3.compose(pose, se3.exp(tuple(step)))
        odom = se3.compose(odom, se3.exp(tuple(step + noise * random.standard_normal(6))))
        stamp_ns = START_NS + k * round(STEP_S * SECOND_NS)
        out.append(Odometry(stamp_ns, tuple(map(float, odom))))
        if k % 4 == 3:
            to_sensor = se3.inverse(se3.compose(pose, T_base_sensor))
            points = [np.array(se3.act(to_sensor, tuple(one))) for one in landmarks]
            seen = {n: p + SIGMA_M * random.standard_normal(3) for n, p in enumerate(points) if np.linalg.norm(p) < 5.0}
            covariance = tuple((SIGMA_M**2 * np.eye(3)).ravel().tolist())
            sightings = (Sighting(str(n), "position", tuple(map(float, p)), covariance) for n, p in seen.items())
            out.append(Sightings(stamp_ns, "detections", tuple(sightings)))
    return out


def found(measurements, settings):
    """The findings of a trial fit after a drive, by name."""
    densities = {"translation": 0.01, "lateral": 0.002, "vertical": 0.002, "rotation": 0.01, "tilt": 0.005}
    noise = {f"odometry.{name}_density": value for name, value in densities.items()}
    slam = GraphSlam(Config.from_mapping({**noise, "landmarks.added_sigma_m": 0.0, "world.dimensions": 3, **settings}))
    for one in (*measurements, Control("end"), Control("optimize")):
        slam.process(one)
    return {one.parameter.name: one for one in slam.view.trial_fit(GROUPS, is_to_correct=True)[1]}


@pytest.fixture(scope="module")
def wrong():
    return drive(MOUNT, tilts=0.3)


def test_all_six_numbers_of_a_mount_are_found(wrong):
    findings = found(wrong, {})
    for name, truth in MOUNT.items():
        one = findings[name]
        assert one.verdict == "admitted", one.text
        assert one.value == pytest.approx(truth, abs=0.012)
        assert abs(one.value - truth) < 5.0 * one.sigma + 0.1 * abs(truth), one.text


def test_a_level_drive_does_not_tell_the_height_of_a_sensor():
    """All landmarks would be as much higher."""
    findings = found(drive(MOUNT, tilts=0.0), {})
    assert findings["z"].verdict == "not_determined"
    assert "drive up a ramp and down, so that the robot tilts" in findings["z"].text
    for name in ("roll", "pitch", "yaw"):
        assert findings[name].value == pytest.approx(MOUNT[name], abs=0.012)
