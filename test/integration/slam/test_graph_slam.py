"""The pipeline: measurements in, a graph and an estimate out; each rule against a computation of its own."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from graph_slam_ros.errors import FormatError, SingularError
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE, SE2, TAG_POSITION
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import from_record, to_record
from graph_slam_ros.runs.outcome import shortcomings
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.slam import Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation import measurements, simulate

S = 1_000_000_000
T0 = 1_700_000_000 * S
POINT = (0.01, 0.002, 0.002, 0.04)
POSE = (0.01, 0.001, 0.0, 0.001, 0.02, 0.002, 0.0, 0.002, 0.005)


def odometry(t_s, pose, twist=None):
    return Odometry(T0 + round(t_s * S), pose, twist)


def seen(t_s, *sightings, topic="/landmarks"):
    return Sightings(T0 + round(t_s * S), topic, tuple(sightings))


def point(name="a", at=(2.0, 1.0), covariance=POINT):
    return Sighting(name, "position", at, covariance)


def tag(name="a", at=(2.0, 1.0, 0.5), covariance=POSE):
    return Sighting(name, "pose", at, covariance)


def slam(sink=None, **sections):
    """A pipeline with no window, exact sightings and keyframes by motion alone, unless told otherwise."""
    base = {"ordering.window_s": 0.0, "landmarks.added_sigma_m": 0.0, "odometry.noise": "density"}
    base |= {"keyframes.shared_noise": 1e9}
    dotted = {f"{section}.{key}": value for section, keys in sections.items() for key, value in keys.items()}
    return GraphSlam(Config.from_mapping(base | dotted), sink)


def run(pipeline, *items):
    for item in items:
        pipeline.process(item)
    return pipeline


def table(pipeline, edge_type):
    return pipeline.graph.tables[edge_type]


def covariance_of(pipeline, edge_type, row=-1):
    root = table(pipeline, edge_type).sqrt_information.values[row]
    return np.linalg.inv(root.T @ root)


def g2o(pipeline, tmp_path):
    file = tmp_path / "graph.g2o"
    write_g2o(file, G2oFile(pipeline.graph, list(range(pipeline.graph.vertex_count))), pipeline.solver.estimate)
    return file.read_bytes()


def straight(seconds, speed=1.0, hz=10):
    return [odometry(k / hz, (speed * k / hz, 0.0, 0.0)) for k in range(int(seconds * hz) + 1)]


END = (Control("end"), Control("optimize"))


@pytest.fixture(scope="module")
def recorded():
    return list(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=6.0)))


# -- order ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def in_order(recorded):
    return run(GraphSlam(), *recorded, *END)


def test_the_graph_is_a_function_of_the_ingest_sequence(recorded, in_order, tmp_path):
    accepted = []
    rng = np.random.default_rng(1)
    late = sorted(range(len(recorded)), key=lambda k: (recorded[k].stamp_ns + rng.uniform(0.0, 0.2 * S), k))
    messy = run(GraphSlam(sink=accepted.append), *(recorded[k] for k in late), recorded[5], *END)
    assert messy.counters["odometry", "late"] > 100
    again = run(GraphSlam(), *(from_record(to_record(m)) for m in accepted))
    assert g2o(again, tmp_path) == g2o(messy, tmp_path)
    assert len(accepted) == messy.processed == len(recorded) + 1 + len(END), "refused measurements are recorded, too"
    assert again.counters.as_dict() == messy.counters.as_dict(), "a replay refuses the same"
    assert g2o(in_order, tmp_path) != g2o(messy, tmp_path)


def test_saving_on_the_way_costs_no_measurement():
    seen_ahead = [
        m for k in range(40) for m in (odometry(k, (0.3 * k, 0, 0)), seen(k + 0.02, point()), Control("flush"))
    ]
    p = run(slam(), *seen_ahead, odometry(40, (12.0, 0, 0)), *END)
    assert p.landmarks["a"].sightings == 40
    assert p.counters.as_dict() == {}


def test_B2_late_sightings_go_where_they_belong():
    late = run(slam(), *straight(9), seen(3.7, point("a")), seen(8.2, point("b")), *END)
    in_time = slam()
    for m in straight(9):
        in_time.process(m)
        for t, name in ((3.7, "a"), (8.2, "b")):
            if m.stamp_ns == T0 + round(t * S):
                in_time.process(seen(t, point(name)))
    run(in_time, *END)
    assert late.counters.as_dict() == {}
    for name in "ab":
        there, here = (p.solver.estimate([p.landmarks[name].vertex])[0] for p in (late, in_time))
        assert there == pytest.approx(here, abs=1e-9)
        at = [table(p, LANDMARK_POSITION).measured.values for p in (late, in_time)]
    assert np.sort(at[0], axis=0) == pytest.approx(np.sort(at[1], axis=0), abs=1e-12)


def test_sightings_from_after_the_last_odometry_are_counted_at_the_end():
    p = run(slam(), *straight(1), seen(1.5, point("a"), point("b")))
    assert p.counters.as_dict() == {}
    run(p, *END)
    assert p.counters.as_dict() == {"/landmarks": {"after_odometry": 2}}


def test_sightings_that_wait_for_odometry_are_bounded():
    p = slam(ordering={"max_waiting": 3})
    run(p, odometry(0, (0, 0, 0)), odometry(100, (0.1, 0, 0)))
    run(p, *(seen(100 + k, point("a")) for k in range(1, 6)))
    assert p.counters["/landmarks", "overflow"] == 2
    p = slam(ordering={"max_waiting": 3, "window_s": 10.0})
    run(p, odometry(0, (0, 0, 0)), odometry(20, (0, 0, 0)), odometry(100, (0.1, 0, 0)))
    run(p, *(seen(50 + k, point("a")) for k in range(5)))  # released at once, and waiting for odometry at 100 s
    assert p.counters["/landmarks", "overflow"] == 2
    run(p, odometry(200, (0.2, 0, 0)))
    assert p.landmarks["a"].sightings == 3


# -- keyframes and motion -------------------------------------------------------------------------------------------


def test_keyframes_come_by_distance_by_angle_and_by_time_in_motion():
    distance = run(slam(), *straight(2, speed=1.0))
    assert [k.T_odom_base[0] for k in distance.keyframes] == pytest.approx([0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8])
    turning = run(slam(), *(odometry(k / 10, (0.0, 0.0, 0.1 * k)) for k in range(10)))
    assert [k.T_odom_base[2] for k in turning.keyframes] == pytest.approx([0, 0.3, 0.6, 0.9])
    for hz in (8, 10, 30):  # ten times 0.1 s is a second
        slow = run(slam(), *straight(3.1, speed=0.01, hz=hz))
        assert [k.stamp_ns for k in slow.keyframes] == [T0 + k * S for k in range(4)], hz


def test_keyframes_and_sightings_are_the_same_one_by_one_and_as_columns():
    p = run(slam(), *itertools.chain(*zip(straight(9), (seen(k / 10, point()) for k in range(91)), strict=True)))
    for track, pose in ((p.keyframes, "T_odom_base"), (p.sighting_poses, "T_keyframe_base")):
        assert len(list(track)) == len(track) == len(track.ids) > 25
        assert list(track) == [track[k] for k in range(len(track))]
        assert track[-1] == list(track)[-1]
        assert track.stamps_ns.tolist() == [instant.stamp_ns for instant in track]
        assert track.poses.tolist() == [list(getattr(instant, pose)) for instant in track]
        with pytest.raises(IndexError):
            track[len(track)]
    assert p.keyframes.ids.tolist() == [k.vertex for k in p.keyframes]
    assert p.sighting_poses.ids.tolist() == [s.keyframe for s in p.sighting_poses]
    assert {type(value) for value in (p.keyframes[0].vertex, p.keyframes[0].stamp_ns)} == {int}
    assert p.keyframes[-1].stamp_ns == T0 + 9 * S


def test_G20_a_standing_robot_makes_no_keyframes_and_gathers_no_noise():
    wiggle = [odometry(k / 10, (1e-6 * (k % 2), 0.0, 0.0)) for k in range(1, 6001)]
    p = run(slam(), odometry(0, (0, 0, 0)), *wiggle, seen(600.0, point()))
    assert len(p.keyframes) == 1
    assert p.graph.edge_count == 2
    assert covariance_of(p, LANDMARK_POSITION) == pytest.approx(np.reshape(POINT, (2, 2)), rel=1e-5)


@pytest.mark.parametrize(("jitter_m", "hz"), [(2e-5, 50), (2e-4, 10)])
def test_odometry_that_jitters_while_the_robot_stands_is_no_motion(jitter_m, hz):
    rng = np.random.default_rng(1)
    p = slam(keyframes={"min_distance_m": 0.5, "max_interval_s": 1.0})
    count = 100 * hz
    for k, (x, y, theta) in enumerate((jitter_m * rng.standard_normal((count, 3))).tolist()):
        p.process(odometry(k / hz, (x, y, theta)))
    assert len(p.keyframes) == 1
    for k in range(count, count + 10 * hz):
        p.process(odometry(k / hz, ((k - count) * 0.1 / hz, 0.0, 0.0)))
    assert len(p.keyframes) in (10, 11)  # 0.1 m/s for ten seconds, a second each
    sigma = math.sqrt(float(p.pose_covariance[0, 0]))
    fresh = run(slam(keyframes={"min_distance_m": 0.5, "max_interval_s": 1.0}), *straight(10, 0.1, hz))
    assert sigma < 1.5 * math.sqrt(float(fresh.pose_covariance[0, 0]))


def test_odometry_edges_are_the_relative_motion_and_not_the_absolute_pose():
    p = run(slam(), odometry(0, (5, 5, math.pi / 2)), odometry(1, (5, 6, math.pi / 2 + 0.2)), odometry(2, (5, 7, 1.0)))
    assert table(p, RELATIVE_POSE).measured.values[0] == pytest.approx([1, 0, 0.2])
    assert p.trajectory() == pytest.approx(np.array([k.T_odom_base for k in p.keyframes])), "map begins where odom does"
    assert p.T_map_odom == pytest.approx((0, 0, 0), abs=1e-12)


def test_a_keyframe_between_two_odometry_messages_cuts_the_motion_and_adds_none():
    p, rng = slam(keyframes={"shared_noise": 0.05, "min_distance_m": 0.21}), np.random.default_rng(1)
    for k in range(300):
        p.process(odometry(0.1 * k, se2.exp((0.08 * k, 0.0, 0.002 * k))))
        if rng.random() < 0.3:
            p.process(seen(0.1 * k + float(rng.integers(1, 100)) / 1e3, point(covariance=(1e-6, 0.0, 0.0, 1e-6))))
    seconds = (p.keyframes.stamps_ns - T0) / S
    assert 30 < np.count_nonzero(np.abs(seconds * 10 - np.rint(seconds * 10)) > 1e-3) < len(seconds) - 30
    expected = [se2.exp((0.8 * dt, 0.0, 0.02 * dt)) for dt in np.diff(seconds)]
    assert table(p, RELATIVE_POSE).measured.values == pytest.approx(np.array(expected), abs=1e-9)


def monte_carlo(steps, covariance_of_step, samples=20_000, seed=3):
    """Covariance at the end of noisy steps, in the tangent space there."""
    rng = np.random.default_rng(seed)
    end, noisy = se2.IDENTITY, tuple(np.zeros((3, samples)))
    for step, covariance in zip(steps, covariance_of_step, strict=True):
        end = se2.compose(end, step)
        noise = rng.multivariate_normal(np.zeros(3), covariance, samples)
        twist = np.array(se2.log(step))[:, None] + noise.T
        noisy = se2.compose(noisy, se2.exp(tuple(twist)))
    return np.cov(np.stack(se2.local(noisy, end)))


CURVE = [(0.1 * k, 0.004 * k * k, 0.05 * k) for k in range(4)]


@pytest.mark.parametrize("noise", ["density", "twist"])
def test_the_noise_of_a_step_is_what_random_steps_have(noise):
    twist = np.array([[2e-3, 1e-4, 0], [1e-4, 1e-3, 0], [0, 0, 4e-3]])
    p = slam(odometry={"noise": noise, "lateral_density": 0.01}, keyframes={"min_distance_m": 0.29})
    run(p, *(odometry(0.1 * k, pose, tuple(twist.ravel())) for k, pose in enumerate(CURVE)))
    assert len(p.keyframes) == 2
    of_step = np.diag([0.02**2, 0.01**2, 0.05**2]) * 0.1 if noise == "density" else twist * 0.1 * 0.25
    steps = [se2.between(a, b) for a, b in itertools.pairwise(CURVE)]
    expected, got = monte_carlo(steps, [of_step] * 3), covariance_of(p, RELATIVE_POSE)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (got / scale) == pytest.approx(expected / scale, abs=0.04)  # 20,000 samples: 1 % each, 4 sigma


def motion_noise(turned, way, seconds):
    """By the default parameters, about (x, y, heading) of a step; a sixteenth of the way's goes across."""
    along = 2e-3 * way + 1e-4 * seconds
    return np.diag([along, along / 16.0, 0.02 * turned + 2e-3 * way + 2e-4 * seconds])


