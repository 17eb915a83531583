"""Noise that is scaled by its residuals while a robot drives: applied, saved and read back, where it is asked for."""

import json

import numpy as np
import pytest

from graph_slam_ros.analysis.consistency import Consistency, Nees, noise_advice
from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import SingularError
from graph_slam_ros.runs.map_file import read_map
from graph_slam_ros.runs.outcome import noise
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.slam.noise.factors import FIRST_DUE
from graph_slam_ros.slam.noise.scale import NoiseScale
from graph_slam_ros.tools.simulation import simulate, write_bag

CONFIGURED = Config.from_mapping({"robust.noise_scale": "configured"})
ESTIMATED = Config.from_mapping({"robust.noise_scale": "estimated"})


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive whose sightings are better than the default noise says, replayed with either noise."""
    folder = tmp_path_factory.mktemp("noise")
    write_bag(simulate("warehouse", 1, laps=2), folder / "bag.mcap")
    configured = replay(folder / "bag.mcap", folder / "configured", CONFIGURED)
    estimated = replay(folder / "bag.mcap", folder / "estimated", ESTIMATED)
    return folder, configured.slam.view, estimated.slam.view


def test_the_scale_is_said_always_and_applied_where_it_is_asked_for(drive):
    folder, configured, estimated = drive
    assert configured.backend.noise.factors == {}
    assert estimated.backend.noise.factors["landmarks", "detections", "position"] < 0.75
    errors = []
    for name, is_advised in (("configured", True), ("estimated", False)):
        scores = evaluate(folder / name, folder / "bag.mcap")
        (position,) = [one for one in scores.consistency.noise if one.key == ("landmarks", "detections", "position")]
        assert position.factor < 0.75
        assert ("--set robust.noise_scale=estimated" in str(scores)) is is_advised
        assert ("the run used these factors" in str(scores)) is not is_advised
        errors.append(scores.estimate.position_m["rmse"])
    assert errors[1] < 1.05 * errors[0]
    # gates are not made smaller by noise that is made larger for errors that are alike
    assert configured.backend.decisions.gate_scale < estimated.backend.decisions.gate_scale
    assert estimated.backend.decisions.gate_scale == Config().robust.noise_factor ** 2
    noise = json.loads((folder / "configured" / "run.json").read_text())["noise"]
    assert {(one["label"], one["source"], one["part"]) for one in noise} == {
        ("odometry", "odom", "position"),
        ("odometry", "odom", "rotation"),
        ("landmarks", "detections", "position"),
        ("landmarks", "detections", "rotation"),
    }


def test_a_saved_map_has_the_noise_of_the_run_and_a_run_that_goes_on_keeps_it_or_goes_back_to_what_is_configured(drive):
    folder, configured, estimated = drive
    saved = read_map(folder / "estimated")
    assert saved.noise_factors == estimated.backend.noise.factors
    for table, other in zip(saved.graph.tables.values(), estimated.graph.tables.values(), strict=True):
        assert np.array_equal(table.sqrt_information.values, other.sqrt_information.values)
    for settings, before in ((ESTIMATED, estimated), (CONFIGURED, configured)):
        slam = GraphSlam(settings, start=read_map(folder / "estimated"))
        neutral = slam.view.backend.noise.neutral()
        assert slam.view.backend.noise.factors == (estimated.backend.noise.factors if before is estimated else neutral)
        for table in slam.view.graph.tables.values():
            then = before.graph.tables[table.type].sqrt_information.values[:1]
            now = table.sqrt_information.values[:1]
            assert len(then)
            np.testing.assert_allclose(now, then, rtol=1e-9, atol=1e-12 * np.abs(then).max(), err_msg=table.type.name)


def test_a_drive_that_says_too_little_of_its_noise_is_told_so_at_its_end(drive):
    folder, *_ = drive
    summary = json.loads((folder / "estimated" / "run.json").read_text())
    assert not any("as configured:" in line for line in noise(summary))
    few = "61 degrees of freedom, fewer than 200"
    summary["noise"][1]["reason"] = few
    said = " ".join(" ".join(noise(summary)).split())
    name = " ".join(summary["noise"][1][key] for key in ("label", "source", "part"))
    assert f"noise as configured: {name} ({few})" in said
    assert list(noise(summary | {"noise_scale": "configured"})) == []


def test_a_scale_that_cannot_be_estimated_is_counted_changes_nothing_and_the_end_says_why(tmp_path, monkeypatch):
    write_bag(simulate("warehouse", 1, laps=1, aisles=2), tmp_path / "short.mcap")

    def fails(*_arguments):
        raise SingularError("landmark 3 is not determined")

    monkeypatch.setattr("graph_slam_ros.slam.backend.estimate_noise", fails)
    run = replay(tmp_path / "short.mcap", tmp_path / "run", ESTIMATED)
    assert len(run.slam.view.keyframes) > FIRST_DUE
    assert run.slam.counters["noise_scale", "unsolved"] >= 2
    assert run.slam.view.backend.noise.factors == {}
    assert run.slam.view.is_solved
    saved = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (saved["noise"], saved["noise_unknown"]) == ([], "landmark 3 is not determined")
    assert any("no noise could be estimated at the end: landmark 3" in one for one in run.warnings)


def test_parameters_that_say_the_estimated_noise_of_odometry_are_printed():
    found = [
        NoiseScale("odometry", "odom", "rotation", 100, 300.0, 2.0, 1.0, 0.5, "", 0.04, 0.002, 0.0003),
        NoiseScale("odometry", "odom", "position", 100, 300.0, 2.0, 1.0, 2.0, "", 0.0, 0.0034, 0.00017),
    ]
    by_twist = noise_advice(found, is_applied=False, config=Config())
    turn, way = "turn_per_rad=0.04 turn_per_m=0.002 turn_per_s=0.0003", "way_per_m=0.0032 way_per_s=0.00016"
    expected = " ".join(f"--set odometry.{one}" for one in f"noise=motion {turn} {way}".split())
    assert by_twist.endswith(f"noise of this odometry in every run: {expected}")
    by_motion = noise_advice(found, is_applied=False, config=Config.from_mapping({"odometry.noise": "motion"}))
    assert "turn_per_rad=0.045 --set odometry.turn_per_m=0.0025 --set odometry.turn_per_s=5e-05" in by_motion


SMALLER = NoiseScale("landmarks", "detections", "position", 100, 900.0, 0.2, 1.0, 0.45)
LARGER = NoiseScale("landmarks", "detections", "rotation", 100, 900.0, 4.0, 1.0, 2.0)


@pytest.mark.parametrize("which", ["last_pose", "poses", "landmarks"])
def test_smaller_sigmas_are_not_advised_where_errors_are_larger_than_the_covariances_say_or_alike_in_a_pass(which):
    parts = dict.fromkeys(("last_pose", "poses", "landmarks"), Nees(6.0, 6, (5.7, 6.3), 0.95, 400, 0))
    fine = Consistency(*parts.values(), (SMALLER,), {}, "")
    assert (fine.over_confidence, "0.45 times as large" in str(fine)) == ("", True)
    parts[which] = Nees(11.4, 6, (5.7, 6.3), 0.4, 400, 0)
    wrong = Consistency(*parts.values(), (SMALLER, LARGER), {}, "")
    assert f"NEES of {which.replace('_', ' ').replace('last', 'the last')} 11.4 of 6" in wrong.over_confidence
    assert "0.45 times" not in str(wrong)
    assert "errors against the truth are larger than the covariances say" in str(wrong)
    assert "2 times as large" in str(wrong)
    for scales in ((SMALLER,), (SMALLER, LARGER)):
        advice = noise_advice(scales, is_applied=False, config=Config(), over_confident=wrong.over_confidence)
        assert "no smaller sigmas are advised (landmarks detections position)" in advice
        assert "--set" not in advice
    larger = noise_advice((LARGER,), is_applied=False, over_confident=wrong.over_confidence)
    assert "--set robust.noise_scale=estimated" in larger
    alike = NoiseScale("landmarks", "detections", "range", 100, 900.0, 0.1, 3.8, 0.6)
    said = noise_advice((alike,), is_applied=False)
    assert ("--set" in said, "no smaller sigmas" in said) == (False, True)
    assert "errors of a pass are alike" in str(Consistency(None, None, None, (alike,)))
