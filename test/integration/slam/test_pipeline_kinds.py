"""Every kind of measurement through the pipeline, in the plane and in space, against a world that is known."""

import itertools

import numpy as np
import pytest

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.lie import se2, so3
from graph_slam_ros.measurements.types import from_record, to_record
from graph_slam_ros.slam import Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.frontend.motion_compensation import predict

S = 1_000_000_000
T0 = 1_700_000_000 * S
HZ = 20
END = (Control("end"), Control("optimize"))
BOTH = pytest.mark.parametrize("space", [PLANAR, SPATIAL], ids=["plane", "space"])
SENSOR = {PLANAR: (0.3, -0.2, 0.5), SPATIAL: (0.3, -0.2, 0.1, *so3.exp((0.2, -0.3, 0.5)))}
SOURCES = {
    "inputs__names": "wheels camera",
    "wheels__type": "nav_msgs/msg/Odometry",
    "camera__type": "nav_msgs/msg/Odometry",
}
EXACT = 1e-3  # standard deviation given to measurements without error


def slam(space, **settings):
    base = {"world.dimensions": space.dimensions, "ordering.window_s": 0.0, "landmarks.added_sigma_m": 0.0}
    base |= {"odometry.noise": "density", "landmarks.loss": "none"}
    return GraphSlam(Config.from_mapping(base | {k.replace("__", "."): v for k, v in settings.items()}))


def twist(space, t):
    """Velocities of a winding drive, banking and climbing in space."""
    if space is PLANAR:
        return (1.0, 0.0, 0.6 * np.sin(0.7 * t))
    return (1.0, 0.0, 0.2 * np.cos(t), 0.3 * np.sin(1.3 * t), 0.2 * np.cos(0.9 * t), 0.6 * np.sin(0.7 * t))


def drive(space, seconds, drift=0.0):
    """True poses and those of odometry, which turns a little too much, at HZ."""
    true, odom = [space.identity], [space.identity]
    for k in range(round(seconds * HZ)):
        v = np.array(twist(space, k / HZ)) / HZ
        true.append(space.group.retract(true[-1], tuple(v)))
        v[-1] += drift / HZ
        odom.append(space.group.retract(odom[-1], tuple(v)))
    return true, odom


def stamp(k):
    return T0 + k * S // HZ


def covariance(size, sigma=EXACT):
    return tuple((sigma**2 * np.eye(size)).ravel().tolist())


def floats(numbers):
    return tuple(float(x) for x in numbers)


def sighting(space, kind, name, landmark, T_map_base, sigma=EXACT):
    """What a sensor sees of a landmark, without error."""
    group, T_base_sensor = space.group, SENSOR[space]
    n = space.dimensions
    if kind == "pose":
        return Sighting(name, kind, floats(group.between(T_map_base, landmark)), covariance(space.dof, sigma))
    if kind == "position":
        return Sighting(name, kind, floats(group.act(group.inverse(T_map_base), landmark[:n])), covariance(n, sigma))
    p = group.act(group.inverse(group.compose(T_map_base, T_base_sensor)), landmark[:n])
    said = predict(space, kind, np.array(p))
    return Sighting(name, kind, floats(said), covariance(len(said), sigma), T_base_sensor)


def landmarks(space):
    rng = np.random.default_rng(5)
    n = space.dimensions
    points = {f"m{k}": rng.uniform(-4, 8, n) for k in range(8)}
    if space is PLANAR:
        return {name: (*p, rng.uniform(-3, 3)) for name, p in points.items()}
    return {name: (*p, *so3.exp(tuple(rng.standard_normal(3)))) for name, p in points.items()}


def errors(space, view, true):
    """Distance of every keyframe from where it was."""
    k = (view.keyframes.stamps_ns - T0) * HZ // S
    n = space.dimensions
    return np.linalg.norm(view.trajectory()[:, :n] - np.array(true)[k, :n], axis=1)


@pytest.mark.parametrize(
    ("space", "kind"),
    [
        *((PLANAR, kind) for kind in ("position", "bearing", "range")),
        *((SPATIAL, kind) for kind in ("pose", "range_bearing", "bearing")),
    ],
)
def test_landmarks_seen_in_any_way_put_the_path_right(space, kind):
    world, observe = everything(space, [kind])
    pipeline, true, odom = driven(space, 20.0, observe, drift=0.02, each=4)
    drifted = np.linalg.norm(np.subtract(true[-1], odom[-1])[: space.dimensions])
    assert set(pipeline.view.landmarks) == set(world)
    assert not pipeline.view.waiting
    assert errors(space, pipeline.view, true).max() < 0.1 * drifted
    for name, landmark in pipeline.view.landmarks.items():
        found = pipeline.view.solver.estimate([landmark.vertex])[0]
        assert found[: space.dimensions] == pytest.approx(world[name][: space.dimensions], abs=0.1 * drifted)


@BOTH
def test_what_is_seen_between_keyframes_by_a_sensor_anywhere_costs_nothing_where_all_is_exact(space):
    _, observe = everything(space, ["position", "pose", "range_bearing", "bearing", "range"])
    pipeline, *_ = driven(space, 6.0, observe, each=3, keyframes__min_distance_m=1.0)
    assert pipeline.view.report.chi2_final < 1e-6