def test_noise_by_motion_grows_with_all_that_was_turned_and_driven_not_with_where_it_led():
    there_and_back = [(0.1, 0.0, 0.2), (0.0, 0.0, 0.0), (0.1, 0.0, 0.2), (0.2, 0.1, 0.4), (0.3, 0.2, 0.4)]
    p = slam(odometry={"noise": "motion"}, keyframes={"min_distance_m": 0.36, "min_angle_rad": 3.0})
    run(p, odometry(0, (0, 0, 0)), *(odometry(0.1 * (k + 1), pose) for k, pose in enumerate(there_and_back)))
    assert len(p.keyframes) == 2
    steps = [se2.between(a, b) for a, b in itertools.pairwise([(0.0, 0.0, 0.0), *there_and_back])]
    noise = [motion_noise(abs(step[2]), math.hypot(*step[:2]), 0.1) for step in steps]
    expected, got = monte_carlo(steps, noise), covariance_of(p, RELATIVE_POSE)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (got / scale) == pytest.approx(expected / scale, abs=0.04)  # 20,000 samples: 1 % each, 4 sigma


@pytest.mark.parametrize(
    "odometry, is_same",
    [
        ({"noise": "twist"}, {"noise": "motion"}),
        ({"noise": "twist", "rotation_density": 0.1}, {"noise": "density", "rotation_density": 0.1}),
    ],
)
def test_a_twist_covariance_that_a_message_lacks_is_that_of_motion_unless_a_density_is_set(odometry, is_same):
    with_twist, other = slam(odometry=odometry), slam(odometry=is_same)
    for p in (with_twist, other):
        run(p, *straight(1))
    assert covariance_of(with_twist, RELATIVE_POSE) == pytest.approx(covariance_of(other, RELATIVE_POSE), rel=1e-12)


