"""Consistency: NEES and the noise of classes come out as they were put in, and a good run is found to be good."""

import json
from dataclasses import replace

import numpy as np
import pytest
from reliability import times
from rows import each
from scipy.stats import chi2

from graph_slam_ros.analysis.consistency import Nees
from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se3
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.trajectory import read_covariances
from graph_slam_ros.slam import Config, Control, GraphSlam
from graph_slam_ros.tools.simulation import measurements, simulate, write_bag


def spread(rng, dof):
    root = rng.normal(size=(dof, dof))
    return root @ root.T + 0.1 * np.eye(dof)


@each("dof", [2, 3, 6])
def test_errors_drawn_from_their_covariances_have_as_much_nees_as_dimensions(dof):
    rng = np.random.default_rng(1)
    covariances = np.array([spread(rng, dof) for _ in range(2000)])
    errors = np.array([rng.multivariate_normal(np.zeros(dof), c) for c in covariances])
    nees = Nees.of(errors, covariances)
    assert (nees.dof, nees.n, nees.skipped) == (dof, 2000, 0)
    assert nees.band[0] < nees.mean < nees.band[1]
    assert nees.inside == pytest.approx(0.95, abs=0.02)
    assert Nees.of(2.0 * errors, covariances).mean == pytest.approx(4.0 * nees.mean)
    assert Nees.of(errors[:1], covariances[:1]).band == pytest.approx(chi2.ppf([0.025, 0.975], dof))


