"""A clock, a mount or a scale that is off and that nothing corrects is told, and its setting mends it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from imperfect import Faults, driven, imperfect_drive_and_truth
from planted_faults import planted
from reliability import times

from graph_slam_ros.cli import main
from graph_slam_ros.messages.to_msg import WARN
from graph_slam_ros.node.diagnostics import Facts, judge, statuses
from graph_slam_ros.node.estimate import UnseenWay, estimate_of
from graph_slam_ros.runs.outcome import shortcomings
from graph_slam_ros.slam import Config, Sightings

SECONDS = times(45.0, 60.0)
SURE = {"odometry.translation_density": 1e-3, "odometry.lateral_density": 1e-3}
WRONG = [
    (Faults(clock_s=0.2), {}, "clock_offset", 0.2, "detections.offset_s"),
    (Faults(yaw=np.deg2rad(10.0)), {}, "mount_yaw", np.deg2rad(10.0), "detections.mount_correction"),
    (Faults(distance=0.96), SURE, "odometry_scale", -0.04, "odometry.distance_factor"),
]


def nees(view, truth, covariances):
    """Mean of the poses' normalised errors squared, the frame of the map being that of the first pose."""
    true = np.array([truth.at(int(stamp)) for stamp in view.keyframes.stamps_ns])
    error = view.space.group.log(view.space.group.between(tuple(true.T), tuple(view.trajectory().T)))
    every = np.stack(error, axis=-1)
    return float(np.mean(np.einsum("ni,nij,nj->n", every, np.linalg.pinv(covariances), every)))


def of_noise(view):
    """Covariances (n, 3, 3) of the keyframes that take all parameters for known."""
    return np.array(view.solver.marginal(view.keyframes.ids))


@pytest.mark.parametrize("seed", range(times(1, 4)))
@pytest.mark.parametrize(("faults", "settings", "code", "value", "key"), WRONG)
def test_what_is_off_is_told_with_its_sigma_covariances_contain_it_and_the_setting_mends_it(
    faults, settings, code, value, key, seed
):
    drive, truth = imperfect_drive_and_truth(faults, seed=seed, seconds=SECONDS)
    slam = driven(drive, settings)
    noise = of_noise(slam.view)
    assert {sentence.split(" of ")[0] for sentence in slam.view.trials.contradicted()} == {
        *("distance", "turn", "clock", "yaw", "x", "y")
    }
    by_noise = nees(slam.view, truth, noise)
    assert nees(slam.view, truth, slam.view.keyframe_covariances()) < min(6.0, 0.2 * by_noise)  # 3 is expected
    assert np.linalg.eigvalsh(slam.view.keyframe_covariances() - noise).min() > -1e-9
    assert slam.view.pose_covariance == pytest.approx(slam.view.keyframe_covariances()[-1])
    if seed:
        return  # covariances are a matter of many drives
    (one,) = slam.view.uncorrected()
    assert (one.code, one.setting[0]) == (code, key)
    assert one.value == pytest.approx(value, abs=max(0.015, 4.0 * one.sigma))
    assert code in str(one)
    if key == "detections.offset_s":  # which is applied where messages are read
        assert_the_node_says_so(slam)
        drive, truth = imperfect_drive_and_truth(Faults(clock_s=faults.clock_s - one.value), seed=seed, seconds=SECONDS)
        mended = driven(drive, settings)
    else:
        mended = driven(drive, settings | dict([one.setting]))
    assert not mended.view.uncorrected()
    assert not mended.view.trials.contradicted()
    assert nees(mended.view, truth, of_noise(mended.view)) < 0.5 * by_noise