def test_density_is_used_where_it_is_asked_for_whatever_the_messages_say():
    plain, told = slam(), slam()
    run(plain, *straight(1))
    run(told, *(replace(m, twist_covariance=tuple(np.eye(3).ravel())) for m in straight(1)))
    assert covariance_of(plain, RELATIVE_POSE) == pytest.approx(covariance_of(told, RELATIVE_POSE))


# -- sightings ------------------------------------------------------------------------------------------------------


def between_keyframes(*sightings):
    """Odometry at 0, 1 and 2 s; a sighting at 1.4 s, with keyframes at 0 and 2 s only."""
    p = slam(keyframes={"min_distance_m": 0.9, "min_angle_rad": 3.0, "max_interval_s": 100.0})
    at_1, at_2 = (0.6, 0.1, 0.5), (1.2, 0.5, 0.8)
    run(p, odometry(0, (0, 0, 0)), odometry(1, at_1), seen(1.4, *sightings), odometry(2, at_2))
    return p, at_1, se2.interpolate(at_1, at_2, 0.4)


def carried_noise(at_1, at_see):
    """Of the motion from the keyframe to the sighting, by random steps."""
    density = np.diag([0.02**2, 0.005**2, 0.05**2])
    return [at_1, se2.between(at_1, at_see)], [density * 1.0, density * 0.4]


