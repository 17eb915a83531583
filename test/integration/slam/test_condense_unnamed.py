"""Condensing with landmarks without identities: what leaves is final, and the map is known to what comes after."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.hall import STEP_S, config, fitted, hall, measurements, rms, without_ids
from graph_slam_ros.runs.condensed_map import read_left
from graph_slam_ros.runs.journal import read_measurements
from graph_slam_ros.runs.map_journal import read_map
from graph_slam_ros.runs.outcome import text
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.runs.whole_path import removed_path
from graph_slam_ros.slam import Control, GraphSlam, Sightings
from graph_slam_ros.slam.landmarks import hindsight
from graph_slam_ros.slam.landmarks.belief import SolverBelief
from graph_slam_ros.slam.landmarks.hindsight import FrozenScans, explained
from graph_slam_ros.slam.landmarks.known_map import with_map
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.landmarks.presence_check import Presence

KEYFRAMES, WINDOW = 900, 60


def drive(world, begin=0, end=KEYFRAMES):
    """What is measured at some keyframes."""
    begin_ns, end_ns = (round((k + 4.5) * STEP_S * 1e9) for k in (begin, end))
    some = (m for m in measurements(world) if begin_ns <= m.stamp_ns < end_ns)
    return [without_ids(m) if isinstance(m, Sightings) else m for m in some]


def settings(**values):
    return config(hall(2, 2).space, landmarks_association="joint", **values)


def bounded(**values):
    return settings(map_window_keyframes=WINDOW, **values)


@pytest.fixture(scope="module")
def world():
    return hall(2, KEYFRAMES + 400)


@pytest.fixture(scope="module")
def whole(world):
    slam = GraphSlam(settings())
    for m in [*drive(world), Control("end"), Control("optimize")]:
        slam.process(m)
    return slam


@pytest.fixture(scope="module")
def recorded(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unnamed") / "run"
    slam, _ = record_run(folder, bounded(), [*drive(world), Control("end"), Control("optimize")], [])
    return slam, folder


@pytest.fixture(scope="module")
def small(recorded):
    """The pipeline after the drive, and what left its map."""
    slam, folder = recorded
    return slam, read_left(folder, slam.space, slam.bounded)


def landmarks(slam, world):
    """Positions of the confirmed landmarks, laid on the true ones; these, and which is the nearest of each."""
    there = slam.solver.estimate([mark.vertex for mark in slam.landmarks.values() if not mark.is_tentative])
    space = world.space
    true = np.stack(space.group.act(space.group.inverse(world.poses[0]), tuple(world.points.T)), axis=-1)
    turn, shift = fitted(there, true[np.linalg.norm(there[:, None] - true[None], axis=2).argmin(axis=1)])
    there = there @ turn.T + shift
    return there, true, np.linalg.norm(there[:, None] - true[None], axis=2).argmin(axis=1)


def test_the_map_is_small_and_each_landmark_is_there_once(world, whole, small):
    slam, left = small
    assert slam.first_keyframe > 0.6 * KEYFRAMES
    assert len(slam.solver.vertices) < 0.4 * len(whole.solver.vertices)
    there, true, nearest = landmarks(slam, world)
    assert np.linalg.norm(there - true[nearest], axis=1).max() < 0.5
    assert len(set(nearest.tolist())) == len(nearest) == len(landmarks(whole, world)[0]) > 30
    path = np.concatenate((removed_path(slam, left), slam.trajectory()))
    right = np.array(world.poses)[: len(path), :2]
    assert rms(path[:, :2], right) < 1.3 * rms(whole.trajectory()[:, :2], right)


def test_what_is_remembered_of_sightings_follows_the_window(small):
    slam, _ = small
    anonymous = slam._landmarks.anonymous
    kept = {k: len(one) for k, one in vars(anonymous).items() if isinstance(one, list | dict)}
    assert max(kept.values()) <= WINDOW + 300, kept
    assert len(anonymous.clusters.given) == len(anonymous.clusters.seen) < 3 * (WINDOW + 300)
    assert len(anonymous.clusters.names) < 2 * len(slam.landmarks)
    assert sum(len(mark.seen) for mark in slam.landmarks.values()) < 3 * (WINDOW + 300)
    assert all(len(mark.seen) <= mark.sightings for mark in slam.landmarks.values())
    for mark in slam.landmarks.values():
        for one in mark.seen:
            assert slam.graph.edge(one.edge).vertices == (one.where.vertex, mark.vertex)


def test_a_replay_condenses_as_the_live_run_did(recorded, tmp_path):
    slam, folder = recorded
    again, _ = record_run(tmp_path / "again", bounded(), read_measurements(folder, []), [])
    assert again.first_keyframe == slam.first_keyframe > 0
    assert again.solver.values.tobytes() == slam.solver.values.tobytes()
    for name in ("path.tum", "landmarks.csv", "ledger.csv", "graph.g2o"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


def test_a_map_that_is_taken_up_again_goes_on_condensing(world, recorded, tmp_path):
    slam, folder = recorded
    losses = []
    start = read_map(folder, losses)
    start.continues_with = "odom"
    rest = drive(world, KEYFRAMES, KEYFRAMES + 400)
    more, _ = record_run(tmp_path / "more", bounded(), [*rest, Control("end")], losses, start)
    assert losses == []
    assert more.first_keyframe > slam.first_keyframe + 200
    there, true, nearest = landmarks(more, world)
    assert np.linalg.norm(there - true[nearest], axis=1).max() < 0.5
    assert len(set(nearest.tolist())) == len(nearest)


def test_the_map_is_known_relative_to_a_scan_as_the_solver_knows_it(small):
    slam, _ = small
    anonymous, space = slam._landmarks.anonymous, slam.space
    scan, names = anonymous._history.scans[-1], [mark.name for mark in anonymous.clusters.final.values()][:4]
    points, covariances = SolverBelief(space, slam.solver, slam._landmarks.map).seen_from(scan, names)
    vertices = [scan.where.vertex, *(slam.landmarks[name].vertex for name in names)]
    values = [slam.solver.estimate([vertex])[0] for vertex in vertices]

    def seen(step):
        pose = space.group.compose(tuple(values[0]), space.group.exp(tuple(step[:3])))
        base = space.group.compose(pose, scan.where.T_keyframe_base)
        marks = np.array(values[1:]) + step[3:].reshape(-1, 2)
        return np.stack(space.group.act(space.group.inverse(base), tuple(marks.T)), axis=-1).ravel()

    assert points.ravel() == pytest.approx(seen(np.zeros(3 + 2 * len(names))), abs=1e-9)
    h = 1e-6
    steps = h * np.eye(3 + 2 * len(names))
    j = np.array([(seen(step) - seen(-step)) / (2 * h) for step in steps]).T
    by_pose = np.zeros((len(j), 3))  # the motion from the keyframe to the scan has noise of its own
    for k, (x, y) in enumerate(points):
        by_pose[2 * k : 2 * k + 2] = [[-1.0, 0.0, y], [0.0, -1.0, -x]]
    own = by_pose @ scan.where.covariance @ by_pose.T
    expected = j @ slam.solver.joint_marginal(vertices) @ j.T + own
    for k, covariance in enumerate(covariances):
        assert covariance == pytest.approx(expected[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], rel=1e-4, abs=1e-9)


def test_a_stretch_at_a_wrong_place_is_laid_on_the_map(small):
    """Two thirds of the window are assigned to copies of the landmarks, 2 m away: the explanation takes that back."""
    slam, _ = small
    anonymous = slam._landmarks.anonymous
    frozen = anonymous._frozen()
    count, first = frozen.clusters_of_map, frozen.of_map
    assert count and first == 3
    cut = first + frozen.count // 3
    of_scan = np.repeat(np.arange(len(frozen.scans)), [len(one.clusters) for one in frozen.scans])
    wrong = frozen.given.copy()
    wrong[of_scan >= cut] += np.where(wrong[of_scan >= cut] < -100, -10_000, 0)
    poses = frozen.poses.copy()
    poses[cut:, :2] += (1.5, -1.2)
    moved = FrozenScans(
        *(frozen.scans, frozen.motions, frozen.nearby, poses, frozen.scales, wrong, wrong),
        of_map=first,
        clusters_of_map=count,
        times=frozen.times,
    )
    found = explained(slam.space, moved, anonymous.hindsight._settings, anonymous.hindsight._costs)
    numbers = found.numbers(wrong[count:].tolist(), iter(range(-20_000, -30_000, -1)).__next__)
    now = np.where(found.estimate.which >= 0, numbers[found.estimate.which], -2)[count:]
    is_used = (now != -2) & (frozen.given[count:] != -2)
    assert np.count_nonzero(is_used) > 0.9 * len(now)
    assert np.mean(now[is_used] == frozen.given[count:][is_used]) > 0.97


def test_nothing_of_the_map_is_known_where_nothing_has_left():
    frozen = FrozenScans((), (), np.empty((0, 21, 3)), np.empty((0, 3)), np.zeros(2), np.empty(0), np.empty(0))
    belief = SimpleNamespace()
    assert with_map(frozen, belief, {}) is frozen
    assert with_map(frozen, belief, {-101: Landmark("a", 0)}) is frozen


def test_a_doubtful_map_is_not_condensed_and_the_end_says_so(world, monkeypatch):
    monkeypatch.setattr(hindsight, "presence", lambda *_: Presence(100, 50, 100, 1))
    slam = GraphSlam(bounded())
    for m in [*drive(world, 0, 400), Control("end")]:
        slam.process(m)
    assert slam.first_keyframe == 0
    assert "condensed  nothing: not with a doubtful map of landmarks without ids yet" in "\n".join(
        text(summarize(slam))
    )