def assert_the_node_says_so(slam):
    """Trials begin at keyframes 50, 100, 200; what they find is told 20 keyframes later, and corrects nothing."""
    view = slam.view
    assert np.trace(view.pose_covariance) > 2.0 * np.trace(view.solver.marginal(view.keyframes.ids[-1:])[0])
    (one,) = view.trials.uncorrected_so_far()
    of = {"is_confirmed": True, "is_resumed": False, "solve_s": 0.0, "slowest_solve_s": 0.0, "fit": 1.0}
    estimate = estimate_of(slam, correction=view.correction, unseen=UnseenWay(0, 0), **of)
    facts = Facts("active", estimate=estimate)
    health = judge(facts, Config())
    assert (health.state, health.level) == ("DEGRADED", WARN)
    assert str(one) in health.reasons[0]
    assert "detections.offset_s=0." in health.reasons[0]
    (calibration,) = [one for one in statuses(facts, health, "slam") if "calib" in one.name]
    assert calibration.message.startswith("nothing corrected; off, not corrected, in the covariances: distance of odom")
    assert "clock of detections 0.2" in calibration.message


@pytest.mark.parametrize("kind", times(["range_bearing"], ["range_bearing", "position", "range"]))
@pytest.mark.parametrize("seed", range(times(1, 4)))
def test_nothing_is_told_of_a_drive_with_nothing_wrong(kind, seed):
    slam = driven(imperfect_drive_and_truth(Faults(), seed=seed, seconds=40.0, kind=kind)[0])
    assert not slam.view.uncorrected()
    assert not slam.view.trials.contradicted()
    np.testing.assert_array_equal(slam.view.keyframe_covariances(), of_noise(slam.view))


def test_the_end_of_a_replay_names_a_wrong_mount(laps, tmp_path, capsys):
    bag, run = planted(laps, tmp_path / "faulty.mcap", "mount turned -10 degrees"), tmp_path / "run"
    assert main(["replay", str(bag), "--out", str(run)]) == 3
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "mount_yaw" in line]
    assert "mount_yaw: detections: its sensor is turned by -" in said
    (one,) = json.loads((run / "run.json").read_text())["uncorrected"]
    assert one["value"] == pytest.approx(np.deg2rad(-10.0), abs=3.0 * one["sigma"])
    ((key, value),) = one["settings"].items()
    assert f"--set '{key}={value}'" in said
    assert main(["replay", str(bag), "--out", str(run), "--force", "--set", f"{key}={value}"]) == 0
    assert "uncorrected" not in json.loads((run / "run.json").read_text())
    assert "mount_yaw" not in capsys.readouterr().err


def test_a_clock_that_was_set_on_the_way_is_told():
    drive, _ = imperfect_drive_and_truth(Faults(), seconds=60.0)
    middle_ns = drive[len(drive) // 2].stamp_ns
    late = [
        replace(m, stamp_ns=m.stamp_ns + 300_000_000) if isinstance(m, Sightings) and m.stamp_ns > middle_ns else m
        for m in drive
    ]
    slam = driven(sorted(late, key=lambda m: m.stamp_ns))
    (one,) = [one for one in slam.view.uncorrected() if one.code == "clock_jump"]
    assert abs(one.value) > 0.15
    assert "in the second half of the drive" in str(one)
    assert one.as_dict()["settings"] == {}
    assert next(shortcomings({"counters": {}, "inputs": {}, "uncorrected": [one.as_dict()]})).startswith(str(one))


def test_a_sensor_that_was_knocked_is_told_and_since_when_though_odometry_was_in_doubt(laps, tmp_path, capsys):
    bag = planted(laps, tmp_path / "faulty.mcap", "knocked by 10 degrees half-way")
    assert main(["replay", str(bag), "--out", str(tmp_path / "run")]) == 3
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "mount_moved" in line]
    assert "is turned by 0 deg on the robot at first, 10 deg since " in said and "fix the sensor on the robot" in said


def test_an_error_of_the_recording_makes_a_fit_meaningless():
    off = {"code": "clock_offset", "text": "clock_offset: ...", "settings": {"detections.offset_s": 0.1}}
    summary = {"counters": {}, "inputs": {}, "uncorrected": [off]}
    axes = {"check": {"severity": "error", "code": "axes", "text": "", "settings": []}}
    for of_check, code in (({}, "clock_offset"), (axes, "axes")):
        assert next(shortcomings(summary | of_check)).startswith(f"{code}: ")