def test_a_point_is_carried_to_the_last_keyframe_by_the_odometry_since():
    p, at_1, at_see = between_keyframes(point())
    assert len(p.keyframes) == 2
    edges = table(p, LANDMARK_POSITION)
    assert edges.vertices.values[0].tolist() == [p.keyframes[0].vertex, p.landmarks["a"].vertex]
    assert edges.measured.values[0] == pytest.approx(se2.act(at_see, (2.0, 1.0)))
    rng = np.random.default_rng(5)
    steps, noise = carried_noise(at_1, at_see)
    n = 40_000
    moved = tuple(np.zeros((3, n)))
    for step, covariance in zip(steps, noise, strict=True):
        twist = np.array(se2.log(step))[:, None] + rng.multivariate_normal(np.zeros(3), covariance, n).T
        moved = se2.compose(moved, se2.exp(tuple(twist)))
    local = np.array([2.0, 1.0])[:, None] + rng.multivariate_normal([0, 0], np.reshape(POINT, (2, 2)), n).T
    expected = np.cov(np.stack(se2.act(moved, tuple(local))))
    assert covariance_of(p, LANDMARK_POSITION) == pytest.approx(expected, abs=0.03 * np.trace(expected))


def test_a_tag_is_carried_to_the_last_keyframe_by_the_odometry_since():
    p, at_1, at_see = between_keyframes(tag())
    edges = table(p, RELATIVE_POSE)
    row = int(np.flatnonzero(edges.vertices.values[:, 1] == p.landmarks["a"].vertex)[0])
    assert edges.measured.values[row] == pytest.approx(se2.compose(at_see, (2.0, 1.0, 0.5)))
    steps, noise = carried_noise(at_1, at_see)
    expected = monte_carlo([*steps, (2.0, 1.0, 0.5)], [*noise, np.zeros((3, 3))], 40_000)
    expected += np.reshape(POSE, (3, 3))
    assert covariance_of(p, RELATIVE_POSE, row) == pytest.approx(expected, abs=0.03 * np.trace(expected))


