"""Consistency: NEES and the noise of classes come out as they were put in, and a good run is found to be good."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from reliability import times
from rows import each
from scipy.stats import chi2

from graph_slam_ros.analysis.consistency import Nees, landmark_errors, landmark_nees, pose_nees
from graph_slam_ros.analysis.evaluation import evaluate
from graph_slam_ros.analysis.path_error import interpolated
from graph_slam_ros.analysis.relative_covariance import RelativeCovariances
from graph_slam_ros.analysis.trajectories import read_truth
from graph_slam_ros.analysis.what_if import SavedGraph
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.replay import replay
from graph_slam_ros.runs.trajectory import Trajectory, read_covariances
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


@each("group, dof", [(se2, 3), (se3, 6)])
def test_poses_and_landmarks_are_compared_from_the_first_pose_on_wherever_the_map_is(group, dof):
    """The first pose's own uncertainty is all others' too, and no part of their errors seen from it."""
    rng, n = np.random.default_rng(2), 400
    anchor, added = spread(rng, dof), 1e-6 * spread(rng, dof)
    first, step = group.exp(tuple(rng.normal(size=dof))), group.exp(tuple(rng.normal(size=dof)))
    step = tuple(map(float, step))
    estimate = se3.in_space(np.array([first] + [group.compose(first, step)] * n))
    errors = rng.multivariate_normal(np.zeros(dof), added, n)
    true = [first] + [group.retract(group.compose(first, step), tuple(e)) for e in errors]
    T_world_map = group.exp(tuple(3.0 * rng.normal(size=dof)))
    truth = se3.in_space(np.array([group.compose(T_world_map, pose) for pose in true]))
    covariances = np.array([anchor] + [group.propagate(anchor, step, added)] * n)
    last, poses = pose_nees(estimate, truth, covariances)
    single = errors[-1] @ np.linalg.solve(added, errors[-1])
    assert (last.mean, last.n, last.dof) == (pytest.approx(single, rel=1e-2), 1, dof)
    assert (poses.n, poses.dof) == (n, dof)
    assert poses.band[0] < poses.mean < poses.band[1]

    # landmarks: where the poses are, by their positions
    axes = np.array([np.array(group.local(group.retract(first, tuple(e)), first)) for e in np.eye(dof)])
    assert axes == pytest.approx(np.eye(dof))
    size = dof // 2 + (dof == 3)
    spot = np.zeros((3, 3))
    spot[:size, :size] = 1e-6 * spread(rng, size)
    turned, h = [], 1e-6
    for e in np.eye(dof):
        ends = [group.compose(group.retract(first, tuple(h * sign * e)), step)[:size] for sign in (1, -1)]
        turned.append((np.array(ends[0]) - ends[1]) / (2.0 * h))
    by_first = np.array(turned).T
    inherited = np.zeros((3, 3))
    inherited[:size, :size] = by_first @ anchor @ by_first.T
    off = np.zeros((n, 3))
    off[:, :size] = rng.multivariate_normal(np.zeros(size), spot[:size, :size], n)
    at = estimate[1:, :3]
    true_at = np.stack(se3.act(tuple(se3.in_space(T_world_map)), tuple((at + off).T)), axis=1)
    landmarks = landmark_nees(at, true_at, np.tile(spot + inherited, (n, 1, 1)), estimate[0], truth[0], anchor)
    assert (landmarks.n, landmarks.dof) == (n, size)
    whitened = np.einsum("ni,ni->n", off[:, :size], np.linalg.solve(spot[:size, :size], off[:, :size].T).T)
    assert landmarks.mean == pytest.approx(whitened.mean(), rel=1e-2)


@each("heading", [0.1, 1.0])
def test_landmarks_that_a_wrong_first_heading_turns_away_are_off_by_as_much_as_that(heading):
    """Far landmarks lie on an arc, and not on the line that their covariance is long in."""
    sigma, at = 0.5, np.array([[10.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 0.0]])
    across = [np.array([-y, x]) for x, y, _ in at]
    covariances = np.zeros((3, 3, 3))
    covariances[:, :2, :2] = [sigma**2 * np.outer(one, one) + 1e-4 * np.eye(2) for one in across]
    truth = np.stack(se2.act((0.0, 0.0, heading), tuple(at[:, :2].T)), axis=1)
    truth = np.column_stack([truth, [0.0, 0.0, 0.0]])
    truth[2, 0] = 0.02
    first = np.array(se3.IDENTITY)
    errors, relative = landmark_errors(at, truth, covariances, first, first, np.zeros((3, 3)))
    found = [e @ np.linalg.solve(c, e) for e, c in zip(errors, relative, strict=True)]
    assert found == pytest.approx([(heading / sigma) ** 2, (heading / sigma) ** 2, 4.0], rel=1e-4)


def test_without_the_truth_of_the_first_pose_nothing_is_said_of_poses():
    poses = np.tile(se3.IDENTITY, (3, 1))
    truth = poses.copy()
    truth[0] = np.nan
    assert pose_nees(poses, truth, np.tile(np.eye(3), (3, 1, 1))) == (None, None)
    assert (
        landmark_nees(poses[:, :3], poses[:, :3], np.tile(np.eye(3), (3, 1, 1)), poses[0], truth[0], np.eye(3)) is None
    )


def test_the_truth_is_taken_between_its_neighbours_and_not_across_gaps_or_beyond_its_ends():
    truth = Trajectory(np.array([0.0, 0.1, 0.2, 2.0]), se3.in_space([[0, 0, 3.0], [1, 0, -3.0], [2, 0, 0], [9, 9, 0]]))
    at = interpolated(truth, np.array([-1.0, 0.0, 0.05, 0.2, 1.0, 2.0, 2.01]))
    assert np.isnan(at).any(axis=1).tolist() == [True, False, False, False, True, False, True]
    assert se3.in_plane(at[2])[2] % (2.0 * np.pi) == pytest.approx(np.pi)
    assert at[5] == pytest.approx(truth.poses[3])
    assert interpolated(Trajectory(truth.stamps_s[:1], truth.poses[:1]), np.array([0.0])) == pytest.approx(
        truth.poses[:1]
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A drive among landmarks, and its run."""
    folder = tmp_path_factory.mktemp("recorded")
    write_bag(simulate("pythonrobotics", 3), folder / "bag.mcap")
    replay(folder / "bag.mcap", folder / "run")
    return folder


