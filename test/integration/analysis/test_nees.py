"""The pipeline's covariances over a few drives with known noise: ``benchmarks.consistency`` is the long version."""

from dataclasses import replace

import numpy as np
import pytest
from reliability import times
from scipy.stats import chi2

from graph_slam_ros.analysis.consistency import landmark_nees, pose_nees
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.results import landmark_estimates
from graph_slam_ros.slam import Config, Control, GraphSlam, Odometry
from graph_slam_ros.tools.simulation import measurements, simulate

SEEDS = range(times(3, 5))
# What the simulator draws and nothing else: white errors of velocity, of sightings what they say, no outliers.
TOLD = {"odometry.twist_correlation_s": 0.0, "landmarks.added_sigma_m": 0.0, "landmarks.loss": "none"}
WORLDS = {
    2: ("manhattan", {"poses": 30, "blocks": 2, "sigma_speed_m_s": 0.2, "sigma_turn_rad_s": 0.2}),
    3: (
        "flight",
        {"laps": 1, "length_m": 12.0, "width_m": 12.0, "sigma_forward_m_s": 0.35, "sigma_turn_rad_s": 0.14},
    ),
}


def mean_nees(dimensions, told, noise_scale="configured"):
    """Of the last pose and of the landmarks, by a pipeline that is told so many times the sigmas that were drawn."""
    config = Config.from_mapping(TOLD | {"world.dimensions": dimensions, "robust.noise_scale": noise_scale})
    world, options = WORLDS[dimensions]
    last, landmarks = [], []
    for seed in SEEDS:
        recording = simulate(world, seed, correlation_time_s=0.0, **options)
        slam = GraphSlam(config)
        for m in [*measurements(recording), Control("end"), Control("optimize")]:
            slam.process(said(m, told))
        at = np.searchsorted(recording.stamps_ns, slam.keyframes.stamps_ns)
        poses, true = (
            se3.in_space(p) if dimensions == 2 else p for p in (slam.trajectory(), recording.T_world_base[at])
        )
        covariances, found = slam.keyframe_covariances(), landmark_estimates(slam)
        last.append(pose_nees(poses, true, covariances)[0].mean)
        positions, spots, spreads = (np.zeros((len(found), *shape)) for shape in ((3,), (3,), (3, 3)))
        for k, (name, value, covariance) in enumerate(found):
            positions[k, :dimensions] = value[:dimensions]
            spots[k, :dimensions] = recording.landmarks[name][:dimensions]
            spreads[k, :dimensions, :dimensions] = covariance[:dimensions, :dimensions]
        landmarks.append(landmark_nees(positions, spots, spreads, poses[0], true[0], covariances[0]).mean)
    return np.mean(last), np.mean(landmarks)


def said(m, factor):
    """A measurement that says so many times its sigmas."""
    if isinstance(m, Odometry):
        return replace(m, twist_covariance=tuple(factor**2 * c for c in m.twist_covariance))
    if isinstance(m, Control):
        return m
    scaled = (replace(s, covariance=tuple(factor**2 * c for c in s.covariance)) for s in m.sightings)
    return replace(m, sightings=tuple(scaled))


def usual(dof):
    """Where the mean over the runs is 999 times in 1000; landmarks of a run, which share its errors, count as one."""
    return chi2.ppf([0.0005, 0.9995], dof * len(SEEDS)) / len(SEEDS)


@pytest.mark.parametrize(
    "dimensions, dof, noise_scale",
    [(2, 3, "configured"), (3, 6, "estimated"), *times([], [(2, 3, "estimated"), (3, 6, "configured")])],
)
def test_errors_are_as_large_as_the_covariances_say(dimensions, dof, noise_scale):
    last, landmarks = mean_nees(dimensions, 1.0, noise_scale)
    assert usual(dof)[0] < last < usual(dof)[1]
    assert usual(dimensions)[0] < landmarks < usual(dimensions)[1]


@pytest.mark.parametrize("dimensions, dof", [(2, 3), *times([], [(3, 6)])])
def test_sigmas_that_are_told_too_small_are_noticed(dimensions, dof):
    last, landmarks = mean_nees(dimensions, told=0.4)
    assert last > usual(dof)[1]
    assert landmarks > usual(dimensions)[1]


def test_sigmas_that_are_told_too_large_are_noticed():
    last, landmarks = mean_nees(2, told=4.0)
    assert last < usual(3)[0]
    assert landmarks < usual(2)[0]