def test_a_sighting_splits_no_odometry_edge_and_makes_no_pose():
    quiet, looking = slam(), slam()
    run(quiet, *straight(3))
    run(looking, *(m for o in straight(3) for m in (o, seen((o.stamp_ns - T0) / S + 0.04, point()))))
    assert [k.stamp_ns for k in quiet.keyframes] == [k.stamp_ns for k in looking.keyframes]
    one, other = table(quiet, RELATIVE_POSE), table(looking, RELATIVE_POSE)
    assert one.measured.values.tobytes() == other.measured.values.tobytes()
    assert one.sqrt_information.values.tobytes() == other.sqrt_information.values.tobytes()
    assert looking.graph.vertex_count == len(looking.keyframes) + 1
    assert looking.landmarks["a"].sightings == 30


def test_a_sighting_at_a_keyframes_stamp_belongs_to_that_keyframe():
    p = run(slam(), odometry(0, (0, 0, 0)), odometry(1, (1, 0, 0)), seen(1, point()))
    assert table(p, LANDMARK_POSITION).vertices.values[0, 0] == p.keyframes[1].vertex
    assert covariance_of(p, LANDMARK_POSITION) == pytest.approx(np.reshape(POINT, (2, 2)), rel=1e-4)


def test_configured_noise_is_added_to_every_sighting():
    p = slam(landmarks={"added_sigma_m": 0.3})
    run(p, odometry(0, (0, 0, 0)), seen(0, point("a"), tag("b")))
    assert covariance_of(p, LANDMARK_POSITION) == pytest.approx(np.reshape(POINT, (2, 2)) + 0.09 * np.eye(2))
    assert covariance_of(p, RELATIVE_POSE) == pytest.approx(np.reshape(POSE, (3, 3)) + 0.09 * np.diag([1, 1, 0]))


