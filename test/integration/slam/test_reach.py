"""Distances that no sensor can mean, and what is left of a drive after them; directions straight up and down."""

import math

import numpy as np
import pytest

from graph_slam_ros.slam import Closure, Config, Control, GraphSlam, Odometry, Sighting, Sightings

S, RATE = 10**9, 10
SOURCE = "detections"


def settings(dimensions, association="id", **more):
    return Config.from_mapping(
        {"world.dimensions": dimensions, "landmarks.association": association, "solve.max_iterations": 20} | more
    )


def pose(dimensions, second):
    """On a circle of 2 m, and the rotation from the robot's axes to the map's."""
    angle = 0.3 * second
    at = np.zeros(dimensions)
    at[:2] = 2.0 * np.sin(angle), 2.0 * (1.0 - np.cos(angle))
    turn = np.eye(dimensions)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    whole = (*at, angle) if dimensions == 2 else (*at, 0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))
    return at, turn, tuple(map(float, whole))


def drive(config, far=None, seconds=6):
    """Past twelve landmarks; in the second third of the time with a detection far away in every message."""
    n = config.space.dimensions
    taken, rng = [], np.random.default_rng(0)
    slam = GraphSlam(config, sink=taken.append)
    marks = rng.uniform(-10.0, 10.0, (12, n))
    covariance = tuple((np.eye(n) * 0.05**2).ravel())
    has_id = config.landmarks.association == "id"
    for k in range(seconds * RATE):
        at, turn, whole = pose(n, k / RATE)
        slam.process(Odometry(S + k * S // RATE, whole))
        near = [j for j in range(12) if np.linalg.norm(marks[j] - at) < 9.0]
        seen = [(f"m{j}", turn.T @ (marks[j] - at) + rng.normal(0.0, 0.02, n)) for j in near]
        if far is not None and seconds // 3 <= k / RATE < 2 * seconds // 3:
            seen.insert(0, ("far", np.asarray(far)))
        items = (Sighting(name * has_id, "position", tuple(map(float, z)), covariance) for name, z in seen)
        slam.process(Sightings(S + k * S // RATE, SOURCE, tuple(items)))
    for event in ("end", "optimize"):
        slam.process(Control(event))
    return slam, taken, at


def written(view):
    return view.trajectory().tobytes(), view.keyframe_covariances().tobytes(), list(view.landmarks)


@pytest.mark.parametrize("dimensions, association", [(2, "joint"), (3, "id")])
def test_a_detection_at_1e8_m_is_refused_and_changes_nothing(dimensions, association):
    config = settings(dimensions, association)
    far = np.zeros(dimensions)
    far[-1] = 1e8
    slam, taken, _ = drive(config, far)
    assert not slam.view.failing
    counted = slam.counters.as_dict()
    assert counted[SOURCE].pop("beyond_max_distance") == 2 * RATE
    undisturbed, _, _ = drive(config)
    assert written(slam.view) == written(undisturbed.view)
    replayed = GraphSlam(config)
    for m in taken:
        replayed.process(m)
    assert written(replayed.view) == written(slam.view)
    assert replayed.counters.as_dict()[SOURCE]["beyond_max_distance"] == 2 * RATE


@pytest.mark.parametrize("dimensions, association, axis", [(2, "joint", -1), (3, "id", -1)])
def test_where_it_is_allowed_to_see_so_far_every_solve_still_succeeds(dimensions, association, axis):
    config = settings(dimensions, association, **{f"{SOURCE}.max_distance_m": 1e9})
    far = np.zeros(dimensions)
    far[axis] = 1e8
    slam, _, at = drive(config, far)
    assert not slam.view.failing
    assert "solver" not in slam.counters.as_dict()
    assert np.linalg.norm(slam.view.trajectory()[-1][: len(at)] - at) < 0.1


def refused(limit, *distances, kind="range"):
    slam, more = GraphSlam(Config.from_mapping(limit)), (0.0,) * (kind == "position")
    covariance = (0.01, 0.0, 0.0, 0.01) if more else (0.01,)
    for k in range(3):
        slam.process(Odometry(k * S, (0.0, 0.0, 0.0)))
    seen = (Sighting("a", kind, (distance, *more), covariance) for distance in distances)
    slam.process(Sightings(S, SOURCE, tuple(seen)))
    slam.process(Control("flush"))
    return slam.counters[SOURCE, "beyond_max_distance"]


def test_a_given_limit_is_kept_to_the_letter_and_a_bearing_has_none():
    limit = {f"{SOURCE}.max_distance_m": 0.5}
    assert refused(limit, 0.5, 0.51, 0.4, kind="position") == 1
    assert refused(limit, 0.6) == 1
    assert refused(limit, 1.0, kind="bearing") == 0
    assert refused({}, 9.9e4, 1.1e5) == 1


def test_a_closure_farther_than_any_is_refused_and_counted():
    slam = GraphSlam(settings(2))
    for k in range(50):
        slam.process(Odometry(S + k * S // RATE, (0.1 * k, 0.0, 0.0)))
    identity = tuple(np.eye(3).ravel() * 1e-4)
    slam.process(Closure(5 * S, 2 * S, "loops", (2e8, 0.0, 0.0), identity))
    slam.process(Closure(5 * S, 2 * S, "loops", (3.0, 0.0, 0.0), identity))
    for event in ("end", "optimize"):
        slam.process(Control(event))
    assert slam.counters.as_dict() == {"loops": {"beyond_max_distance": 1}}
    assert len(slam.view.graph.edges_of("closures")) == 1


@pytest.mark.parametrize(
    "kind, height, aside", [("bearing", 5.0, 0.0), ("range_bearing", -2.0, 1e-7), ("bearing", -2.0, 0.02)]
)
def test_a_landmark_at_the_zenith_or_nadir_is_found_and_every_solve_succeeds(kind, height, aside):
    slam, mark, rng = GraphSlam(settings(3)), np.array([1.5, aside, height]), np.random.default_rng(1)
    for k in range(60):
        x = 0.05 * k
        slam.process(Odometry(S + k * S // RATE, (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
        p = mark - (x, 0.0, 0.0) + (rng.normal(0.0, 0.005, 3) if k != 30 else 0.0)
        flat = math.hypot(p[0], p[1])
        angles = math.atan2(p[1], p[0]), math.atan2(p[2], flat)
        measured = angles if kind == "bearing" else (float(np.linalg.norm(p)), *angles)
        covariance = tuple((np.eye(len(measured)) * 1e-4).ravel())
        slam.process(Sightings(S + k * S // RATE, SOURCE, (Sighting("lamp", kind, measured, covariance),)))
    for event in ("end", "optimize"):
        slam.process(Control(event))
    assert not slam.view.failing
    assert slam.view.report.converged
    assert slam.counters.as_dict() == {}
    assert np.linalg.norm(slam.view.solver.estimate([slam.view.landmarks["lamp"].vertex])[0] - mark) < 0.1
