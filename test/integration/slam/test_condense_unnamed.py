"""Condensing with landmarks without identities: what leaves is final, and the map is known to what comes after."""

import numpy as np
import pytest
from reliability import times

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
from graph_slam_ros.slam.landmarks.presence_check import Presence

KEYFRAMES, MORE, WINDOW = times(400, 900), 400, 60
SOAKED = pytest.mark.skipif(not times(0, 1), reason="only in make soak")


def drive(world, begin=0, end=KEYFRAMES):
    """What is measured at some keyframes."""
    begin_ns, end_ns = (round((k + 4.5) * STEP_S * 1e9) for k in (begin, end))
    some = (m for m in measurements(world) if begin_ns <= m.stamp_ns < end_ns)
    return [without_ids(m) if isinstance(m, Sightings) else m for m in some]


def bounded(**values):
    return config(hall(2, 2).space, landmarks_association="joint", map_window_keyframes=WINDOW, **values)


@pytest.fixture(scope="module")
def world():
    return hall(2, 900 + MORE)


@pytest.fixture(scope="module")
def recorded(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("unnamed") / "run"
    slam, _ = record_run(folder, bounded(), [*drive(world), Control("end")], [])
    return slam, folder


def assert_each_landmark_is_there_once(slam, world, least):
    """Confirmed landmarks, laid on the true ones."""
    there = slam.solver.estimate([mark.vertex for mark in slam.landmarks.values() if not mark.is_tentative])
    space = world.space
    true = np.stack(space.group.act(space.group.inverse(world.poses[0]), tuple(world.points.T)), axis=-1)
    turn, shift = fitted(there, true[np.linalg.norm(there[:, None] - true[None], axis=2).argmin(axis=1)])
    apart = np.linalg.norm((there @ turn.T + shift)[:, None] - true[None], axis=2)
    assert apart.min(axis=1).max() < 0.5
    assert len(set(apart.argmin(axis=1).tolist())) == len(there) >= least


def test_the_map_is_small_and_each_landmark_is_there_once(world, recorded):
    slam, folder = recorded
    assert slam.first_keyframe > times(2 * WINDOW, 540)
    assert len(slam.solver.vertices) < times(0.8, 0.4) * (KEYFRAMES + 40)
    assert_each_landmark_is_there_once(slam, world, least=times(28, 38))
    path = np.concatenate((removed_path(slam, read_left(folder, slam.space, slam.bounded)), slam.trajectory()))
    assert rms(path[:, :2], np.array(world.poses)[:KEYFRAMES, :2]) < times(0.25, 0.1)


def test_what_is_remembered_of_sightings_follows_the_window(recorded):
    slam, _ = recorded
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


@SOAKED
def test_a_replay_condenses_as_the_live_run_did(recorded, tmp_path):
    slam, folder = recorded
    again, _ = record_run(tmp_path / "again", bounded(), read_measurements(folder, []), [])
    assert again.first_keyframe == slam.first_keyframe > 0
    assert again.solver.values.tobytes() == slam.solver.values.tobytes()
    for name in ("path.tum", "landmarks.csv", "ledger.csv", "graph.g2o"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


@SOAKED
def test_a_map_that_is_taken_up_again_goes_on_condensing(world, recorded, tmp_path):
    slam, folder = recorded
    losses = []
    start = read_map(folder, losses)
    start.continues_with = "odom"
    rest = drive(world, KEYFRAMES, KEYFRAMES + MORE)
    more, _ = record_run(tmp_path / "more", bounded(), [*rest, Control("end")], losses, start)
    assert losses == []
    assert more.first_keyframe > slam.first_keyframe + 200
    assert_each_landmark_is_there_once(more, world, least=38)


def test_the_map_is_known_relative_to_a_scan_as_the_solver_knows_it(recorded):
    slam, _ = recorded
    slam.solver.update()
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


@SOAKED
def test_a_stretch_at_a_wrong_place_is_laid_on_the_map(recorded):
    """Two thirds of the window are assigned to copies of the landmarks, 2 m away: the explanation takes that back."""
    slam, _ = recorded
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


def test_a_doubtful_map_is_not_condensed_and_the_end_says_so(world, monkeypatch):
    monkeypatch.setattr(hindsight, "presence", lambda *_: Presence(100, 50, 100, 1))
    slam = GraphSlam(bounded())
    for m in [*drive(world, 0, 300), Control("end")]:
        slam.process(m)
    assert slam.first_keyframe == 0
    assert "condensed  nothing: not with a doubtful map of landmarks without ids yet" in "\n".join(
        text(summarize(slam))
    )
