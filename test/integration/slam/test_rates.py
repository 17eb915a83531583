"""Inputs that come fast, and robots that stand: few keyframes and edges come of them, and none claims too much."""

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings
from graph_slam_ros.tools.simulation import simulate, write_bag

S = 10**9
T0 = 1_700_000_000 * S
END = (Control("end"), Control("optimize"))
COMPASS = {"inputs.names": "odom imu", "imu.type": "sensor_msgs/msg/Imu"}


def slam(**settings):
    return GraphSlam(Config.from_mapping(settings))


def run(p, *events):
    for event in (*events, *END):
        p.process(event)
    return p


def covariance(n, sigma):
    return tuple((sigma**2 * np.eye(n)).ravel().tolist())


def heading(k, hz, yaw, sigma=0.02):
    return Fix(T0 + k * S // hz, "imu", "heading", (yaw,), (sigma**2,))


def parked(seconds, jitter_rad, jitter_m, rng, hz=20):
    """Odometry of a robot that stands, and a camera that sees two tags at 12 Hz."""
    for k in range(seconds * hz):
        at = (*(jitter_m * rng.uniform(-1, 1, 2)), jitter_rad * rng.uniform(-1, 1))
        yield Odometry(T0 + k * S // hz, tuple(map(float, at)))
        if k % 5 in (0, 2, 4):
            seen = [Sighting(n, "position", tuple(map(float, p + 0.02 * rng.standard_normal(2))), covariance(2, 0.02))
                    for n, p in (("a", (2.0, 1.0)), ("b", (3.0, -1.0)))]  # fmt: skip
            yield Sightings(T0 + k * S // hz, "camera", tuple(seen))


@pytest.mark.parametrize("jitter_rad, jitter_m", [(2e-3, 0.0), (2e-3, 1e-3), (0.0, 2e-3)])
def test_a_parked_robot_whose_odometry_jitters_gets_no_keyframes(jitter_rad, jitter_m):
    p = run(slam(), *parked(120, jitter_rad, jitter_m, np.random.default_rng(1)))
    assert len(p.keyframes) <= 2
    seen = len(p.sighting_poses)
    assert 115 <= seen <= 180, "one a second, once it rests"
    assert p.counters["camera", "thinned"] > 2 * 1000


def test_slow_driving_is_no_jitter():
    steps = [Odometry(T0 + k * S // 10, (2e-3 * k, 0.0, 0.0)) for k in range(600)]  # 2 cm/s
    p = run(slam(), *steps)
    assert len(p.keyframes) >= 1.2 / 0.25
    reached = np.sqrt(p.pose_covariance[0, 0])
    assert reached == pytest.approx(np.sqrt(1e-4 * 60.0 + 2e-3 * 1.2), rel=0.05), "its noise grows all the time"


def test_a_robot_that_creeps_by_less_than_its_jitter_a_second_is_believed_to_move():
    steps = [Odometry(T0 + k * S // 10, (3e-4 * k, 0.0, 0.0)) for k in range(1200)]  # 3 mm/s, 0.36 m
    p = run(slam(), *steps)
    assert np.sqrt(p.pose_covariance[0, 0]) > 0.5 * 0.02 * np.sqrt(120.0)


def test_an_imu_at_50_hz_makes_no_keyframe_each():
    p = slam(**COMPASS)
    hz, seconds = 50, 60
    for k in range(hz * seconds):
        p.process(Odometry(T0 + k * S // hz, (0.01 * k, 0.0, 0.0)))
        p.process(heading(k, hz, 0.3))
    run(p)
    driven_m = 0.01 * hz * seconds
    assert len(p.keyframes) <= 1.5 * driven_m / 0.25
    assert len(p.graph.edges_of("fixes")) == pytest.approx(seconds, abs=2)
    assert p.counters["imu", "thinned"] > 2800
    assert p.trajectory()[-1, 2] == pytest.approx(0.3, abs=1e-3)


def test_errors_that_last_do_not_average_out():
    """A robot stands, its compass has one error for all the while: the heading must not be surer than that allows."""
    sigmas = {}
    for correlation_s in (0.0, 1.0, 1000.0):
        p = slam(**COMPASS, **{"imu.correlation_s": correlation_s})
        for k in range(20 * 100):
            p.process(Odometry(T0 + k * S // 20, (0.0, 0.0, 0.0)))
            p.process(heading(k, 20, 0.3))
        run(p)
        sigmas[correlation_s] = float(np.sqrt(p.pose_covariance[2, 2]))
    assert sigmas[0.0] == pytest.approx(0.02 / np.sqrt(2000), rel=0.05)
    assert sigmas[1.0] == pytest.approx(0.02 / np.sqrt(100.0 / 2.0), rel=0.15)
    assert sigmas[1000.0] == pytest.approx(0.02, rel=0.05)


def test_the_noise_of_a_recorded_imu_is_honest_and_its_drive_better_than_odometry(tmp_path):
    from graph_slam_ros.runs.replay import replay

    settings = {"inputs.names": "odom imu", "imu.type": "sensor_msgs/msg/Imu", "imu.correlation_s": 5.0}
    inside, off, odometry_off = [], [], []
    for seed in times((2,), (1, 2)):
        recording = simulate("warehouse", seed, laps=1, landmarks=False, imu=50)
        write_bag(recording, tmp_path / f"{seed}.mcap")
        done = replay(tmp_path / f"{seed}.mcap", tmp_path / f"run{seed}", Config.from_mapping(settings))
        at = np.searchsorted(recording.stamps_ns, done.slam.keyframes.stamps_ns)
        true = recording.T_world_base[at, 2]
        wrong = se2.wrap(done.slam.trajectory()[:, 2] - true)
        sigma = np.sqrt(done.slam.keyframe_covariances()[:, 2, 2])
        inside.append(np.mean((wrong / sigma) ** 2))
        off.append(np.abs(wrong).mean())
        first = recording.T_world_base[0, 2]
        odometry_off.append(np.abs(se2.wrap(done.slam.keyframes.poses[:, 2] + first - true)).mean())
    assert np.mean(inside) < 2.0
    assert np.mean(off) < 0.5 * np.mean(odometry_off)


def past_tags(p, speed):
    """Straight on for 12 s, with a camera that sees tags at 12 Hz."""
    rng, hz = np.random.default_rng(2), 60
    tags = {f"{k}": (0.8 * k, 1.5 * (-1) ** k) for k in range(30)}
    for k in range(hz * 12):
        x = speed * k / hz
        p.process(Odometry(T0 + k * S // hz, (x, 0.0, 0.0)))
        if k % 5 == 0:
            ahead = {n: (tx - x, ty) for n, (tx, ty) in tags.items() if 0.2 < tx - x < 4.0}
            seen = [
                Sighting(n, "position", (tx + 0.02 * float(rng.standard_normal()), ty), covariance(2, 0.02))
                for n, (tx, ty) in ahead.items()
            ]
            p.process(Sightings(T0 + k * S // hz, "camera", tuple(seen)))
    return run(p)


@pytest.mark.parametrize("speed, heading, most", [(0.4, 0.02, 7.0), (0.4, 0.05, 15.5), (1.5, 0.05, 4.5)])
def test_a_camera_that_sees_tags_at_12_hz_makes_no_keyframe_at_each_sighting(speed, heading, most):
    p = past_tags(slam(**{"odometry.rotation_density": heading}), speed)
    assert len(p.keyframes) / (speed * 12.0) < most
    assert np.abs(p.trajectory()[:, 1]).max() < 0.05


def test_looks_in_quick_succession_get_keyframes_where_odometry_is_worse_than_the_camera():
    """Carried to one keyframe they would share its noise, which no covariance tells: the result would seem too good."""
    p = past_tags(slam(**{"odometry.translation_density": 0.3}), 0.4)
    assert len(p.keyframes) > 0.95 * 12 * 12
