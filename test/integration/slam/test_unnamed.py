"""Landmarks without a name, in a simulated park: found, merged, parted again, given up."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.graph import R2
from graph_slam_ros.lie import se2
from graph_slam_ros.runs.map_file import read_map, write_map
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation import Fault, faulty_recording, measurements
from graph_slam_ros.tools.simulation.recording import VelocityNoise, drive
from graph_slam_ros.tools.simulation.sensing import RangeBearing

S = 1_000_000_000
TICK_NS = S // 10
SIZE, TREES = times((0.5, 20), (1.0, 40))
"""Of the park; ``make soak`` has the whole."""
SENSOR = RangeBearing(0.1, np.deg2rad(0.5), SIZE * 15.0, np.pi)
NOISE = VelocityNoise((0.1, 0.01, 0.02), 0.5)
LAP_TICKS = round(SIZE * 700)  # a circle of 22 m, at 2 m/s
SOAKED = pytest.mark.skipif(not times(0, 1), reason="only in make soak")


def trees(seed, count=TREES, apart_m=3.0):
    """Places in a ring along the way, none close to another."""
    rng, out = np.random.default_rng(seed), []
    while len(out) < count:
        distance, angle = SIZE * rng.uniform(12.0, 34.0), rng.uniform(0.0, 2.0 * np.pi)
        at = np.array([distance * np.cos(angle), SIZE * 22.3 + distance * np.sin(angle)])
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


def path_rmse(view, recording):
    """Without alignment: map begins at the true start."""
    at = np.searchsorted(recording.stamps_ns, view.keyframes.stamps_ns)
    error = view.trajectory()[:, :2] - recording.T_world_base[at, :2]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def places(view):
    return np.array([view.solver.estimate([mark.vertex])[0][:2] for mark in view.landmarks.values()])


def nearest_true(view, recording):
    """Of each landmark the nearest true one, and how far that is."""
    true = np.array(list(recording.landmarks.values()))
    apart = np.linalg.norm(places(view)[:, None] - true[None], axis=2)
    return apart.argmin(axis=1), apart.min(axis=1)


@pytest.mark.parametrize("seed", times([4], [1, 2]))
def test_without_ids_the_path_is_as_near_to_the_truth_and_each_tree_is_there_once(seed):
    """Where a region was ordered anew, what hangs below it in the tree may have a later key: covariances are right."""
    recording = park(seed, laps=times(1, 2))
    named, slam = driven(recording, "id"), driven(recording)
    assert not slam.view.alarms
    assert path_rmse(slam.view, recording) < 1.5 * path_rmse(named.view, recording)
    which, apart = nearest_true(slam.view, recording)
    assert apart.max() < 1.0
    assert len(set(which.tolist())) == len(which) >= 0.8 * len(recording.landmarks)
    vertices = [mark.vertex for mark in slam.view.landmarks.values()]
    joint = slam.view.solver.joint_marginal(vertices)
    for k, one in enumerate(slam.view.solver.marginal(vertices)):
        assert one == pytest.approx(joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2], abs=1e-9)


@SOAKED
def test_what_moves_is_given_up():
    around = lambda t_s: SIZE * np.array([20.0 * np.sin(0.1 * t_s), 22.3 + 20.0 * np.cos(0.13 * t_s)])  # noqa: E731
    recording = park(4, laps=1, clutter=around)
    slam = driven(recording)
    assert slam.counters["landmarks", "given_up"] > 0
    assert nearest_true(slam.view, recording)[1].max() < 1.0


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


@pytest.mark.parametrize(
    ("places_of", "seconds", "expected"),
    [
        (lambda t_s: [(8.0, 2.0), (9.0, -3.0)] if not 8.0 < t_s < 16.0 else [], 26.0, [(8.0, 2.0), (9.0, -3.0)]),
        (lambda t_s: [(8.0, 2.0), (8.0, 2.6)], 15.0, [(8.0, 2.0), (8.0, 2.6)]),
    ],
    ids=["seen again after long", "two at once"],
)
def test_each_landmark_is_the_one_it_was_and_no_other(places_of, seconds, expected):
    slam = pipeline("joint")
    standing(slam, places_of, seconds)
    slam.process(Control("end"))
    slam.process(Control("optimize"))
    assert sorted(places(slam.view).tolist()) == [pytest.approx(at, abs=0.1) for at in expected]


def slipped(slam):
    """Odometry loses half a radian where nothing is seen; only later sightings tell which landmark was which."""
    world = np.array([[4.0, 0.0], [4.0, 2.2], [4.0, -2.2], [-3.0, 3.0], [-4.0, -2.0]])
    for k in range(700):
        t_s = 0.1 * k
        stamp_ns, told = S + round(t_s * S), 0.3 * np.sin(0.2 * t_s)
        heading = told + (0.5 if t_s > 40.0 else 0.0)
        slam.process(Odometry(stamp_ns, (0.0, 0.0, told)))
        if k % 5 == 0 and not 38.0 < t_s < 44.0:
            turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
            seen = (turn @ world.T).T
            shown = seen[seen[:, 0] > 0.0][: 1 if 44.0 <= t_s < 48.0 else None]
            at = [Sighting("", "position", tuple(map(float, p)), POSITION) for p in shown]
            slam.process(Sightings(stamp_ns, "seen", tuple(at)))
    slam.process(Control("end"))
    slam.process(Control("optimize"))
    return slam


def test_where_the_leader_changes_sightings_change_hands_and_a_replay_has_the_same_bytes():
    """The graph is that of the last decisions: each edge that is not withdrawn is a sighting of its landmark."""
    taken = []
    config = Config.from_mapping({"landmarks.association": "joint", "odometry.rotation_density": 0.3})
    slam = slipped(GraphSlam(config, sink=taken.append))
    assert slam.counters["landmarks", "reassigned"] > 0
    assert np.sort(places(slam.view), axis=0) == pytest.approx(np.array([[4.0, -2.2], [4.0, 0.0], [4.0, 2.2]]), abs=0.1)
    edges = slam.view.graph.edges_of("landmarks").tolist()
    live = {(edge, slam.view.graph.edge(edge).vertices[1]) for edge in edges if not slam.view.ledger.is_withdrawn(edge)}
    of = {mark.vertex: {one.edge for one in mark.seen} for mark in slam.view.landmarks.values()}
    assert {edge for edge, vertex in live if vertex in of} == set().union(*of.values())
    assert all(edge in of[vertex] for edge, vertex in live if vertex in of)
    again = GraphSlam(slam.view.config)
    for m in taken:
        again.process(m)
    assert again.view.solver.values.tobytes() == slam.view.solver.values.tobytes()
    assert list(again.view.landmarks) == list(slam.view.landmarks)


def test_G19_where_association_asks_of_what_cannot_be_solved_no_covariance_is_known():
    slam = pipeline("joint")
    standing(slam, lambda t_s: [(8.0, 2.0)], 10.0)
    assert np.isfinite(slam.view.landmark_covariances()).all()
    slam.view.graph.add_vertex(R2, [0.0, 0.0])  # nothing determines it
    slam._landmarks.anonymous.forget_belief()  # so that association asks the solver
    slam.process(Sightings(10 * S, "seen", (Sighting("", "position", (8.0, 2.0), POSITION),)))
    slam.process(Control("end"))
    slam.process(Control("optimize"))
    assert slam.counters["seen", "unclear_which"] == 2
    assert not slam.view.is_solved
    assert np.isnan(slam.view.landmark_covariances()).all()
    assert np.isnan(slam.view.keyframe_covariances()).all()


@functools.cache
def pairs():
    """Pairs of a tree and a pole 0.3 m apart, seen with an error of 0.1 m and half a degree."""
    places_of = trees(3, count=8, apart_m=SIZE * 9.0)
    points = np.vstack([places_of, places_of + np.array([0.3, 0.0])])
    sorts = ["tree"] * 8 + ["pole"] * 8
    names, rng = [f"{sort} {k}" for k, sort in enumerate(sorts)], np.random.default_rng(3)

    def observe(T_world_base):
        return SENSOR.observe(rng, T_world_base, names, points, "range_bearing")

    twists = np.tile([2.0, 0.0, 2.0 * np.pi / (LAP_TICKS * 0.1)], (LAP_TICKS + 100, 1))
    true = dict(zip(names, points.tolist(), strict=True))
    return drive(rng, (0.0, 0.0, 0.0), twists, TICK_NS, NOISE, observe, 5, true)


def seen_by(slam, *, has_class):
    """The pipeline after ``pairs`` without ids; sightings have a size, and perhaps a class."""

    def known(s):
        sort = s.id.split()[0]
        return replace(s, id="", sort=sort * has_class, size={"tree": 0.5, "pole": 0.15}[sort])

    for m in [*measurements(pairs()), Control("end"), Control("optimize")]:
        slam.process(replace(m, sightings=tuple(map(known, m.sightings))) if isinstance(m, Sightings) else m)
    return slam


def test_landmarks_near_one_another_are_told_apart_by_their_class_and_a_map_has_it_and_their_size(tmp_path):
    slam = seen_by(pipeline("joint"), has_class=True)
    at = places(slam.view)
    apart = np.linalg.norm(at[:, None] - at, axis=2) + 100.0 * np.eye(len(at))
    assert len(at) == 16
    assert apart.min(axis=1).max() < 0.6
    assert len(seen_by(pipeline("joint"), has_class=False).view.landmarks) < 16

    marks = slam.view.landmarks.values()
    assert sorted(mark.sort for mark in marks) == ["pole"] * 8 + ["tree"] * 8
    assert all(mark.size == pytest.approx({"tree": 0.5, "pole": 0.15}[mark.sort]) for mark in marks)
    write_map(tmp_path / "map.mcap", slam.view.snapshot())
    start = read_map(tmp_path)
    assert [(m.sort, m.size, m.sized) for m in start.landmarks.values()] == [(m.sort, m.size, m.sized) for m in marks]
    again = seen_by(GraphSlam(slam.view.config, start=start), has_class=True)
    seen = {name: [one.sighting.sort for one in mark.seen] for name, mark in again.view.landmarks.items()}
    wrong = sum(kind != start.landmarks[name].sort for name in start.landmarks for kind in seen[name])
    assert sum(map(len, seen.values())) > 1.5 * sum(len(mark.seen) for mark in marks), "they are seen again"
    assert wrong < 0.01 * sum(map(len, seen.values()))


@SOAKED
def test_where_odometry_slips_what_was_seen_since_is_explained_anew():
    recording = park(3, laps=1)
    lost, _ = faulty_recording(recording, [Fault.named("slip", at=0.4, lasting=0.08, factor=1.0 / 0.6)], seed=1)
    until_ns = int(recording.stamps_ns[round(0.48 * len(recording.stamps_ns))]) + 5 * S
    slam = pipeline("joint")
    for m in measurements(lost):
        if m.stamp_ns > until_ns:
            break
        slam.process(without_ids(m))
    assert [one.kind for one in slam.view.alarms] == ["translation"]
    assert path_rmse(slam.view, recording) < 0.5
    assert nearest_true(slam.view, recording)[1].max() < 1.0


def put_back(recording, from_ns, to_ns):
    """The measurements of a robot that is put where it was before, while its odometry notices nothing."""
    first, last = (int(np.searchsorted(recording.stamps_ns, one)) for one in (to_ns, from_ns))
    back = se2.compose(tuple(recording.T_odom_base[last]), se2.inverse(tuple(recording.T_odom_base[first])))
    before = [m for m in measurements(recording) if m.stamp_ns <= from_ns]
    again = [replace(m, stamp_ns=m.stamp_ns + from_ns - to_ns) for m in measurements(recording) if m.stamp_ns > to_ns]
    return before, [
        replace(m, T_odom_base=se2.compose(back, m.T_odom_base)) if isinstance(m, Odometry) else m for m in again
    ]


def test_a_robot_that_was_carried_is_found_by_what_it_sees_as_a_whole():
    recording = park(times(3, 1), laps=1)
    begin_ns = int(recording.stamps_ns[0])
    from_s, to_s = times((28, 12), (45, 20))
    before, again = put_back(recording, begin_ns + from_s * S, begin_ns + to_s * S)
    slam = pipeline("joint")
    for m in before:
        slam.process(without_ids(m))
    assert not slam.view.alarms
    for m in again:
        slam.process(without_ids(m))
        if m.stamp_ns > begin_ns + (from_s + 8) * S:
            break
    (alarm,) = slam.view.alarms
    assert alarm.began_ns < begin_ns + (from_s + 5) * S
    assert len(slam.view.segments) == 2
    stamps_ns = slam.view.keyframes.stamps_ns
    after = np.flatnonzero(stamps_ns > begin_ns + (from_s + 1) * S)
    same = np.searchsorted(stamps_ns, stamps_ns[after] - (from_s - to_s) * S)  # it was there before, and sees the same
    path = slam.view.trajectory()[:, :2]
    assert np.linalg.norm(path[after] - path[same], axis=1).max() < 0.6
    assert len(slam.view.landmarks) <= len(recording.landmarks)


SCALE = 1.1  # odometry tells so many times the way
FACTORS = {"landmarks.association": "joint", "robust.noise_scale": "configured"}


@pytest.fixture(scope="module")
def circle():
    return park(1, laps=1)


def too_long(circle):
    for m in [*measurements(circle), Control("end"), Control("optimize")]:
        if isinstance(m, Odometry):
            x, y, heading = m.T_odom_base
            m = replace(m, T_odom_base=(SCALE * x, SCALE * y, heading))
        yield without_ids(m)


@pytest.fixture(scope="module")
def corrected(circle, tmp_path_factory):
    """The pipeline after the drive, and its map as it is read back."""
    slam, folder = GraphSlam(Config.from_mapping(FACTORS)), tmp_path_factory.mktemp("corrected")
    for m in too_long(circle):
        slam.process(m)
    write_map(folder / "map.mcap", slam.view.snapshot())
    return slam, read_map(folder)


def test_the_factor_that_the_association_finds_corrects_the_graph(circle, corrected):
    slam, _ = corrected
    assert slam.view.corrections.total("odometry", "distance") == pytest.approx(1.0 / SCALE, abs=0.015)
    assert slam.view.corrections.total("odometry", "turn") == 1.0, "one circle does not determine it"
    assert slam.view.corrections.lines() == {"odometry.distance_factor": pytest.approx(1.0 / SCALE, abs=0.015)}
    assert [one.parameter.name for one in slam.view.corrected] == ["distance"] * len(slam.view.corrected)
    assert path_rmse(slam.view, circle) < 0.4
    assert len(slam.view.landmarks) == len(circle.landmarks)


def test_a_map_has_the_corrected_measurements_and_goes_on_with_its_factors_whatever_is_configured(corrected):
    slam, state = corrected
    assert slam.view.corrected
    assert state.calibration == slam.view.corrections.totals()
    for mine, read in zip(slam.view.graph.tables.values(), state.graph.tables.values(), strict=True):
        np.testing.assert_array_equal(read.measured.values, mine.measured.values)
        np.testing.assert_array_equal(read.sqrt_information.values, mine.sqrt_information.values)
    state.values = slam.view.solver.values
    again = GraphSlam(Config.from_mapping(FACTORS | {"odometry.distance_factor": 1.2}), start=state)
    assert again.view.corrections.totals() == pytest.approx(slam.view.corrections.totals())