def test_where_the_robot_was_at_each_sighting_is_kept():
    p, _, at_see = between_keyframes(point(), point("b"))
    assert p.sighting_odometry() == pytest.approx(np.array([at_see]))
    assert p.sighting_trajectory() == pytest.approx(np.array([at_see]))


def test_a_landmark_seen_as_a_pose_first_takes_points_later():
    p = run(slam(), odometry(0, (0, 0, 0)), seen(0, tag()), odometry(1, (1, 0, 0)), seen(1, point(at=(1.0, 1.0))), *END)
    assert p.graph.kind_of(p.landmarks["a"].vertex) is SE2
    assert len(table(p, TAG_POSITION)) == 1
    assert LANDMARK_POSITION not in p.graph.tables
    assert p.solver.estimate([p.landmarks["a"].vertex])[0] == pytest.approx([2.0, 1.0, 0.5], abs=1e-6)
    assert p.counters.as_dict() == {}


def test_a_landmark_seen_as_a_point_first_takes_the_positions_of_poses_later():
    p = run(slam(), odometry(0, (0, 0, 0)), seen(0, point()), odometry(1, (1, 0, 0)), seen(1, tag(at=(1.0, 1.0, 0.5))))
    edges = table(p, LANDMARK_POSITION)
    assert len(edges) == 2
    assert edges.measured.values[1] == pytest.approx([1.0, 1.0])
    c, s = math.cos(0.5), math.sin(0.5)
    turn = np.array([[c, -s], [s, c]])
    assert covariance_of(p, LANDMARK_POSITION) == pytest.approx(
        turn @ np.reshape(POSE, (3, 3))[:2, :2] @ turn.T, rel=1e-4
    )
    run(p, *END)
    assert p.solver.estimate([p.landmarks["a"].vertex])[0] == pytest.approx([2.0, 1.0], abs=1e-6)


# -- solving --------------------------------------------------------------------------------------------------------


def solves(p, items):
    """Stamps in seconds at which a solve happened."""
    return [(m.stamp_ns - T0) / S for m in items if p.process(m).solved]


@pytest.mark.parametrize("every", [1, 4])
def test_a_solve_comes_every_so_many_keyframes(every):
    p = slam(solve={"every_keyframes": every}, keyframes={"min_distance_m": 0.95})
    assert solves(p, straight(13)) == pytest.approx(range(every, 14, every))
    assert p.solves == 13 // every
    assert p.report is None  # none of everything was asked for


def test_by_default_every_keyframe_is_solved_for():
    p = slam()
    updates = [p.process(m) for m in straight(5)]
    assert [u.solved for u in updates] == [bool(u.keyframes) and u.keyframes != (0,) for u in updates]


def test_a_return_is_in_the_estimate_at_the_next_keyframe():
    p = loop(slam())
    before = p.trajectory()
    newest = p.keyframes[-1]
    p.process(Odometry(newest.stamp_ns + S, se2.compose(newest.T_odom_base, (0.5, 0.0, 0.0)), None))
    assert np.abs(p.trajectory()[-2] - before[-1]).max() > 0.01
    online = p.trajectory()
    run(p, *END)
    # linearised anew beyond 0.05: second order in that
    assert p.trajectory() == pytest.approx(online, abs=5e-3)


def test_looking_at_covariances_changes_nothing_that_comes_later(recorded, tmp_path):
    blind, looking = GraphSlam(), GraphSlam()
    for k, m in enumerate(recorded[:2500]):
        assert blind.process(m) == looking.process(m)
        if k % 7 == 0:
            assert len(looking.landmark_covariances()) == len(looking.landmarks)
    assert g2o(blind, tmp_path) == g2o(looking, tmp_path)
    assert blind.counters.as_dict() == looking.counters.as_dict() == {}


def test_the_covariance_of_a_landmark_is_unknown_until_it_is_solved_for():
    p = run(slam(), odometry(0, (0, 0, 0)), odometry(1, (1, 0, 0)), seen(1, point(), tag("b")))
    assert [c.shape for c in p.landmark_covariances()] == [(2, 2), (3, 3)]
    assert np.isnan(np.concatenate([c.ravel() for c in p.landmark_covariances()])).all()
    p.process(odometry(2, (2, 0, 0)))
    assert all((np.linalg.eigvalsh(c) > 0.0).all() for c in p.landmark_covariances())