def test_covariances_seen_from_other_poses_are_those_of_how_the_estimate_moves_in_their_frame(recorded):
    """Jacobians by central differences, with the joint covariance of the solver."""
    saved = SavedGraph(recorded / "run", [])
    vertices = [saved.keyframes[k] for k in (2, 9, 5)]
    joint = saved.solver.joint_marginal(vertices)
    values = [tuple(one) for one in saved.solver.estimate(vertices)]

    def from_pose(poses):
        return np.array(se2.between(poses[0], poses[2]))

    def from_line(poses):
        """The point's coordinates along the line and across it, in the axes that the map has now."""
        first, last, point = (np.array(pose[:2]) for pose in poses)
        axes = [(last - first) / np.linalg.norm(last - first) for first, last in ((first, last), ends)]
        turn = [np.array([axis, [-axis[1], axis[0]]]) for axis in axes]
        return turn[1].T @ turn[0] @ (point - first)

    ends = [np.array(value[:2]) for value in values[:2]]

    def jacobian(function):
        h, columns = 1e-6, []
        for e in h * np.eye(9):
            moved = [
                function([se2.retract(v, tuple(s * e[3 * k : 3 * k + 3])) for k, v in enumerate(values)])
                for s in (1, -1)
            ]
            columns.append((moved[0] - moved[1]) / (2.0 * h))
        return np.array(columns).T

    by = jacobian(from_line)
    line = RelativeCovariances(saved, (2, 9))
    assert line.positions([5])[0] == pytest.approx(by @ joint @ by.T, rel=1e-5, abs=1e-12)
    by, turn = jacobian(from_pose), np.eye(3)
    c, s = np.cos(from_pose(values)[2]), np.sin(from_pose(values)[2])
    turn[:2, :2] = [[c, s], [-s, c]]  # from the axes of the frame into those of the pose
    pose = RelativeCovariances(saved, (2,))
    should = [turn @ by @ joint @ by.T @ turn.T, np.zeros((3, 3))]
    assert pose.poses([5, 2]) == pytest.approx(np.array(should), rel=1e-5)
    name, place = next(iter(saved.landmarks.items()))
    spot, h = saved.solver.estimate([place])[0], 1e-6

    def seen_from(e):
        return np.array(se2.act(se2.inverse(se2.retract(values[0], tuple(e[:3]))), tuple(spot + e[3:])))

    by = np.array([(seen_from(h * e) - seen_from(-h * e)) / (2.0 * h) for e in np.eye(5)]).T
    by = se2.to_matrix(values[0])[:2, :2] @ by
    found = pose.landmarks([name, "unknown"])
    assert found[0] == pytest.approx(by @ saved.solver.joint_marginal([vertices[0], place]) @ by.T, rel=1e-5, abs=1e-12)
    assert np.isnan(found[1]).all()


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


