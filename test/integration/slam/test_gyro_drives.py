"""A drive with a gyro against the same without; the gyro of a recording, and what is said of it."""

import json

import numpy as np
import pytest
from gyroscopes import GYRO, drive, driven, errors
from reliability import tell, times

from graph_slam_ros.cli import main
from graph_slam_ros.slam import AngularVelocity
from graph_slam_ros.tools.simulation import simulate
from graph_slam_ros.tools.simulation.bag import write_bag

SEEDS = times(1, 20)
BAND = (1.0, 5.0)
"""Of the mean NEES of 3 numbers: the bias's error is common to all steps, and counted as if it lasted 10 s."""
WORLD = {} if SEEDS > 1 else {"aisles": 2, "laps": 1, "aisle_m": 8.0}
WHEELS = {"turn too much": {"factor": 1.05}, "slip": {"slips": True}}


@pytest.mark.parametrize("wheels", WHEELS)
def test_with_a_gyro_wheels_that_are_wrong_do_less_harm(wheels):
    """Its bias is 0.01 rad/s, found while the robot stands for 5 s."""
    found = []
    for seed in range(SEEDS):
        measured, recording = drive(seed, rest_s=5.0, bias=0.01, **WHEELS[wheels], **WORLD)
        found.append([errors(driven(measured, recording, settings), recording) for settings in ({}, GYRO)])
    without, with_it = np.mean(found, axis=0)
    worse = sum(b[0] > a[0] for a, b in found)
    print(f"{wheels}: error {without[0]:.3f} without, {with_it[0]:.3f} m with; NEES {without[1]:.1f}, {with_it[1]:.1f}")
    tell(f"gyro_{wheels.replace(' ', '_')}", tried=SEEDS, failed=worse)
    assert with_it[0] < 0.5 * without[0]
    assert SEEDS == 1 or BAND[0] < with_it[1] < BAND[1]


def test_a_bias_that_is_never_seen_at_rest_does_no_harm():
    """The robot drives from the first message on: odometry turns alone."""
    measured, recording = drive(0, bias=0.01, factor=1.05, aisles=2, laps=1, aisle_m=4.0)
    without, slam = (driven(measured, recording, settings) for settings in ({}, GYRO))
    assert slam.view.trajectory().tobytes() == without.view.trajectory().tobytes()
    assert slam.view.gyro.state == "waiting"


def test_the_order_of_arrival_changes_nothing_and_a_silent_gyro_leaves_wheels_as_they_are():
    measured, recording = drive(0, rest_s=2.0, bias=0.01, aisles=2, laps=1, aisle_m=4.0)
    rates = [m for m in measured if isinstance(m, AngularVelocity)]
    others = [m for m in measured if not isinstance(m, AngularVelocity)]
    late = sorted(measured, key=lambda m: m.stamp_ns + 20_000_000 * isinstance(m, AngularVelocity))
    usual = driven(measured, recording, GYRO)
    assert driven(late, recording, GYRO).view.trajectory().tobytes() == usual.view.trajectory().tobytes()
    assert usual.counters.used["imu"] > 0.99 * len(rates)
    without = driven(others, recording, {})
    alone = driven(others, recording, GYRO)
    assert alone.view.trajectory().tobytes() == without.view.trajectory().tobytes()
    assert alone.view.gyro.state == "silent"


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A short drive after a rest, with an IMU of bias 0.01 rad/s."""
    path = tmp_path_factory.mktemp("gyro") / "drive.mcap"
    small = {"aisles": 2, "laps": 1, "aisle_m": 4.0}
    write_bag(simulate("warehouse", 3, rest_s=2.0, imu=100.0, imu_bias_rad_s=0.01, **small), path)
    return path


def replayed(bag, out, *settings):
    arguments = [f"--set={name}={value}" for name, value in [*GYRO.items(), ("imu.topic", "/imu/data"), *settings]]
    return main(["replay", str(bag), "--out", str(out), *arguments])


def test_a_recording_with_a_gyro_is_replayed_and_repeated_to_the_same_bytes(bag, tmp_path, capsys):
    assert replayed(bag, tmp_path / "run") == 0
    assert "gyro       bias 0.0" in capsys.readouterr().out
    run = json.loads((tmp_path / "run/run.json").read_text())
    assert run["gyro"]["state"] == "used"
    assert run["gyro"]["bias"][0] == pytest.approx(0.01, abs=4.0 * run["gyro"]["sigma"][0])
    assert run["inputs"]["imu"]["used"] > 0.98 * run["inputs"]["imu"]["received"]
    assert main(["replay", str(tmp_path / "run"), "--out", str(tmp_path / "again")]) == 0
    for name in ("path.tum", "landmarks.csv", "graph.g2o", "ledger.csv"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
