"""The path between keyframes, which clocks of sensors are compared with, moves as odometry does."""

import numpy as np

from graph_slam_ros.graph.geometry import PLANAR
from graph_slam_ros.slam.calibration.path import EstimatedPath
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.frontend.odometry_track import OdometrySamples, OdometryTrack

NS = 10**9
KEYFRAMES_NS = np.array([0, 4 * NS])


def stop_and_go(standing_s=3.0):
    """Odometry of a robot that stands, and then drives 0.5 m/s until 4 s."""
    samples = OdometrySamples(PLANAR)
    for k in range(1, 400):
        at_s = 0.01 * k
        samples.add(Step(round(at_s * NS), (0.0, 0.0, 0.0), (max(0.0, 0.5 * (at_s - standing_s)), 0.0, 0.0)))
    return samples.track(np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), (1.0, 1.0))


def at(path, *seconds):
    return path.at(np.round(np.array(seconds) * NS).astype(np.int64), 0.0).poses


def test_a_robot_that_stands_and_goes_is_where_odometry_has_it():
    path = EstimatedPath(PLANAR, KEYFRAMES_NS, np.array([[1.0, 2.0, 0.0], [1.5, 2.0, 0.0]]), (), stop_and_go())
    np.testing.assert_allclose(at(path, 0.0, 1.5, 3.0, 3.5, 4.0)[:, 0], [1.0, 1.0, 1.0, 1.25, 1.5], atol=0.003)


def test_what_the_estimate_corrects_is_spread_over_the_time():
    path = EstimatedPath(PLANAR, KEYFRAMES_NS, np.array([[0.0, 0.0, 0.0], [0.5, 0.4, 0.0]]), (), stop_and_go())
    np.testing.assert_allclose(at(path, 1.0, 2.0, 4.0), [[0.0, 0.1, 0.0], [0.0, 0.2, 0.0], [0.5, 0.4, 0.0]], atol=0.003)


def test_a_factor_corrects_the_motion_where_it_was():
    track = stop_and_go()
    track = OdometryTrack(track.keyframes, track.stamps_ns, track.poses, distance=2.0)
    path = EstimatedPath(PLANAR, KEYFRAMES_NS, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), (), track)
    np.testing.assert_allclose(at(path, 2.9, 3.5)[:, 0], [0.0, 0.5], atol=0.006)


def test_a_rest_is_known_and_a_silence_of_odometry_is_not():
    poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
    rest = EstimatedPath(PLANAR, KEYFRAMES_NS, poses, (), stop_and_go(3.5))
    assert rest.knows(np.array([2 * NS]), 0.1).all()
    silent = OdometryTrack(poses, np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    assert not EstimatedPath(PLANAR, KEYFRAMES_NS, poses, (), silent).knows(np.array([2 * NS]), 0.1).any()


def test_samples_of_a_robot_that_stands_are_few():
    track = stop_and_go()
    assert len(track.stamps_ns) < 30
    assert np.diff(track.stamps_ns[track.stamps_ns > 3.1 * NS]).max() <= 0.06 * NS


def test_stamps_that_begin_anew_forget_the_samples():
    samples = OdometrySamples(PLANAR)
    samples.add(Step(5 * NS, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    samples.forget()
    samples.add(Step(NS, (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)))
    assert samples.track(np.zeros((0, 3)), (1.0, 1.0)).stamps_ns.tolist() == [NS]
