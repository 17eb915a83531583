"""Which landmark is it: scans and their clusters, the beam of hypotheses, and the moves that take back."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.landmarks import hindsight
from graph_slam_ros.slam.landmarks.beam import Beam, BeamSettings, Seed, changes
from graph_slam_ros.slam.landmarks.bordered import BorderedEquations, Rows
from graph_slam_ros.slam.landmarks.constellation import laid_on_the_map
from graph_slam_ros.slam.landmarks.explanation import Costs, Drive, Estimate
from graph_slam_ros.slam.landmarks.moves import refined
from graph_slam_ros.slam.landmarks.presence_check import presence
from graph_slam_ros.slam.landmarks.rotations import rotation
from graph_slam_ros.slam.landmarks.scans import (
    NEARBY_S,
    Cluster,
    MotionNoise,
    Reckoned,
    Scan,
    ScanBuilder,
    Seen,
    motion_between,
)

S = 1_000_000_000
NOISE = MotionNoise(0.02, 0.002, 0.0002, 0.002, 0.0001)
SPACES = {2: PLANAR, 3: SPATIAL}
SETTINGS = BeamSettings(quantile(0.9999, 2), 2 * float(np.log(0.03)))
COSTS = Costs(14.0, 25.0, 6.0)
WHERE = PoseAtStamp(0, 0, 0, PLANAR.identity, np.zeros((3, 3)))
SEEN = Seen("seen", Sighting("", "position", (1.0, 0.0), (0.01, 0.0, 0.0, 0.01)), WHERE)


def pose(n, x=0.0, y=0.0, yaw=0.0):
    return (x, y, yaw) if n == 2 else (x, y, 0.0, 0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))


def at(second, n=2, x=0.0, y=0.0, yaw=0.0, **sums):
    return Reckoned(round(second * S), pose(n, x, y, yaw), **sums)


def scan(second, where, points, sigma=0.1, sort=""):
    """What is seen of points (k, n), from the robot, at a place by odometry (x, y, yaw) and the way so far."""
    x, y, yaw, way = where
    n = len(points[0]) if len(points) else 2
    here = at(second, n, x, y, yaw, way=way, turned=abs(yaw), moving_s=second)
    covariance = sigma**2 * np.eye(n)
    return Scan(here, WHERE, tuple(Cluster(np.array(p, dtype=float), covariance, (), sort) for p in points))


def seed(n=2, scale_sigma=0.1):
    dof = SPACES[n].dof
    covariance = np.diag([1e-4] * dof + [scale_sigma**2] * 2)
    return Seed(np.zeros(n), np.eye(n), np.zeros(2), np.zeros((0, n)), np.zeros(0, dtype=np.int64), covariance)


def motions(scans, n=2):
    jump = np.zeros((SPACES[n].dof,) * 2)
    return [motion_between(SPACES[n], NOISE, a.at, b.at, jump) for a, b in itertools.pairwise(scans)]


def explained(scans, settings=SETTINGS, n=2):
    """The beam after some scans, and what each cluster is by its leader."""
    beam, first, last = Beam(settings, seed(n)), 0, None
    for k, one in enumerate(scans):
        if k:
            beam.advance(motions(scans[k - 1 : k + 1], n)[0])
        last = beam.explain(one, first)
        first += len(one.clusters)
    return beam, list(changes(None, last).values())


# -- scans ------------------------------------------------------------------------------------------------------------


def glimpse(builder, second, point, topic="seen", turned=0.0, segment=0):
    builder.add(
        at(second, turned=turned, segment=segment), np.array(point), 0.01 * np.eye(2), replace(SEEN, topic=topic)
    )


def test_sightings_of_one_thing_are_a_cluster_with_the_covariance_of_one_of_them():
    builder = ScanBuilder(PLANAR, 0.02 * np.eye(2), 0.5)
    for k, x in enumerate((5.0, 5.1, 5.2, 8.0)):
        glimpse(builder, 1.0 + 0.1 * k, (x, 0.0))
    one, other = builder.close().clusters
    assert one.point == pytest.approx([5.1, 0.0])
    assert one.covariance == pytest.approx(0.03 * np.eye(2))
    assert [len(one.seen), len(other.seen)] == [3, 1]
    shared = [seen.sighting.covariance[0] for seen in one.seen]
    assert shared == pytest.approx([0.03] * 3), "together they say as much as one"
    assert builder.close() is None


# -- the beam ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 3])
def test_a_cluster_is_the_landmark_it_fits_and_a_new_one_where_it_fits_none(n):
    settings = BeamSettings(quantile(0.9999, n), n * float(np.log(0.03)))
    marks = np.array([[4.0, 1.0, 0.5], [4.0, -6.0, 0.2], [-3.0, 2.0, 0.0]])[:, :n]
    step = np.array([0.5, 0.0, 0.0])[:n]
    scans = [scan(0.5 * k, (0.5 * k, 0.0, 0.0, 0.5 * k), (marks - k * step)[: 2 + (k > 1)]) for k in range(4)]
    beam, which = explained(scans, settings, n)
    assert which == [0, 1, 0, 1, 0, 1, 6, 0, 1, 6]
    found = {int(k): beam.landmarks[0, slot] for slot, k in enumerate(beam.ids[0]) if k >= 0}
    assert found[0] == pytest.approx(marks[0], abs=0.05)
    assert beam.position[0] == pytest.approx(3 * step, abs=0.05)


def test_what_is_far_out_of_the_gate_seen_beside_it_or_of_another_sort_is_another_landmark():
    here = scan(0.0, (0, 0, 0, 0), [(4.0, 0.0)])
    for points, expected in (([(4.3, 0.0)], [0, 0]), ([(5.5, 0.0)], [0, 1])):
        assert explained([here, scan(0.5, (0, 0, 0, 0), points)])[1] == expected
    assert len(set(explained([here, scan(0.5, (0, 0, 0, 0), [(4.0, 0.1), (4.0, -0.1)])])[1][1:])) == 2
    scans = [scan(0.0, (0, 0, 0, 0), [(4.0, 0.0)], sort="tree"), scan(0.5, (0, 0, 0, 0), [(4.0, 0.0)], sort="pole")]
    assert explained(scans)[1] == [0, 1]
    assert explained([scans[0], scan(0.5, (0, 0, 0, 0), [(4.0, 0.0)], sort="tree")])[1] == [0, 0]


def test_what_comes_later_decides_what_was_seen_before():
    """Odometry turns by 0.5 rad less than the robot; until a second landmark is seen, the first may be another."""
    marks = np.array([[5.0, 0.0], [5.0, 2.3], [-4.0, 3.0]])
    first = [scan(0.5 * k, (0, 0, 0, 0), marks) for k in range(6)]
    turn = rotation(np.array([-0.45]))  # the robot turned by 0.45 rad, odometry says 0.05
    here = (0.0, 0.0, 0.05, 0.0)
    later = [scan(4.0, here, [turn @ marks[0]], sigma=0.3)] + [
        scan(4.5 + k, here, (turn @ marks.T).T) for k in range(4)
    ]
    which = explained([*first, *later])[1]
    assert which[18:] == [0, *[0, 1, 2] * 4]


# -- everything at once ----------------------------------------------------------------------------------------------

ROUND = np.array([[6.0, 0.0], [5.0, 6.0], [-6.0, 3.0], [-3.0, -6.0], [7.0, 7.5]])


def circle(seed=0, laps=3, scale=1.0, marks=ROUND, per_lap=40):
    """Scans from a circle of 2 m; odometry is ``scale`` times too short in way."""
    rng, scans, truth = np.random.default_rng(seed), [], []
    at_, step = np.zeros(3), 2.0 * np.pi / per_lap
    odometry = np.zeros(3)
    for k in range(laps * per_lap):
        turn = rotation(at_[2:])
        seen = (marks - at_[:2]) @ turn
        near = [j for j in range(len(marks)) if np.linalg.norm(seen[j]) < 7.0]
        points = seen[near] + rng.normal(0.0, 0.1, (len(near), 2))
        scans.append(scan(0.5 * k, (*odometry, 2.0 * step * k), points, 0.1))
        object.__setattr__(scans[-1].at, "turned", step * k)
        truth.append(near)
        for pose_, way in ((at_, 2.0 * step), (odometry, 2.0 * step / scale)):
            pose_[:2] += way * np.array([np.cos(pose_[2] + step / 2), np.sin(pose_[2] + step / 2)])
            pose_[2] += step
    return scans, np.concatenate(truth)


def around(scans):
    """The robot stands at each scan: clocks do not matter."""
    return np.zeros((len(scans), len(NEARBY_S), 3))


def of_drive(scans, which, n=2, nearby=None, settings=SETTINGS):
    drive = Drive(scans, motions(scans, n), around(scans) if nearby is None else nearby, settings, COSTS)
    position, turn = drive.along_odometry(np.zeros(n), np.eye(n), np.zeros(2))
    clocks = np.zeros(len(drive.topics))
    return drive, drive.staged(Estimate(position, turn, np.empty((0, n)), np.zeros(2), clocks, np.array(which)))


def test_solving_all_finds_the_landmarks_and_what_odometry_is_short_of():
    scans, truth = circle(scale=1.08)
    _, e = of_drive(scans, truth)
    assert e.landmarks == pytest.approx(ROUND, abs=0.1)
    assert e.scales[0] == pytest.approx(0.08, abs=0.02)


def weaving(late_s, count=120):
    """A robot turns to and fro, and its sightings are stamped too late. Also what each is of, and the motion around."""
    rng, scans, truth, nearby = np.random.default_rng(3), [], [], []

    def place(t):
        return 2.0 * np.cos(0.1 * t), 2.0 * np.sin(0.1 * t), float(np.sin(0.7 * t))

    way = turned = 0.0
    for k in range(count):
        t = 0.5 * k
        x, y, yaw = place(t - late_s)
        seen = (ROUND - (x, y)) @ rotation(np.array([yaw]))
        at_ = Reckoned(round(t * S), place(t), turned=turned, way=way, moving_s=t)
        points = seen + rng.normal(0.0, 0.05, seen.shape)
        scans.append(Scan(at_, WHERE, tuple(Cluster(p, 0.0025 * np.eye(2), (SEEN,)) for p in points)))
        truth += range(len(ROUND))
        nearby.append([PLANAR.group.between(place(t), place(t + after_s)) for after_s in NEARBY_S.tolist()])
        way, turned = way + 0.1, turned + 0.35
    return scans, np.array(truth), np.array(nearby, dtype=float)


@pytest.mark.parametrize("late_s", [0.0, 0.22])
def test_solving_all_finds_the_clock_of_an_input(late_s):
    scans, truth, nearby = weaving(late_s)
    drive, e = of_drive(scans, truth, nearby=nearby)
    (value, sigma) = drive.named(e)["seen"]
    assert value == pytest.approx(-late_s, abs=0.02)
    assert sigma < 0.03
    _, same = of_drive(scans, truth, nearby=nearby, settings=replace(SETTINGS, clock_sigma_s=1e-6))
    assert (same.cost > e.cost + 16.0) == bool(late_s), "four sigmas"


def test_what_was_taken_for_two_is_merged_and_what_was_given_wrongly_is_given_to_another():
    scans, truth = circle()
    wrong = truth.copy()
    wrong[(truth == 1) & (np.arange(len(truth)) > len(truth) // 2)] = len(ROUND)
    wrong[np.flatnonzero(truth == 0)[::9]] = -1
    drive, e = of_drive(scans, wrong)
    e = refined(drive, e)
    assert len(e.landmarks) == len(ROUND)
    pairs = {(a, b) for a, b in zip(truth.tolist(), e.which.tolist(), strict=True)}
    assert len(pairs) == len(ROUND)


def test_moves_end_at_their_limit_of_work_and_that_is_said(monkeypatch):
    scans, truth = circle()
    wrong = truth.copy()
    wrong[(truth == 1) & (np.arange(len(truth)) > len(truth) // 2)] = len(ROUND)
    poses = np.array([one.at.pose for one in scans])
    steps, nearby = tuple(motions(scans)), around(scans)
    frozen = hindsight.FrozenScans(tuple(scans), steps, nearby, poses, np.zeros(2), wrong, wrong)
    found = {}
    for most in (1_000_000, 0):
        monkeypatch.setattr("graph_slam_ros.slam.landmarks.explanation._MOST_WORK", most)
        found[most] = hindsight.explained(PLANAR, frozen, SETTINGS, COSTS)
    assert [(one.is_whole, len(one.estimate.landmarks)) for one in found.values()] == [(True, 5), (False, 6)]


def test_landmarks_that_should_be_seen_and_are_not_make_an_explanation_doubtful():
    scans, truth = circle(laps=4)
    drive, e = of_drive(scans, truth)
    right = presence(drive, e)
    assert (right.missing, right.is_doubtful) == (0, False)
    turned = replace(e, landmarks=np.concatenate([e.landmarks, 0.6 * e.landmarks]))  # nearer than what is seen
    wrong = presence(drive, turned)
    assert wrong.seen == right.seen
    assert wrong.missing > 100
    assert wrong.is_doubtful


def two_rooms(marks_of_second):
    """A drive among marks, and then a stretch with odometry off by a metre among others."""
    scans, truth = circle(laps=3)
    last = scans[-1].at
    moved = []
    for k, one in enumerate(scans[:30]):
        here = at(
            last.stamp_ns / S + 10.0 + 0.5 * k,
            x=one.at.pose[0] + 1.0,
            y=one.at.pose[1] + 0.3,
            yaw=one.at.pose[2],
            way=last.way + 0.5 * k,
            turned=last.turned + 0.16 * k,
            moving_s=last.moving_s + 10.0 + 0.5 * k,
        )
        moved.append(replace(one, at=here))
    own = marks_of_second[truth[: sum(len(one.clusters) for one in moved)]]
    return [*scans, *moved], np.concatenate([truth, own])


def test_a_stretch_that_is_a_twin_is_laid_on_the_map_as_one():
    scans, which = two_rooms(np.arange(5, 10))
    drive, e = of_drive(scans, which)
    assert len(e.landmarks) == 10
    e, undecided = laid_on_the_map(drive, e)
    assert (len(e.landmarks), undecided) == (5, 0)
    assert e.landmarks == pytest.approx(ROUND, abs=0.25)


@pytest.mark.parametrize("halls", [1, 2])
def test_which_of_two_halls_alike_it_is_stays_open(halls):
    """A round in each hall, then odometry jumps, and what is seen next may be either."""
    scans, which = [], []
    once, seen_in_one = circle(laps=2)
    begin = {"way": 0.0, "turned": 0.0}
    for hall in range(halls + 1):
        is_lost = hall == halls
        for k, one in enumerate(once if not is_lost else once[:40]):
            x, y, yaw = one.at.pose
            away = 40.0 * hall if not is_lost else 17.0
            here = at(
                100.0 * hall + 0.5 * k,
                x=x + away,
                y=y,
                yaw=yaw,
                way=begin["way"] + one.at.way,
                turned=begin["turned"] + one.at.turned,
                moving_s=100.0 * hall + 0.5 * k,
                segment=int(is_lost),
            )
            scans.append(replace(one, at=here))
        begin = {"way": scans[-1].at.way + 40.0, "turned": scans[-1].at.turned}
        count = sum(len(one.clusters) for one in (once if not is_lost else once[:40]))
        which.append(5 * hall + seen_in_one[:count])
    jump = np.diag([100.0, 100.0, 9.0])
    steps = [motion_between(PLANAR, NOISE, a.at, b.at, jump) for a, b in itertools.pairwise(scans)]
    drive = Drive(scans, steps, around(scans), SETTINGS, COSTS)
    position, turn = drive.along_odometry(np.zeros(2), np.eye(2), np.zeros(2))
    clocks = np.zeros(len(drive.topics))
    e = drive.staged(Estimate(position, turn, np.empty((0, 2)), np.zeros(2), clocks, np.concatenate(which)))
    assert len(e.landmarks) == 5 * (halls + 1)
    laid, undecided = laid_on_the_map(drive, e)
    assert len(laid.landmarks) == (5 if halls == 1 else 15)
    assert (undecided > 0) == (halls == 2)


@pytest.mark.parametrize("landmarks", [3, 40])
def test_the_equations_of_a_chain_with_a_border_are_solved_as_the_dense_ones(landmarks):
    """A short border is dense; the landmarks of a long one are factorised as a sparse matrix."""
    rng, poses, parameters = np.random.default_rng(landmarks), 60, 3
    count, size = 3 * poses, 2 * landmarks + parameters
    steps, seen = np.arange(poses - 1), rng.integers(0, poses, 300)
    which, last = rng.integers(0, landmarks, 300), size - parameters + np.arange(parameters)
    border = np.column_stack([2 * which, 2 * which + 1, np.tile(last[2:], (300, 1))])
    draw = rng.standard_normal
    rows = [
        Rows(
            draw((poses - 1, 3, 6)),
            draw((poses - 1, 3, 2)),
            draw((poses - 1, 3)),
            3 * steps,
            np.tile(last[:2], (poses - 1, 1)),
        ),
        Rows(draw((300, 2, 3)), draw((300, 2, 3)), draw((300, 2)), 3 * seen, border),
    ]
    jacobian, residuals = [], []
    for one in rows:
        for k in range(len(one.first)):
            full = np.zeros((one.residuals.shape[1], count + size))
            first, width = int(one.first[k]), one.of_chain.shape[2]
            full[:, first : first + width] = one.of_chain[k]
            full[:, count + one.border[k]] = one.of_border[k]
            jacobian.append(full)
            residuals.append(one.residuals[k])
    j, r, added = np.vstack(jacobian), np.concatenate(residuals), rng.uniform(0.1, 1.0, count + size)
    dense = j.T @ j + np.diag(added)
    normal = BorderedEquations(rows, count, size, 6, parameters)
    factor = normal.factor(added)
    assert factor.solve(normal.b) == pytest.approx(np.linalg.solve(dense, -j.T @ r), rel=1e-9, abs=1e-12)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)
    some = rng.permutation(size)[: size // 2]
    inverse = np.linalg.inv(dense)[np.ix_(count + some, count + some)]
    assert factor.border_covariance(some) == pytest.approx(inverse, rel=1e-9, abs=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        normal.factor(-1e3 * added)