def loop(p):
    """A square drive with a drift, whose first landmark returns at its end."""
    x, heading, t = (0.0, 0.0), 0.0, 0
    run(p, odometry(0, (0, 0, 0)), seen(0, point("home", (2.0, 0.0))))
    for _ in range(4):
        for _ in range(5):
            t += 1
            x = (x[0] + math.cos(heading), x[1] + math.sin(heading))
            run(p, odometry(t, (*x, heading)), seen(t, point(f"at {t}", (1.0, 1.0))))
        heading += math.pi / 2 + 0.02
    t += 1
    return run(p, odometry(t, (*x, heading)), seen(t, point("home", (2.0, 0.0))))


def test_after_a_solve_the_pose_covariance_is_the_marginal_and_then_grows_with_the_odometry():
    p = loop(slam())
    run(p, *END)
    h = p.solver.information_matrix()
    newest = p.keyframes[-1].vertex
    dofs = [p.graph.kind_of(v).dof for v in range(p.graph.vertex_count)]
    first = sum(dofs[:newest])
    dense = np.linalg.inv(h)[first : first + 3, first : first + 3]
    assert p.pose_covariance == pytest.approx(dense, rel=1e-8, abs=1e-10 * np.trace(dense))
    step = (0.5, 0.0, 0.3)
    at = p.keyframes[-1]
    p.process(Odometry(at.stamp_ns + S, se2.compose(at.T_odom_base, step), None))
    ad = se2.adjoint(se2.inverse(step))
    grown = ad @ dense @ ad.T + covariance_of(p, RELATIVE_POSE)
    assert p.pose_covariance == pytest.approx(grown, rel=1e-6, abs=1e-7)


def test_the_first_pose_is_as_uncertain_as_its_anchor():
    p = run(slam(anchor={"sigma_m": 0.1, "sigma_rad": 0.2}), odometry(0, (1, 2, 3)))
    assert p.pose_covariance == pytest.approx(np.diag([0.01, 0.01, 0.04]))
    run(p, *END)
    assert p.pose_covariance == pytest.approx(np.diag([0.01, 0.01, 0.04]))


def test_a_closed_loop_moves_the_map_under_the_odometry_and_halves_its_error():
    p = loop(slam())
    drift = np.hypot(*p.keyframes[-1].T_odom_base[:2])
    run(p, *END)
    newest = se2.compose(p.T_map_odom, p.keyframes[-1].T_odom_base)
    assert se2.local(newest, tuple(p.trajectory()[-1])) == pytest.approx((0, 0, 0), abs=1e-9)
    assert np.hypot(*newest[:2]) < 0.5 * drift


def test_with_identities_a_sighting_without_one_is_counted_and_the_others_of_its_message_are_used():
    p = slam(landmarks={"association": "id"})
    run(p, *straight(1), seen(0.5, point(""), point("a"), tag("")), seen(0.7, point("")), *END)
    assert p.counters.as_dict() == {"/landmarks": {"no_id": 3}}
    assert list(p.landmarks) == ["a"]


class Failing:
    """A solver's update that fails while it is told to."""

    def __init__(self, pipeline, monkeypatch):
        self.works, update = False, pipeline.solver.update
        monkeypatch.setattr(pipeline.solver, "update", lambda *a: update(*a) if self.works else self.fail())

    def fail(self):
        raise SingularError("the edges do not determine vertex 7")


