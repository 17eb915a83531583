"""Landmarks without a name, in a simulated park: found, merged, parted again, given up."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.graph import R2
from graph_slam_ros.simulation import measurements
from graph_slam_ros.simulation.motion import VelocityNoise
from graph_slam_ros.simulation.recording import drive
from graph_slam_ros.simulation.sensing import RangeBearing
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings

S = 1_000_000_000
TICK_NS = S // 10
SENSOR = RangeBearing(0.1, np.deg2rad(0.5), 15.0, np.pi)
NOISE = VelocityNoise((0.1, 0.01, 0.02), 0.5)
LAP_TICKS = 700  # a circle of 22 m, at 2 m/s


def trees(seed, count=40, apart_m=3.0):
    """Places in a ring along the way, none close to another."""
    rng, out = np.random.default_rng(seed), []
    while len(out) < count:
        distance, angle = rng.uniform(12.0, 34.0), rng.uniform(0.0, 2.0 * np.pi)
        at = np.array([distance * np.cos(angle), 22.3 + distance * np.sin(angle)])
        if all(np.linalg.norm(at - other) > apart_m for other in out):
            out.append(at)
    return np.array(out)


def park(seed, laps=2, clutter=None):
    """Driven round in a circle; ``clutter`` is seen as well: a function of time in seconds to a position."""
    rng, points = np.random.default_rng(seed), trees(seed)
    names, ticks = [str(k) for k in range(len(points))], iter(range(10**6))

    def observe(T_world_base):
        t_s = next(ticks) * 0.5
        moving = points[:0] if clutter is None else np.array([clutter(t_s)])
        return SENSOR.observe(rng, T_world_base, [*names, "clutter"], np.vstack([points, moving]), "range_bearing")

    rate = 2.0 * np.pi / (LAP_TICKS * 0.1)
    twists = np.tile([2.0, 0.0, rate], (laps * LAP_TICKS + 100, 1))
    return drive(
        rng, (0.0, 0.0, 0.0), twists, TICK_NS, NOISE, observe, 5, dict(zip(names, points.tolist(), strict=True))
    )


def pipeline(association, **settings):
    named = {f"landmarks.{key}": value for key, value in settings.items()}
    return GraphSlam(Config.from_mapping({"landmarks.association": association} | named))


def without_ids(m):
    return replace(m, sightings=tuple(replace(s, id="") for s in m.sightings)) if isinstance(m, Sightings) else m


def driven(recording, association="joint", **settings):
    slam = pipeline(association, **settings)
    for m in measurements(recording):
        slam.process(m if association == "id" else without_ids(m))
    slam.process(Control("end"))
    slam.process(Control("optimize"))
    return slam


def path_rmse(slam, recording):
    """Without alignment: map begins at the true start."""
    at = np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns)
    error = slam.trajectory()[:, :2] - recording.T_world_base[at, :2]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def places(slam):
    return np.array([slam.solver.estimate([mark.vertex])[0][:2] for mark in slam.landmarks.values()])


def nearest_true(slam, recording):
    """Of each landmark the nearest true one, and how far that is."""
    true = np.array(list(recording.landmarks.values()))
    apart = np.linalg.norm(places(slam)[:, None] - true[None], axis=2)
    return apart.argmin(axis=1), apart.min(axis=1)


@functools.cache
def known(seed):
    """A recording, and what comes of it with ids."""
    recording = park(seed)
    return recording, driven(recording, "id")


@pytest.mark.parametrize(("association", "seed"), [("nearest", 1), ("joint", 1), *times([], [("joint", 2)])])
def test_without_ids_the_path_is_as_near_to_the_truth_and_each_tree_is_there_once(association, seed):
    recording, named = known(seed)
    unnamed = driven(recording, association)
    assert path_rmse(unnamed, recording) < 1.5 * path_rmse(named, recording)
    which, apart = nearest_true(unnamed, recording)
    assert apart.max() < 1.0
    assert len(set(which.tolist())) == len(which) >= 0.8 * len(recording.landmarks)


def test_covariances_are_those_of_the_joint_one_where_landmarks_came_and_went():
    """Where a region was ordered anew, what hangs below it in the tree may have a later key."""
    slam = driven(park(1))
    vertices = [mark.vertex for mark in slam.landmarks.values()]
    joint = slam.solver.joint_marginal(vertices)
    for k, one in enumerate(slam.solver.marginal(vertices)):
        assert one == pytest.approx(joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], abs=1e-9)


def test_what_moves_is_given_up():
    recording = park(4, laps=1, clutter=lambda t_s: (20.0 * np.sin(0.1 * t_s), 22.3 + 20.0 * np.cos(0.13 * t_s)))
    slam = driven(recording)
    assert slam.counters["landmarks", "given_up"] > 0
    assert nearest_true(slam, recording)[1].max() < 1.0


POSITION = (0.01, 0.0, 0.0, 0.01)


def standing(slam, places_of, seconds, begin_s=0.0):
    """Drive straight on at 0.5 m/s, and see at each half second what ``places_of`` says is there, in odom."""
    for k in range(int(seconds * 10)):
        t_s = begin_s + 0.1 * k
        stamp_ns, x = S + round(t_s * S), 0.5 * t_s
        slam.process(Odometry(stamp_ns, (x, 0.0, 0.0)))
        if k % 5 == 0:
            at = [(px - x, py) for px, py in places_of(t_s)]
            slam.process(Sightings(stamp_ns, "seen", tuple(Sighting("", "position", p, POSITION) for p in at)))


def test_a_landmark_seen_again_after_long_is_merged_into_the_one_it_was():
    slam = pipeline("joint", follow_s=5.0)
    standing(slam, lambda t_s: [(8.0, 2.0), (9.0, -3.0)] if not 8.0 < t_s < 16.0 else [], 26.0)
    assert slam.counters["landmarks", "merged"] == 2
    assert len(slam.landmarks) == 2
    assert np.sort(places(slam), axis=0) == pytest.approx(np.array([[8.0, -3.0], [9.0, 2.0]]), abs=0.1)


def test_a_merger_whose_sightings_do_not_fit_is_parted_again():
    slam = pipeline("joint")
    standing(slam, lambda t_s: [(8.0, 2.0), (9.0, -3.0)], 10.0)
    first, second = slam.landmarks
    slam._landmarks.anonymous._merge_into(first, second)
    slam.process(Control("optimize"))
    assert list(slam.landmarks) == [first]
    standing(slam, lambda t_s: [], 10.0, begin_s=10.0)
    slam.process(Control("optimize"))
    assert slam.counters["landmarks", "parted"] == 1
    assert sorted(slam.landmarks) == sorted([first, second])
    assert np.sort(places(slam), axis=0) == pytest.approx(np.array([[8.0, -3.0], [9.0, 2.0]]), abs=0.1)


def test_two_seen_at_once_are_never_one():
    slam = pipeline("joint", follow_s=1.0)
    standing(slam, lambda t_s: [(8.0, 2.0), (8.0, 2.6)], 15.0)
    assert len(slam.landmarks) == 2
    assert slam.counters["landmarks", "merged"] == 0


@pytest.mark.parametrize("association", ["nearest", "joint"])
def test_by_range_and_bearing_from_as_far_as_ever_nothing_known_is_taken_for_it(association):
    """Across it is so vague that along it there is nothing but rounding: a singular matrix."""
    allowed = {"inputs.names": "odom seen", "seen.max_distance_m": 1e9}  # else it is refused before
    slam = GraphSlam(Config.from_mapping({"landmarks.association": association} | allowed))
    standing(slam, lambda t_s: [(8.0, 2.0), (9.0, -3.0)], 10.0)
    noise = (1e-4, 0.0, 0.0, 1.0)
    far = [Sighting("", "range_bearing", (6e8, bearing), noise) for bearing in np.linspace(0.0, 3.0, 50).tolist()]
    slam.process(Sightings(10 * S, "seen", tuple(far)))
    slam.process(Control("end"))
    assert slam.counters.as_dict() == {}
    assert len(slam.landmarks) == 2


def test_G19_where_association_asks_of_what_cannot_be_solved_no_covariance_is_known():
    slam = pipeline("joint")
    standing(slam, lambda t_s: [(8.0, 2.0)], 10.0)
    assert np.isfinite(slam.landmark_covariances()).all()
    slam.graph.add_vertex(R2, [0.0, 0.0])  # nothing determines it
    slam.process(Sightings(10 * S, "seen", (Sighting("", "position", (8.0, 2.0), POSITION),)))
    slam.process(Control("flush"))
    assert slam.counters["seen", "unclear_which"] == 1
    assert not slam.is_solved
    assert np.isnan(slam.landmark_covariances()).all()
    assert np.isnan(slam.keyframe_covariances()).all()
