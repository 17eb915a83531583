"""The pipeline: measurements in, a graph and an estimate out; each rule against a computation of its own."""

import itertools
import math

import numpy as np
import pytest

from graph_slam_ros.formats.g2o_writer import write_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE
from graph_slam_ros.lie import se2
from graph_slam_ros.measurements.types import from_record, to_record
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


def table(view, edge_type):
    return view.graph.tables[edge_type]


def covariance_of(view, edge_type, row=-1):
    root = table(view, edge_type).sqrt_information.values[row]
    return np.linalg.inv(root.T @ root)


def g2o(view, tmp_path):
    file = tmp_path / "graph.g2o"
    write_g2o(file, G2oFile(view.graph, list(range(view.graph.vertex_count))), view.solver.estimate)
    return file.read_bytes()


def straight(seconds, speed=1.0, hz=10):
    return [odometry(k / hz, (speed * k / hz, 0.0, 0.0)) for k in range(int(seconds * hz) + 1)]


END = (Control("end"), Control("optimize"))


@pytest.fixture(scope="module")
def recorded():
    return list(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=6.0)))


def test_the_graph_is_a_function_of_the_ingest_sequence(recorded, tmp_path):
    accepted = []
    rng = np.random.default_rng(1)
    late = sorted(range(len(recorded)), key=lambda k: (recorded[k].stamp_ns + rng.uniform(0.0, 0.2 * S), k))
    messy = run(GraphSlam(sink=accepted.append), *(recorded[k] for k in late), recorded[5], *END)
    assert messy.counters["odometry", "late"] > 100
    again = run(GraphSlam(), *(from_record(to_record(m)) for m in accepted))
    assert g2o(again.view, tmp_path) == g2o(messy.view, tmp_path)
    assert len(accepted) == messy.processed == len(recorded) + 1 + len(END), "refused measurements are recorded, too"
    assert again.counters.as_dict() == messy.counters.as_dict(), "a replay refuses the same"
    assert g2o(run(GraphSlam(), *recorded, *END).view, tmp_path) != g2o(messy.view, tmp_path)


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
        there, here = (p.view.solver.estimate([p.view.landmarks[name].vertex])[0] for p in (late, in_time))
        assert there == pytest.approx(here, abs=1e-9)
        at = [table(p.view, LANDMARK_POSITION).measured.values for p in (late, in_time)]
    assert np.sort(at[0], axis=0) == pytest.approx(np.sort(at[1], axis=0), abs=1e-12)


def test_keyframes_come_by_distance_by_angle_and_by_time_in_motion():
    distance = run(slam(), *straight(2, speed=1.0))
    assert [k.T_odom_base[0] for k in distance.view.keyframes] == pytest.approx([0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8])
    turning = run(slam(), *(odometry(k / 10, (0.0, 0.0, 0.1 * k)) for k in range(10)))
    assert [k.T_odom_base[2] for k in turning.view.keyframes] == pytest.approx([0, 0.3, 0.6, 0.9])
    for hz in (8, 10, 30):  # ten times 0.1 s is a second
        slow = run(slam(), *straight(3.1, speed=0.01, hz=hz))
        assert [k.stamp_ns for k in slow.view.keyframes] == [T0 + k * S for k in range(4)], hz


def test_G20_a_standing_robot_makes_no_keyframes_and_gathers_no_noise():
    wiggle = [odometry(k / 10, (1e-6 * (k % 2), 0.0, 0.0)) for k in range(1, 1001)]
    p = run(slam(), odometry(0, (0, 0, 0)), *wiggle, seen(100.0, point()))
    assert len(p.view.keyframes) == 1
    assert p.view.graph.edge_count == 2
    assert covariance_of(p.view, LANDMARK_POSITION) == pytest.approx(np.reshape(POINT, (2, 2)), rel=1e-5)


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


def motion_noise(turned, way, seconds):
    """By the default parameters, about (x, y, heading) of a step; a sixteenth of the way's goes across."""
    along = 2e-3 * way + 1e-4 * seconds
    return np.diag([along, along / 16.0, 0.02 * turned + 2e-3 * way + 2e-4 * seconds])


def test_noise_by_motion_grows_with_all_that_was_turned_and_driven_not_with_where_it_led():
    there_and_back = [(0.1, 0.0, 0.2), (0.0, 0.0, 0.0), (0.1, 0.0, 0.2), (0.2, 0.1, 0.4), (0.3, 0.2, 0.4)]
    p = slam(odometry={"noise": "motion"}, keyframes={"min_distance_m": 0.36, "min_angle_rad": 3.0})
    run(p, odometry(0, (0, 0, 0)), *(odometry(0.1 * (k + 1), pose) for k, pose in enumerate(there_and_back)))
    assert len(p.view.keyframes) == 2
    steps = [se2.between(a, b) for a, b in itertools.pairwise([(0.0, 0.0, 0.0), *there_and_back])]
    noise = [motion_noise(abs(step[2]), math.hypot(*step[:2]), 0.1) for step in steps]
    expected, got = monte_carlo(steps, noise), covariance_of(p.view, RELATIVE_POSE)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (got / scale) == pytest.approx(expected / scale, abs=0.04)  # 20,000 samples: 1 % each, 4 sigma


def test_a_landmark_seen_as_a_point_first_takes_the_positions_of_poses_later():
    p = run(slam(), odometry(0, (0, 0, 0)), seen(0, point()), odometry(1, (1, 0, 0)), seen(1, tag(at=(1.0, 1.0, 0.5))))
    edges = table(p.view, LANDMARK_POSITION)
    assert len(edges) == 2
    assert edges.measured.values[1] == pytest.approx([1.0, 1.0])
    c, s = math.cos(0.5), math.sin(0.5)
    turn = np.array([[c, -s], [s, c]])
    assert covariance_of(p.view, LANDMARK_POSITION) == pytest.approx(
        turn @ np.reshape(POSE, (3, 3))[:2, :2] @ turn.T, rel=1e-4
    )
    run(p, *END)
    assert p.view.solver.estimate([p.view.landmarks["a"].vertex])[0] == pytest.approx([2.0, 1.0], abs=1e-6)


def test_with_identities_a_sighting_without_one_is_counted_and_the_others_of_its_message_are_used():
    p = slam(landmarks={"association": "id"})
    run(p, *straight(1), seen(0.5, point(""), point("a"), tag("")), seen(0.7, point("")), *END)
    assert p.counters.as_dict() == {"/landmarks": {"no_id": 3}}
    assert list(p.view.landmarks) == ["a"]


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
    assert set(p.view.landmarks) == {"b", "e"}  # of the same messages
    assert p.counters["/landmarks", "after_odometry"] == 1
    assert not p.process(Control("end"))  # a fault is raised once
