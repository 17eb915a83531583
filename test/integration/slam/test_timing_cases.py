"""When messages may come and how they may be dated, case by case: what is used, what is refused, what counts."""

import math

import numpy as np
import pytest
from messages import (
    STAMP_NS,
    border,
    closing,
    cloud,
    compass,
    counted,
    detection,
    detections,
    gnss,
    heard,
    imu,
    odometry,
    quaternion,
    receiver,
    scanner,
)
from reliability import tell, times

from graph_slam_ros.graph import RELATIVE_POSE
from graph_slam_ros.runs.recorder import RunRecorder
from graph_slam_ros.runs.tables import summarize
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.slam.frontend.ingest_gate import TimeJumpDetector
from graph_slam_ros.tools.simulation import measurements, simulate

S = 1_000_000_000
T0 = 1_700_000_000 * S
END = Control("end"), Control("optimize")


def at(t_s, x=0.0, theta=0.0):
    return Odometry(T0 + round(t_s * S), (x, 0.0, theta))


def seen(t_s, where=(2.0, 1.0), name="a"):
    sighting = Sighting(name, "position", where, (0.01, 0.0, 0.0, 0.01))
    return Sightings(T0 + round(t_s * S), "/landmarks", (sighting,))


def slam(**values):
    """Without a window of stamps, unless told otherwise."""
    base = {"ordering.window_s": 0.0, "odometry.noise": "density"}
    return GraphSlam(Config.from_mapping(base | {name.replace("__", "."): value for name, value in values.items()}))


def run(pipeline, *several):
    for m in several:
        pipeline.process(m)
    return pipeline


def straight(start_s, seconds, speed=1.0, hz=10):
    return [at(start_s + k / hz, speed * (start_s + k / hz)) for k in range(round(seconds * hz) + 1)]


def sigma_of_edges(view):
    """Standard deviations of odometry's edges, (n, 3)."""
    roots = view.graph.tables[RELATIVE_POSE].sqrt_information.values
    return np.array([np.sqrt(np.diag(np.linalg.inv(root.T @ root))) for root in roots])


def saved(pipeline, folder):
    """The files of a run, but for what was counted."""
    recorder = RunRecorder(folder, pipeline.view.config, force=True)
    recorder.save(pipeline, summarize(pipeline))
    recorder.close()
    names = "graph.g2o", "path.tum", "sightings.tum", "landmarks.csv", "ledger.csv", "ledger_changes.csv"
    return {name: (folder / name).read_bytes() for name in names}


def test_B1_whatever_the_order_within_the_window_and_what_comes_twice_the_saved_run_has_the_same_bytes(tmp_path):
    recorded = list(measurements(simulate("warehouse", 5, aisles=2, laps=1, aisle_m=4.0)))[:500]
    config = Config.from_mapping({"ordering": {"max_waiting": 1_000_000}})
    in_order = run(GraphSlam(config), *recorded, *END)
    expected = saved(in_order, tmp_path / "in_order")
    assert in_order.counters.as_dict() == {}
    tries = times(1, 2000)
    for seed in range(tries):
        rng = np.random.default_rng(seed)
        # the first odometry decides where the map begins: nothing of it may be overtaken by 50 ms of stamp time
        arrivals = [(m.stamp_ns + rng.uniform(0.0, 0.0499 * S), m) for m in recorded]
        again = [(t + rng.uniform(0.0, S), m) for t, m in arrivals[1:] if rng.random() < 0.1]
        order = sorted(range(len(arrivals) + len(again)), key=lambda k: (arrivals + again)[k][0])
        assert order != sorted(order)
        shuffled = run(GraphSlam(config), *((arrivals + again)[k][1] for k in order), *END)
        told = shuffled.counters.as_dict()
        is_seen_again = any(isinstance(m, Sightings) for _, m in again)
        assert set(told.get("/landmarks", ())) == ({"duplicate"} if is_seen_again else set())
        assert set(told["odometry"]) <= {"duplicate", "late"}
        assert saved(shuffled, tmp_path / "shuffled") == expected
    tell("permutations", tried=tries, failed=0)


INPUTS = {
    "odom": (border, lambda ns: odometry(stamp_ns=ns)),
    "detections": (border, lambda ns: detections(detection(), stamp_ns=ns)),
    "gps": (receiver, lambda ns: gnss(stamp_ns=ns)),
    "loops": (lambda: closing(2), lambda ns: detections(detection(name="7", covariance=np.eye(6)), stamp_ns=ns)),
}


