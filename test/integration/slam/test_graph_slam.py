"""The pipeline: measurements in, a graph and an estimate out; each rule against a computation of its own."""

import itertools
import math

import numpy as np
import pytest

from graph_slam_ros.errors import SingularError
from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE, SE2, TAG_POSITION
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import from_record, to_record
from graph_slam_ros.runs.outcome import shortcomings
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
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


# -- keyframes and motion -------------------------------------------------------------------------------------------


def test_keyframes_come_by_distance_by_angle_and_by_time_in_motion():
    distance = run(slam(), *straight(2, speed=1.0))
    assert [k.T_odom_base[0] for k in distance.keyframes] == pytest.approx([0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8])
    turning = run(slam(), *(odometry(k / 10, (0.0, 0.0, 0.1 * k)) for k in range(10)))
    assert [k.T_odom_base[2] for k in turning.keyframes] == pytest.approx([0, 0.3, 0.6, 0.9])
    for hz in (8, 10, 30):  # ten times 0.1 s is a second
        slow = run(slam(), *straight(3.1, speed=0.01, hz=hz))
        assert [k.stamp_ns for k in slow.keyframes] == [T0 + k * S for k in range(4)], hz


def test_G20_a_standing_robot_makes_no_keyframes_and_gathers_no_noise():
    wiggle = [odometry(k / 10, (1e-6 * (k % 2), 0.0, 0.0)) for k in range(1, 1001)]
    p = run(slam(), odometry(0, (0, 0, 0)), *wiggle, seen(100.0, point()))
    assert len(p.keyframes) == 1
    assert p.graph.edge_count == 2
    assert covariance_of(p, LANDMARK_POSITION) == pytest.approx(np.reshape(POINT, (2, 2)), rel=1e-5)


def test_odometry_edges_are_the_relative_motion_and_not_the_absolute_pose():
    p = run(slam(), odometry(0, (5, 5, math.pi / 2)), odometry(1, (5, 6, math.pi / 2 + 0.2)), odometry(2, (5, 7, 1.0)))
    assert table(p, RELATIVE_POSE).measured.values[0] == pytest.approx([1, 0, 0.2])
    assert p.trajectory() == pytest.approx(np.array([k.T_odom_base for k in p.keyframes])), "map begins where odom does"
    assert p.T_map_odom == pytest.approx((0, 0, 0), abs=1e-12)


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


def test_numbers_at_the_borders_limits_leave_no_vertex_without_its_edge():
    p, far = slam(landmarks={"loss": "none"}), 1e9
    huge, tiny = tuple(np.diag([1e6, 1e6, 1e3]).ravel()), tuple(1e-30 * np.eye(3).ravel())
    run(p, odometry(0, (0, 0, 0), huge), seen(0, tag(at=(far, -far, 1.0)), point("b", (far, far), (1e6, 0, 0, 1e6))))
    run(p, odometry(1e9, (far, far, 2.0), huge), seen(1e9, tag(), tag("c", covariance=tiny)))
    run(p, odometry(1e9 + 1, (0, 0, 0)), *END)
    inside = set(np.concatenate([t.vertices.values.ravel() for t in p.graph.tables.values()]).tolist())
    assert inside == set(range(p.graph.vertex_count))
    assert np.isfinite(p.trajectory()).all()


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
