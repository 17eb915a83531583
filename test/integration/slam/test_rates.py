"""Inputs that come fast, and robots that stand: few keyframes and edges come of them, and none claims too much."""

import numpy as np
import pytest
from reliability import times

from graph_slam_ros.slam import Config, Control, Fix, GraphSlam, Odometry, Sighting, Sightings

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


@pytest.mark.parametrize("jitter_rad, jitter_m", times([(2e-3, 1e-3)], [(2e-3, 0.0), (2e-3, 1e-3), (0.0, 2e-3)]))
def test_a_parked_robot_whose_odometry_jitters_gets_no_keyframes(jitter_rad, jitter_m):
    p = run(slam(), *parked(120, jitter_rad, jitter_m, np.random.default_rng(1)))
    assert len(p.view.keyframes) <= 2
    seen = len(p.view.sighting_poses)
    assert 115 <= seen <= 180, "one a second, once it rests"
    assert p.counters["camera", "thinned"] > 2 * 1000


def test_an_imu_at_50_hz_makes_no_keyframe_each():
    p = slam(**COMPASS)
    hz, seconds = 50, 60
    for k in range(hz * seconds):
        p.process(Odometry(T0 + k * S // hz, (0.01 * k, 0.0, 0.0)))
        p.process(heading(k, hz, 0.3))
    run(p)
    driven_m = 0.01 * hz * seconds
    assert len(p.view.keyframes) <= 1.5 * driven_m / 0.25
    assert len(p.view.graph.edges_of("fixes")) == pytest.approx(seconds, abs=2)
    assert p.counters["imu", "thinned"] > 2800
    assert p.view.trajectory()[-1, 2] == pytest.approx(0.3, abs=1e-3)


def test_errors_that_last_do_not_average_out():
    """A robot stands, its compass has one error for all the while: the heading must not be surer than that allows."""
    sigmas = {}
    for correlation_s in (0.0, 1.0, 1000.0):
        p = slam(**COMPASS, **{"imu.correlation_s": correlation_s})
        for k in range(20 * 100):
            p.process(Odometry(T0 + k * S // 20, (0.0, 0.0, 0.0)))
            p.process(heading(k, 20, 0.3))
        run(p)
        sigmas[correlation_s] = float(np.sqrt(p.view.pose_covariance[2, 2]))
    assert sigmas[0.0] == pytest.approx(0.02 / np.sqrt(2000), rel=0.05)
    assert sigmas[1.0] == pytest.approx(0.02 / np.sqrt(100.0 / 2.0), rel=0.15)
    assert sigmas[1000.0] == pytest.approx(0.02, rel=0.05)


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


@pytest.mark.parametrize(
    "speed, heading, most", times([(1.5, 0.05, 4.5)], [(0.4, 0.02, 7.0), (0.4, 0.05, 15.5), (1.5, 0.05, 4.5)])
)
def test_a_camera_that_sees_tags_at_12_hz_makes_no_keyframe_at_each_sighting(speed, heading, most):
    p = past_tags(slam(**{"odometry.rotation_density": heading}), speed)
    assert len(p.view.keyframes) / (speed * 12.0) < most
    assert np.abs(p.view.trajectory()[:, 1]).max() < 0.05