def test_B20_the_clock_of_a_sensor_is_put_right_by_an_offset_that_is_told():
    offset_ns = 250_000_000
    b = border(detections={"offset_s": 0.25}, odom={"offset_s": -0.25})
    assert heard(b, "detections", detections(detection(), stamp_ns=STAMP_NS - offset_ns)).stamp_ns == STAMP_NS
    assert heard(b, "odom", odometry(stamp_ns=STAMP_NS + offset_ns)).stamp_ns == STAMP_NS
    assert heard(b, "odom", odometry(stamp_ns=offset_ns)) is None
    assert counted(b) == {"odom": {"bad_stamp": 1}}
    for made, name, cdr in (
        (lambda **s: compass(3, **s), "imu", imu(quaternion(), np.eye(3))),
        (receiver, "gps", gnss()),
        (lambda **s: scanner(sigma_m=0.1, **s), "scan", cloud([("x", "f4"), ("y", "f4")], (1.0, 2.0))),
    ):
        assert heard(made(offset_s=0.25), name, cdr).stamp_ns == STAMP_NS + offset_ns


def test_B7_after_a_jump_of_time_what_is_older_than_the_map_is_used_and_begins_a_segment():
    before, after = straight(100, 3), [at(40 + 0.1 * k, 103 + 0.1 * k) for k in range(31)]
    p = run(slam(), *before, seen(102, (2.0, 1.0)), Control("time_jump"), *after, seen(41, (0.0, 1.0)), *END)
    assert p.counters.as_dict() == {}
    assert len(p.view.segments) == 2
    assert p.view.trajectory()[-1] == pytest.approx([106.0, 0.0, 0.0], abs=0.3)
    assert p.view.landmarks["a"].sightings == 2


def begins_anew(*stamps_s, source="odom"):
    """Whether stamps of odometry begin anew, message by message."""
    jump = TimeJumpDetector(0.2)
    told = (s if isinstance(s, tuple) else (s, source) for s in stamps_s)
    return [bool(jump.jump([Odometry(T0 + round(s * S), (0.0, 0.0, 0.0), None, name)])) for s, name in told]


def test_B7_stamps_of_odometry_that_go_back_for_a_second_and_stay_there_begin_anew():
    before, after = [0.1 * k for k in range(100)], [-60.0 + 0.1 * k for k in range(11)]
    told = begins_anew(*before, *after)
    assert told.index(True) == len(told) - 1
    assert not any(begins_anew(*before, *after[:10]))
    assert begins_anew(*before, -60.0, -59.0, -58.0)[-1], "of odometry once a second, the third"


def test_B10_what_was_held_up_or_comes_again_or_of_one_source_of_two_begins_nothing_anew():
    before, late = [0.1 * k for k in range(100)], [5.05 + 0.1 * k for k in range(30)]
    assert not any(begins_anew(*before, *late[:9], 10.0, *late[9:18], 10.1)), "bursts of less than a second"
    assert not any(begins_anew(*before, *(s for k in range(30) for s in (late[k], 10.0 + 0.1 * k)))), "told twice"
    assert not any(begins_anew(*before, *before[60:90])), "told again while nothing new comes"
    assert any(begins_anew(*(0.1 * (k % 300) for k in range(600)))), "but what was told long ago is played again"
    assert not any(begins_anew(*before, *[5.05] * 100)), "it stands"
    assert not any(begins_anew(*(9.9 - 0.15 * (k % 2) + 0.01 * k for k in range(100)))), "less than 0.2 s"
    two = [(s, name) for k in range(100) for s, name in ((0.1 * k, "wheels"), (0.1 * k - 60.0 * (k > 50), "camera"))]
    assert not any(begins_anew(*two)), "the wheels go on"


def test_B19_where_nothing_is_seen_odometry_goes_on_and_the_covariance_grows():
    drive = straight(0, 60)
    p = slam()
    grown = []
    for k, m in enumerate(drive):
        p.process(m)
        if k < 100 and k % 10 == 0:
            p.process(seen(0.1 * k, (2.0 - 0.1 * k, 1.0)))
        if k % 100 == 99:
            grown.append(float(np.trace(p.view.pose_covariance[:2, :2])))
    assert p.counters.as_dict() == {}
    assert len(grown) == 6
    assert np.all(np.diff(grown) > 0.0)
    assert grown[-1] > 10.0 * grown[0]