def test_what_residuals_say_of_the_noise_is_saved_and_a_sample_of_edges_says_the_same(tmp_path, monkeypatch):
    slam = run(simulate("warehouse", 3, aisles=2, laps=1), tmp_path / "run", CLEAN)
    sampled = slam.noise_scale()
    monkeypatch.setattr("graph_slam_ros.slam.noise_scale._MOST_SAMPLED", 10**6)
    exact = slam.noise_scale()
    measured = sum(3 * one.edges if one.part == "all" else one.edges * (1 + (one.part == "position")) for one in exact)
    unknowns = 3 * slam.graph.vertex_count - 3  # the anchor determines one pose
    # parts of an edge are correlated a little; odometry's position is judged along and across together
    assert measured - sum(one.dof for one in exact) == pytest.approx(unknowns, rel=2e-2)
    for one, other in zip(sampled, exact, strict=True):
        assert (one.key, one.edges) == (other.key, other.edges)
        assert one.dof == pytest.approx(other.dof, rel=0.05)
    assert [one.dof for one in sampled] != [one.dof for one in exact]
    saved = json.loads((tmp_path / "run" / "run.json").read_text())["noise"]
    assert saved == json.loads(json.dumps([asdict(one) for one in sampled]))


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
    assert plain["consistency"]["poses"]["n"] == len(slam.keyframes) - 1
    assert plain["consistency"]["landmarks"]["dof"] == 3
    assert plain["consistency"]["landmarks"]["n"] == len(slam.landmarks)
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
        np.array(slam.solver.marginal(slam.keyframes.ids))
    )


def test_a_summary_that_is_none_is_refused_by_name(tmp_path):
    recording = simulate("pythonrobotics", 1)
    run(recording, tmp_path / "run", {})
    write_bag(recording, tmp_path / "truth.mcap")
    for text in ("", "{", "[]", "{}", '{"classes": {"a": {}}, "noise": 1}', '{"classes": [], "noise": [{"dof": 1}]}'):
        (tmp_path / "run" / "run.json").write_text(text)
        with pytest.raises(GraphSlamError, match=r"run\.json: not a summary of a run"):
            evaluate(tmp_path / "run", tmp_path / "truth.mcap")


@pytest.mark.parametrize("text", ["", "stamp_ns,a\n1,2\n", "stamp_ns,a\n1,two\n"])
def test_a_file_that_is_no_table_of_covariances_is_refused_by_name(tmp_path, text):
    (tmp_path / "covariances.csv").write_text(text)
    with pytest.raises(GraphSlamError, match=r"covariances\.csv: not a table of covariances"):
        read_covariances(tmp_path / "covariances.csv")


@pytest.mark.parametrize(
    "world, sensor", [("flight", "range_bearing"), *times([], [("flight", "pose"), ("warehouse", "range_bearing")])]
)
def test_a_simulated_bag_is_replayed_to_a_run_that_is_near_the_truth_and_knows_it(tmp_path, world, sensor):
    small = {"aisles": 2} if world == "warehouse" else {}
    write_bag(simulate(world, 1, laps=1, sensor=sensor, **small), tmp_path / "bag.mcap")
    settings = {"world.dimensions": 3 if world == "flight" else 2}
    if sensor != "pose":
        settings |= {"inputs.names": "odom points", "points.type": "sensor_msgs/msg/PointCloud2"}
        settings |= {"points.topic": "/landmarks"}
    replay(tmp_path / "bag.mcap", tmp_path / "run", Config.from_mapping(settings))
    scores = evaluate(tmp_path / "run", tmp_path / "bag.mcap")
    assert scores.dimensions == settings["world.dimensions"]
    assert scores.estimate.position_m["rmse"] < 0.3 * scores.odometry.position_m["rmse"]
    assert scores.map_rmse_m < 0.3
    assert scores.consistency.last_pose.mean < chi2.ppf(0.9999, scores.consistency.last_pose.dof)


def test_a_run_by_odometry_alone_is_scored_though_nothing_is_known_of_its_noise(tmp_path):
    write_bag(simulate("warehouse", 1, laps=1), tmp_path / "bag.mcap")
    replay(tmp_path / "bag.mcap", tmp_path / "run", Config.from_mapping({"landmarks.association": "none"}))
    scores = evaluate(tmp_path / "run", str(tmp_path / "bag.mcap"))
    assert any(np.isnan(one.per_dof) for one in scores.consistency.noise)
    assert "not known: 0 degrees of freedom" in str(scores)
