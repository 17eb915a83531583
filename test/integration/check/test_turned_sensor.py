"""A sensor that is turned on the robot is named alone: it explains sightings that do not agree with one place."""

import numpy as np
import pytest
from planted_faults import reused
from reliability import times

from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.lie import se2
from graph_slam_ros.runs.check import check
from graph_slam_ros.slam import Sighting, Sightings
from graph_slam_ros.tools.simulation import Drive, write_bag
from graph_slam_ros.tools.simulation.recording import LANDMARKS_TOPIC, START_NS, Recording

SOAK = pytest.mark.skipif(not times(0, 1), reason="only in make soak")


def loops(seed, yaw_deg, hz=12, ahead_m=0.2):
    """A robot that drives more than twice round a rectangle of 10 by 6 m, whose sensor looks ahead and is turned."""
    random, speed, yaw = np.random.default_rng(seed), 0.6, np.deg2rad(yaw_deg)
    landmarks = {str(k): p for k, p in enumerate(np.random.default_rng(7).uniform((-4.0, -4.0), (14.0, 12.0), (20, 2)))}
    time_s = np.arange(140 * hz) / hz
    phase = time_s * speed % 32.0
    turns = np.any([(phase >= a) & (phase < a + 2.0) for a in (8.0, 14.0, 24.0, 30.0)], axis=0)
    twist = np.column_stack([np.full(len(time_s), speed), 0.0 * time_s, turns * np.pi / 4.0 * speed])
    told = twist * (1.02, 1.0, 1.02) + (0.0, 0.0, 0.01) + random.normal(size=twist.shape) * (0.02, 0.0, 0.02)
    paths = []
    for rates in (twist, told):
        pose, path = (0.0, 0.0, 0.0), []
        for rate in rates:
            path.append(pose)
            pose = se2.compose(pose, se2.exp(tuple(rate / hz)))
        paths.append(np.array(path))
    stamps_ns, seen = START_NS + np.round(time_s * 1e9).astype(np.int64), []
    for k in range(0, len(time_s), hz // 6):
        sightings = []
        for name, at in landmarks.items():
            x, y = se2.act(se2.inverse(tuple(paths[0][k])), tuple(at)) - np.array([ahead_m, 0.0])
            far = np.hypot(x, y)
            if x > 0.3 and far < 6.0 and abs(np.arctan2(y, x)) < 0.6:
                point = np.array([x, y]) + random.normal(size=2) * (0.03 + 0.01 * far)
                measured = tuple(map(float, se2.act((0.0, 0.0, -yaw), tuple(point))))
                sightings.append(Sighting(name, "position", measured, (0.0025, 0.0, 0.0, 0.0025)))
        if sightings:
            seen.append(Sightings(int(stamps_ns[k]), LANDMARKS_TOPIC, tuple(sightings)))
    covariance = np.diag([0.02, 0.005, 0.02]) ** 2
    every = np.tile(np.eye(3), (len(time_s), 1, 1))
    return Recording(stamps_ns, paths[1], told, covariance, every, seen, paths[0], landmarks, [])


def codes(file):
    return {one.code for one in check(file).findings if one.severity != "note"}


@SOAK
def test_a_turned_sensor_is_no_reason_to_doubt_identities(tmp_path):
    write_bag(loops(0, -12.0, ahead_m=0.0), tmp_path / "turned.mcap")
    assert codes(tmp_path / "turned.mcap") == {"mount_yaw"}


def test_a_sensor_that_is_turned_and_elsewhere_has_one_setting_that_mends_both(tmp_path):
    write_bag(loops(0, -8.0, ahead_m=0.3), tmp_path / "both.mcap")
    found = {one.code: one for one in check(tmp_path / "both.mcap").findings if one.severity != "note"}
    assert found.keys() == {"mount_yaw", "mount_place"}
    assert found["mount_place"].value == pytest.approx(0.3, abs=0.1)
    (setting,) = {text for one in found.values() for text in one.settings}
    mended = check(tmp_path / "both.mcap", dict([parse_setting(setting)])).findings
    assert not found.keys() & {one.code for one in mended}


def test_an_identity_of_two_landmarks_is_found_with_a_turned_sensor_too(tmp_path):
    write_bag(loops(0, -12.0), tmp_path / "turned.mcap")
    drive = Drive(tmp_path / "turned.mcap")
    reused(drive)
    drive.write(tmp_path / "both.mcap")
    assert codes(tmp_path / "both.mcap") >= {"mount_yaw", "id_reused"}
