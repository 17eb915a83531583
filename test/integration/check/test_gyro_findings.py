"""A gyro that is wrong is found against odometry, and the setting that is printed mends it."""

import pytest
from reliability import times

from graph_slam_ros.formats.parameters import parse_setting
from graph_slam_ros.runs.check import check
from graph_slam_ros.tools.simulation import Drive, Fault, put_faults, simulate, with_instruments, write_bag

SETTINGS = {
    "inputs.names": "odom detections imu",
    "imu.type": "sensor_msgs/msg/Imu",
    "imu.topic": "/imu/data",
    "imu.use": "gyro",
}


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    file = tmp_path_factory.mktemp("gyro") / "drive.mcap"
    recording = simulate("warehouse", 3, aisles=2, aisle_m=4.0, laps=1)
    write_bag(with_instruments(recording, 3, imu=50.0), file)
    return file


def of_the_gyro(bag, settings):
    findings = check(bag, SETTINGS | settings, odometry="/odom", landmarks="/landmarks", quick=True).findings
    return {one.code: one for one in findings if one.code.startswith(("gyro", "clock"))}


@pytest.mark.parametrize(
    ("fault", "code", "value", "has_setting"),
    [
        ({"factor": -1.0}, "gyro_scale", -1.0, True),
        ({"factor": 1.0, "bias_rad_s": 0.15}, "gyro_bias", 0.15, True),
        ({"factor": 1.0, "axes": "exchanged"}, "gyro_scale", 0.0, True),
        ({"factor": 57.3}, "gyro_scale", 57.3, False),
        ({"factor": 1.0, "late_s": 4.0}, "gyro_unrelated", None, False),
        ({"factor": 1.2}, "gyro_scale", 1.2, True),
        ({"factor": 1.0, "late_s": 0.4}, "clock_offset", -0.4, True),
        ({"factor": 0.0}, "gyro_scale", 0.0, False),
        ({"factor": 1.0, "noise_rad_s": 0.6}, "gyro_unrelated", None, False),
    ][: times(3, 9)],
)
def test_a_gyro_that_is_wrong_is_found_and_its_setting_mends_it(bag, tmp_path, fault, code, value, has_setting):
    drive = Drive(bag)
    put_faults(drive, [Fault.named("wrong_gyro", **fault)], seed=1)
    drive.write(tmp_path / "faulty.mcap")
    found = of_the_gyro(tmp_path / "faulty.mcap", {})
    assert found.keys() == {code}
    assert value is None or found[code].value == pytest.approx(value, rel=0.1, abs=0.05)
    assert bool(found[code].settings) == has_setting
    if has_setting:
        assert of_the_gyro(tmp_path / "faulty.mcap", dict(map(parse_setting, found[code].settings))) == {}


@pytest.fixture(scope="module")
def laps(tmp_path_factory):
    """Long enough for landmarks to decide whether the gyro or odometry is wrong; first the robot stands."""
    file = tmp_path_factory.mktemp("gyro") / "laps.mcap"
    write_bag(simulate("warehouse", 3, rest_s=2.0, imu=50.0, aisles=2, aisle_m=6.0, laps=2), file)
    return file


@pytest.mark.parametrize(
    ("fault", "setting"),
    [
        *times([], [(Fault.named("wrong_gyro", factor=1.2), "imu.use=none")]),
        (Fault.named("wrong_scale", distance=1.0, turn=1.15), "odometry.turn_factor="),
    ],
)
def test_landmarks_decide_which_of_gyro_and_odometry_is_wrong_and_one_value_is_printed(laps, tmp_path, fault, setting):
    bag, drive = tmp_path / "faulty.mcap", Drive(laps)
    put_faults(drive, [fault], seed=1)
    drive.write(bag)
    found = [one for one in check(bag, SETTINGS).findings if one.severity != "note"]
    assert [one.code for one in found] == ["gyro_scale"]
    (text,) = found[0].settings
    assert text.startswith(setting)
    mended = check(bag, SETTINGS | dict([parse_setting(text)])).findings
    assert [one.code for one in mended if one.severity != "note"] == []


def test_a_gyro_that_is_tilted_and_upside_down_is_turned_over_about_the_robots_axes(bag, tmp_path):
    drive = Drive(bag)
    put_faults(drive, [Fault.named("wrong_gyro", factor=1.0, axes="exchanged")], seed=1)
    drive.write(tmp_path / "faulty.mcap")
    tilted = {"imu.frame": "tilted", "imu.mount": "0 0 0 0 1.2 0"}
    found = of_the_gyro(tmp_path / "faulty.mcap", tilted)["gyro_scale"]
    assert found.value == pytest.approx(-1.0, abs=0.1)
    settings = dict(map(parse_setting, found.settings))
    assert settings["imu.frame"] == "tilted_corrected"
    assert of_the_gyro(tmp_path / "faulty.mcap", settings) == {}