def test_G7_a_solve_that_fails_is_counted_and_the_last_estimate_stays(monkeypatch):
    p = slam(solve={"every_keyframes": 2})
    failing = Failing(p, monkeypatch)
    items = [m for o in straight(2) for m in (o, seen((o.stamp_ns - T0) / S, point(at=(3.0 - o.T_odom_base[0], 0.1))))]
    updates = [p.process(m) for m in items]
    assert not any(u.solved for u in updates)
    assert p.counters["solver", "SingularError"] == 3
    assert all(np.isnan(c).all() for c in p.landmark_covariances())
    assert p.counters["solver", "SingularError"] == 3  # nothing was tried again
    assert p.trajectory() == pytest.approx(np.array([k.T_odom_base for k in p.keyframes]), abs=1e-12)
    assert np.isfinite(p.pose_covariance).all()
    told = summarize(p)
    assert told["solves"] == 0
    assert any("the last solve failed" in one and p.failing in one for one in shortcomings(told))
    failing.works = True
    assert p.process(Control("optimize")).report.converged
    assert not any("the last solve failed" in one for one in shortcomings(summarize(p)))
    assert all(np.isfinite(c).all() for c in p.landmark_covariances())
    assert p.counters["solver", "SingularError"] == 3


@pytest.mark.parametrize("far", [1e8, 1e9])
def test_numbers_at_the_borders_limits_leave_no_vertex_without_its_edge(far):
    p = slam(landmarks={"loss": "none"})
    huge, tiny = tuple(np.diag([1e6, 1e6, 1e3]).ravel()), tuple(1e-30 * np.eye(3).ravel())
    run(p, odometry(0, (0, 0, 0), huge), seen(0, tag(at=(far, -far, 1.0)), point("b", (far, far), (1e6, 0, 0, 1e6))))
    run(p, odometry(1e9, (far, far, 2.0), huge), seen(1e9, tag(), tag("c", covariance=tiny)))
    run(p, odometry(1e9 + 1, (0, 0, 0)), *END)
    inside = set(np.concatenate([t.vertices.values.ravel() for t in p.graph.tables.values()]).tolist())
    assert inside == set(range(p.graph.vertex_count))
    assert np.isfinite(p.trajectory()).all()


def test_nothing_comes_of_nothing():
    p = run(slam(), *END)
    assert p.trajectory().shape == p.sighting_trajectory().shape == (0, 3)
    assert p.T_map_odom == (0.0, 0.0, 0.0)
    assert p.newest_odometry_ns is None
    assert summarize(p)["stop"] == "nothing_to_do"


def test_an_update_says_what_it_changed():
    p = slam(solve={"every_keyframes": 2})
    assert p.process(odometry(0, (0, 0, 0))).keyframes == (0,)
    assert not p.process(odometry(0.1, (0.01, 0, 0)))
    assert p.process(odometry(1, (1, 0, 0))).keyframes == (1,)
    last = p.process(odometry(2, (2, 0, 0)))
    assert (last.keyframes, last.solved, last.report) == ((2,), True, None)
    everything = p.process(Control("optimize"))
    assert (everything.keyframes, everything.solved) == ((), True)
    assert everything.report is p.report
    assert everything.report.converged
    assert p.solves == 2


@pytest.mark.parametrize(
    "make",
    [lambda k: Sighting("a", k, (1.0, 0.0), (1.0, 0, 0, 1.0)), lambda k: Fix(1, "gps", k, (0.0, 0.0), np.eye(2))],
)
def test_a_kind_that_is_none_is_refused_where_it_is_written(make):
    with pytest.raises(FormatError, match=r"'bering' is not one of .*, "):
        make("bering")
    assert make("position").kind == "position"


def test_P21_of_several_faults_at_once_the_first_is_raised_and_all_count(monkeypatch):
    p = slam(ordering={"window_s": 5.0})
    add, faults = p._landmarks.map.add, {"a": ZeroDivisionError, "c": KeyError, "d": KeyError}
    for k in range(3):
        p.process(odometry(k, (k, 0, 0)))
    p.process(seen(1.5, point("a"), point("b"), point("c")))
    p.process(seen(1.75, point("d"), point("e")))
    p.process(seen(3, point("f")))

    def faulty(topic, name, *others):
        if name in faults:
            raise faults[name]
        add(topic, name, *others)

    monkeypatch.setattr(p._landmarks.map, "add", faulty)
    with pytest.raises(ZeroDivisionError):
        p.process(Control("end"))
    assert p.counters["node", "KeyError"] == 2
    assert set(p.landmarks) == {"b", "e"}  # of the same messages
    assert p.counters["/landmarks", "after_odometry"] == 1
    assert not p.process(Control("end"))  # a fault is raised once