def test_G3_a_landmark_seen_by_bearing_from_one_place_waits_and_says_why():
    pipeline = slam(PLANAR)
    for k in range(40):
        pipeline.process(Odometry(stamp(k), (0.0, 0.0, 0.0)))
        pipeline.process(
            Sightings(stamp(k), "seen", (sighting(PLANAR, "bearing", "a", (3.0, 1.0, 0), PLANAR.identity),))
        )
    assert not pipeline.view.landmarks
    assert "too few" in pipeline.view.waiting["a"]


def test_G5_both_mirror_places_of_a_landmark_are_kept_until_the_robot_turns():
    pipeline, at = slam(PLANAR), PLANAR.identity
    for k in range(160):
        pipeline.process(Odometry(stamp(k), at))
        if k == 60:  # straight ahead all the way: the beacon is on the left or on the right
            waiting = pipeline._landmarks.map.undetermined["a"]
            assert "2 places fit" in pipeline.view.waiting["a"]
            found = sorted((place.position.tolist() for place in waiting.places), key=lambda at: at[1])
            assert np.array(found) == pytest.approx(np.array([[2.0, -3.0], [2.0, 3.0]]), abs=0.01)
        s = Sighting("a", "range", (float(np.hypot(at[0] - 2.0, at[1] - 3.0)),), covariance(1, 0.01))
        pipeline.process(Sightings(stamp(k), "ranges", (s,)))
        at = se2.retract(at, (1.0 / HZ, 0.0, 0.0 if k < 60 else 0.8 / HZ))
    view = pipeline.view
    assert view.solver.estimate([view.landmarks["a"].vertex])[0] == pytest.approx([2.0, 3.0], abs=0.05)
    assert not view.waiting


@BOTH
def test_a_fix_that_lacks_an_axis_tells_of_the_others(space):
    true, odom = drive(space, 10.0)
    n = space.dimensions
    pipeline = slam(space)
    [pipeline.process(Odometry(stamp(k), at)) for k, at in enumerate(odom)]
    unknown = np.eye(n) * 1e-4
    unknown[0, 0] = 1e6
    measured = np.array(true[-1][:n]) + [0.0, 0.1, 0.1][:n]  # a little off, and x is nonsense
    measured[0] = 1e5
    pipeline.process(Fix(stamp(len(odom) - 1), "fix", "position", floats(measured), floats(unknown.ravel())))
    [pipeline.process(event) for event in END]
    assert len(pipeline.view.graph.tables[space.coordinate_prior]) == n - 1
    last = pipeline.view.trajectory()[-1, :n]
    assert np.abs(np.array(odom[-1][1:n]) - measured[1:]).min() > 0.09, "odometry alone is off"
    assert last[1:] == pytest.approx(measured[1:], abs=0.03)
    assert abs(last[0] - true[-1][0]) < 2.0  # turned a little, but not drawn to the nonsense


def test_the_next_odometry_takes_over_where_the_first_falls_silent_and_gives_way_where_it_is_back():
    true, odom = drive(SPATIAL, 20.0)
    elsewhere = floats(SPATIAL.group.exp(tuple(0.3 * np.arange(1, SPATIAL.dof + 1))))
    pipeline = slam(SPATIAL, odometry__timeout_s=0.3, **SOURCES)
    for k, at in enumerate(odom):
        pipeline.process(Odometry(stamp(k), floats(SPATIAL.group.compose(elsewhere, at)), None, "camera"))
        if not 100 <= k < 200:
            pipeline.process(Odometry(stamp(k), at, None, "wheels"))
    [pipeline.process(event) for event in END]
    counted = pipeline.counters.as_dict()
    assert counted["camera"]["switched_to"] == 1
    assert counted["wheels"]["switched_to"] == 2  # the camera came first of all
    assert counted["camera"]["not_in_use"] > 250
    assert errors(SPATIAL, pipeline.view, [SPATIAL.group.compose(elsewhere, p) for p in true]).max() < 1e-3
    assert np.diff(pipeline.view.keyframes.stamps_ns).max() < 0.5 * S


def driven(space, seconds, observe, drift=0.0, each=7, **settings):
    """The pipeline after a drive on which at every so many stamps something is observed; true poses and odometry."""
    true, odom = drive(space, seconds, drift)
    pipeline = slam(space, **settings)
    for k, at in enumerate(odom):
        pipeline.process(Odometry(stamp(k), floats(at)))
        if k % each == 1:
            pipeline.process(from_record(to_record(observe(k, true[k]))))
    [pipeline.process(event) for event in END]
    return pipeline, true, odom


def everything(space, kinds, sigma=EXACT):
    """What is seen of all landmarks, in turn in these ways."""
    world = landmarks(space)

    def observe(k, T_map_base):
        several = zip(itertools.cycle(kinds), world.items(), strict=False)
        return Sightings(
            stamp(k), "seen", tuple(sighting(space, kind, *one, T_map_base, sigma) for kind, one in several)
        )

    return world, observe
