"""Which landmark is it: scans and their clusters, the beam of hypotheses, and the moves that take back."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.association import hindsight
from graph_slam_ros.slam.association.beam import BeamSettings
from graph_slam_ros.slam.association.bordered import BorderedEquations, Rows
from graph_slam_ros.slam.association.explanation import Costs, Drive, Estimate
from graph_slam_ros.slam.association.moves import refined
from graph_slam_ros.slam.association.presence_check import presence
from graph_slam_ros.slam.association.scans import NEARBY_S, Cluster, Reckoned, Scan, Seen, motion_between
from graph_slam_ros.slam.association.stretches import laid_on_the_map
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.landmarks.rotations import rotation

S = 1_000_000_000
NOISE = OdometryConfig(turn_per_rad=0.02, turn_per_m=0.002, turn_per_s=0.0002, way_per_m=0.002, way_per_s=0.0001)
SETTINGS = BeamSettings(quantile(0.9999, 2), 2 * float(np.log(0.03)))
COSTS = Costs(14.0, 25.0, 6.0)
WHERE = PoseAtStamp(0, 0, 0, PLANAR.identity, np.zeros((3, 3)))
SEEN = Seen("seen", Sighting("", "position", (1.0, 0.0), (0.01, 0.0, 0.0, 0.01)), WHERE)


def at(second, pose, **sums):
    return Reckoned(round(second * S), tuple(map(float, pose)), moving_s=second, **sums)


def scan(here, points, sigma, seen=()):
    """What is seen of points from the robot at a place by odometry."""
    return Scan(here, WHERE, tuple(Cluster(np.array(p), sigma**2 * np.eye(2), seen) for p in points))


def motions(scans, jump=0.0):
    return [motion_between(PLANAR, NOISE, a.at, b.at, jump * np.eye(3)) for a, b in itertools.pairwise(scans)]


ROUND = np.array([[6.0, 0.0], [5.0, 6.0], [-6.0, 3.0], [-3.0, -6.0], [7.0, 7.5]])


def circle(laps=3, per_lap=40):
    """Scans from a circle of 2 m."""
    rng, scans, truth, pose, step = np.random.default_rng(0), [], [], np.zeros(3), 2.0 * np.pi / per_lap
    for k in range(laps * per_lap):
        seen = (ROUND - pose[:2]) @ rotation(pose[2:])
        near = [j for j in range(len(ROUND)) if np.linalg.norm(seen[j]) < 7.0]
        points = seen[near] + rng.normal(0.0, 0.1, (len(near), 2))
        scans.append(scan(at(0.5 * k, pose, way=2.0 * step * k, turned=step * k), points, 0.1))
        truth.append(near)
        pose[:2] += 2.0 * step * np.array([np.cos(pose[2] + step / 2), np.sin(pose[2] + step / 2)])
        pose[2] += step
    return scans, np.concatenate(truth)


def around(scans):
    """The robot stands at each scan: clocks do not matter."""
    return np.zeros((len(scans), len(NEARBY_S), 3))


def of_drive(scans, which, nearby=None, settings=SETTINGS, jump=0.0):
    drive = Drive(scans, motions(scans, jump), around(scans) if nearby is None else nearby, settings, COSTS)
    at, clocks = np.array([one.at.pose for one in scans]), np.zeros(len(drive.topics))
    start = Estimate(at[:, :2], rotation(at[:, 2:]), np.empty((0, 2)), np.zeros(2), clocks, np.array(which))
    return drive, drive.staged(start)


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
        points = seen + rng.normal(0.0, 0.05, seen.shape)
        scans.append(scan(at(t, place(t), turned=turned, way=way), points, 0.05, (SEEN,)))
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
    frozen = hindsight.FrozenScans(tuple(scans), steps, nearby, poses, np.zeros(2), wrong)
    found = {}
    for most in (1_000_000, 0):
        monkeypatch.setattr("graph_slam_ros.slam.association.explanation._MOST_WORK", most)
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


@pytest.mark.parametrize("halls", [1, 2])
def test_which_of_two_halls_alike_it_is_stays_open(halls):
    """A round in each hall, then odometry jumps, and what is seen next may be either."""
    scans, which, once, seen_in_one, way, turned = [], [], *circle(laps=1), 0.0, 0.0
    for hall in range(halls + 1):
        is_lost = hall == halls
        some, away = (once[:40], 17.0) if is_lost else (once, 40.0 * hall)
        for k, one in enumerate(some):
            pose, sums = one.at.pose + np.array([away, 0.0, 0.0]), {"way": way + one.at.way, "segment": int(is_lost)}
            scans.append(replace(one, at=at(100.0 * hall + 0.5 * k, pose, turned=turned + one.at.turned, **sums)))
        way, turned = scans[-1].at.way + 40.0, scans[-1].at.turned
        which.append(5 * hall + seen_in_one[: sum(len(one.clusters) for one in some)])
    drive, e = of_drive(scans, np.concatenate(which), jump=100.0)
    assert len(e.landmarks) == 5 * (halls + 1)
    laid, undecided = laid_on_the_map(drive, e)
    assert len(laid.landmarks) == (5 if halls == 1 else 15)
    assert (undecided > 0) == (halls == 2)


def test_the_equations_of_a_chain_with_a_border_are_solved_as_the_dense_ones():
    landmarks, poses, parameters = 40, 60, 3
    rng = np.random.default_rng(landmarks)
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
    normal = BorderedEquations(rows, count, size, 6)
    factor = normal.factor(added)
    assert factor.solve(normal.b) == pytest.approx(np.linalg.solve(dense, -j.T @ r), rel=1e-9, abs=1e-12)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)
    some = rng.permutation(size)[: size // 2]
    inverse = np.linalg.inv(dense)[np.ix_(count + some, count + some)]
    assert factor.border_covariance(some) == pytest.approx(inverse, rel=1e-9, abs=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        normal.factor(-1e3 * added)