@pytest.mark.parametrize("hz", [1, 100])
def test_B21_however_often_odometry_comes_keyframes_come_by_the_way_and_not_by_messages(hz):
    p = run(slam(keyframes__min_distance_m=0.99, keyframes__max_interval_s=100.0), *straight(0, 20, hz=hz))
    assert len(p.view.keyframes) == 21
    assert p.view.solves == 20
    assert sigma_of_edges(p.view)[:, 0] == pytest.approx([0.02] * 20, rel=0.01), "of a second each"


def test_B4_a_zero_stamp_is_refused_on_every_topic():
    for name, (made, cdr) in INPUTS.items():
        b = made()
        assert heard(b, name, cdr(0)) is None, name
        assert counted(b) == {name: {"zero_stamp": 1}}
        assert heard(b, name, cdr(STAMP_NS)).stamp_ns == STAMP_NS, name


def test_B3_B22_of_odometry_of_one_stamp_the_first_is_used_and_the_motion_is_not_lost():
    p = run(slam(), at(0), at(1, 1.0), at(1, 1.0), at(1, 9.0), at(2, 2.0))
    assert p.counters.as_dict() == {"odometry": {"duplicate": 1, "duplicate_stamp": 1}}
    assert [k.T_odom_base[0] for k in p.view.keyframes] == [0, 1, 2]
    told = []
    p = slam(keyframes__min_distance_m=0.05)
    p.counters.on_first = lambda *one: told.append(one)
    run(p, *(at(0.1 * (k // 10), 0.01 * k) for k in range(100)))
    assert p.counters.as_dict() == {"odometry": {"duplicate_stamp": 90}}
    assert told == [("odometry", "duplicate_stamp")], "the topic is named once"
    assert p.view.trajectory()[:, 0] == pytest.approx(0.1 * np.arange(10))
    p = run(slam(ordering__window_s=0.05, ordering__max_waiting=3), *(at(7, x) for x in range(10)))
    assert p.counters.as_dict() == {"odometry": {"overflow": 7}}, "repeated for ever it fills no memory"


def test_B9_B18_over_a_gap_odometry_is_one_edge_whose_noise_has_grown_with_time_or_no_motion_where_it_began_anew():
    p = run(slam(), *straight(0, 3), *straight(63, 3))
    assert p.counters.as_dict() == {}
    assert p.view.segments == [0]
    (over,) = np.flatnonzero(p.view.graph.tables[RELATIVE_POSE].measured.values[:, 0] > 50.0)
    sigma = sigma_of_edges(p.view)[over]
    assert sigma[[0, 2]] == pytest.approx(np.sqrt(60.0) * np.array([0.02, 0.05]), rel=0.05)
    assert sigma[1] > 10.0, "60 m ahead of a heading that is not known"
    p = run(slam(), *straight(0, 3), *(at(63 + 0.1 * k, 0.1 * k) for k in range(30)))
    assert p.counters.as_dict() == {"odometry": {"reset_to_zero": 1}}
    assert len(p.view.segments) == 2
    assert np.diff(p.view.trajectory()[:, 0]).min() > -1e-9, "the path goes on from where it was"
    whole, lossy = run(slam(), *straight(0, 6)), run(slam(), *straight(0, 2), *straight(4, 2))
    assert (lossy.counters.as_dict(), lossy.view.segments) == ({}, [0])
    longest = [sigma_of_edges(p.view)[:, 2].max() for p in (whole, lossy)]
    assert longest == pytest.approx([0.05 * math.sqrt(0.3), 0.05 * math.sqrt(2.1)], rel=0.1)
    assert lossy.view.trajectory()[-1] == pytest.approx(whole.view.trajectory()[-1], abs=0.3)


def test_B16_B17_what_is_seen_before_the_first_odometry_waits_and_long_ago_goes_to_its_old_keyframe_if_that_is_kept():
    p = run(slam(), seen(0.5), seen(-0.5))
    assert not p.view.landmarks
    run(p, *straight(0, 2))
    assert p.view.landmarks["a"].sightings == 1
    assert p.counters.as_dict() == {"/landmarks": {"before_odometry": 1}}
    p = run(slam(ordering__late_s=5.0), *straight(0, 20), seen(16.1), seen(3.0))
    assert p.counters.as_dict() == {"/landmarks": {"late": 1}}
    assert p.view.keyframes[p.view.sighting_poses[0].keyframe].stamp_ns == pytest.approx(T0 + 16 * S, abs=0.3 * S)
    assert p.view.landmarks["a"].sightings == 1