def test_what_is_not_known_is_skipped_and_counted_and_never_scored():
    errors, covariances = np.ones((5, 2)), np.tile(np.eye(2), (5, 1, 1))
    errors[1, 0] = covariances[2, 1, 1] = np.nan
    covariances[3, 1, 1] = 0.0
    nees = Nees.of(errors, covariances)
    assert (nees.mean, nees.n, nees.skipped) == (2.0, 2, 3)
    assert Nees.of(np.full((3, 2), np.nan), np.tile(np.eye(2), (3, 1, 1))) is None
    assert Nees.of(np.empty((0, 2)), np.empty((0, 2, 2))) is None


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A drive among landmarks, and its run."""
    folder = tmp_path_factory.mktemp("recorded")
    write_bag(simulate("pythonrobotics", 3), folder / "bag.mcap")
    replay(folder / "bag.mcap", folder / "run")
    return folder


def test_a_truth_that_begins_late_or_has_no_heading_tells_of_consistency_too(recorded):
    truth = read_truth(recorded / "bag.mcap")
    first = evaluate(recorded / "run", truth).consistency
    assert (first.frame, first.poses.dof) == ("", 3)
    path = truth.trajectory
    late = evaluate(recorded / "run", replace(truth, trajectory=path.at(slice(12, None)))).consistency
    assert late.frame.startswith("seen from keyframe ") and late.poses.dof == 3
    still = path.poses.copy()
    still[:, 3:] = se3.IDENTITY[3:]
    rows = "".join(f"{stamp} {' '.join(map(str, pose))}\n" for stamp, pose in zip(path.stamps_s, still, strict=True))
    (recorded / "positions.tum").write_text(rows)
    found = read_truth(recorded / "positions.tum")
    assert not found.trajectory.has_orientation
    positions = evaluate(recorded / "run", replace(truth, trajectory=found.trajectory)).consistency
    assert positions.frame.startswith("of positions, seen from the line between keyframes ")
    assert (positions.poses.dof, positions.landmarks.dof) == (2, 2)
    for one in (first, late, positions):
        assert one.poses.inside > 0.75
        assert one.landmarks.n == first.landmarks.n
    assert positions.frame in str(positions)


CLEAN = {"odometry.twist_correlation_s": 0.0, "landmarks.added_sigma_m": 0.0, "landmarks.loss": "none"}
CLEAN |= {"odometry.doubt": False}  # its errors are worse than this noise says


def run(recording, folder, settings):
    config = Config.from_mapping(settings)
    recorder = RunRecorder(folder, config)
    slam = GraphSlam(config, recorder.sink)
    for m in [*measurements(recording), Control("end"), Control("optimize")]:
        slam.process(m)
    recorder.save(slam)
    recorder.close()
    return slam


@pytest.mark.parametrize("world, n", [("warehouse", 3), *times([], [("flight", 6)])])
def test_a_run_with_the_noise_it_was_told_of_is_consistent_and_its_sigmas_are_right(tmp_path, world, n):
    options = {"warehouse": {"aisles": 2, "laps": 1, "aisle_m": 6.0}, "flight": {"laps": 1, "beacons": 3}}[world]
    # a keyframe at each look: what is carried from look to keyframe shares its noise, which is not modelled
    settings = CLEAN | {"world.dimensions": n // 3 + 1, "keyframes.max_interval_s": 0.15}
    last, runs = [], times(2, 8)
    for seed in range(runs):
        recording = simulate(world, seed, **options, correlation_time_s=0.0)
        folder = tmp_path / f"run_{seed}"
        run(recording, folder, settings)
        write_bag(recording, tmp_path / "truth.mcap")
        scores = evaluate(folder, tmp_path / "truth.mcap")
        last.append(scores.consistency.last_pose.mean)
        for noise in scores.consistency.noise:
            assert noise.per_dof == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / noise.dof))
    low, high = chi2.ppf([0.001, 0.999], n * runs) / runs
    assert low < np.mean(last) < high


def test_a_flight_is_scored_in_space_in_words_and_in_plain_values(tmp_path):
    recording = simulate("flight", 1, laps=1)
    slam = run(recording, tmp_path / "run", {"world.dimensions": 3})
    write_bag(recording, tmp_path / "truth.mcap")
    scores = evaluate(tmp_path / "run", tmp_path / "truth.mcap")
    plain = json.loads(json.dumps(scores.as_dict()))
    own = {"position_m", "angle_rad", "drift", "n", "of"}
    assert set(plain) == own | {"map_m", "odometry", "consistency", "scored"}
    assert plain["position_m"]["rmse"] < 0.05 < plain["odometry"]["position_m"]["rmse"]
    assert plain["map_m"]["rmse"] < 0.1
    assert plain["consistency"]["poses"]["dof"] == 6
    assert plain["consistency"]["poses"]["n"] == len(slam.view.keyframes) - 1
    assert plain["consistency"]["landmarks"]["dof"] == 3
    assert plain["consistency"]["landmarks"]["n"] == len(slam.view.landmarks)
    assert {one["label"] for one in plain["consistency"]["noise"]} == {"odometry", "landmarks"}
    text = str(scores)
    assert all(word in text for word in ("angle [deg]", "NEES", "last pose", "chi2/dof", "times as large"))
    summary = json.loads((tmp_path / "run" / "run.json").read_text())
    summary["classes"]["fixes"] = {"edges": 1, "residuals": 3, "chi2": 1.0}
    (tmp_path / "run" / "run.json").write_text(json.dumps(summary))
    held = evaluate(tmp_path / "run", tmp_path / "truth.mcap").consistency
    assert (held.last_pose, held.poses, held.landmarks) == (None, None, None), "the map is held elsewhere"
    assert "left out: fixes hold the map" in str(held)
    assert read_covariances(tmp_path / "run" / "covariances.csv") == pytest.approx(
        np.array(slam.view.solver.marginal(slam.view.keyframes.ids))
    )


def test_a_summary_or_a_table_of_covariances_that_is_none_is_refused_by_name(tmp_path):
    recording = simulate("pythonrobotics", 1)
    run(recording, tmp_path / "run", {})
    write_bag(recording, tmp_path / "truth.mcap")
    for text in ("", "{", "[]", "{}", '{"classes": {"a": {}}, "noise": 1}', '{"classes": [], "noise": [{"dof": 1}]}'):
        (tmp_path / "run" / "run.json").write_text(text)
        with pytest.raises(GraphSlamError, match=r"run\.json: not a summary of a run"):
            evaluate(tmp_path / "run", tmp_path / "truth.mcap")
    for text in ("", "stamp_ns,a\n1,2\n", "stamp_ns,a\n1,two\n"):
        (tmp_path / "covariances.csv").write_text(text)
        with pytest.raises(GraphSlamError, match=r"covariances\.csv: not a table of covariances"):
            read_covariances(tmp_path / "covariances.csv")


def test_a_run_by_odometry_alone_is_scored_though_nothing_is_known_of_its_noise(tmp_path):
    write_bag(simulate("warehouse", 1, laps=1, aisles=2, aisle_m=4.0), tmp_path / "bag.mcap")
    replay(tmp_path / "bag.mcap", tmp_path / "run", Config.from_mapping({"landmarks.association": "none"}))
    scores = evaluate(tmp_path / "run", str(tmp_path / "bag.mcap"))
    assert any(np.isnan(one.per_dof) for one in scores.consistency.noise)
    assert "not known: 0 degrees of freedom" in str(scores)
