"""A drive of a few keyframes past a few landmarks, in the plane or in space, and the runs that are made of it."""

import numpy as np

from graph_slam_ros.lie import se2, se3
from graph_slam_ros.runs.restore import record_run
from graph_slam_ros.slam import Config, Control, Odometry, Sighting, Sightings

KEYFRAMES, STEP_S = 24, 1
_NOISE_M = 0.02


def config(dimensions=2):
    return Config.from_mapping({"world.dimensions": dimensions, "keyframes.min_distance_m": 0.4})


def poses(dimensions, first=0, count=KEYFRAMES):
    """Once around, a metre at a time."""
    out = []
    for k in range(first, first + count):
        angle = 2.0 * np.pi * k / KEYFRAMES
        at = (4.0 * np.sin(angle), 4.0 - 4.0 * np.cos(angle))
        turned = (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))
        out.append((*at, angle) if dimensions == 2 else (*at, 0.1 * at[0], *map(float, turned)))
    return out


def marks(dimensions):
    around = [2.0 * np.pi * (k + 0.5) / 8 for k in range(8)]
    return {f"{k}": (6.0 * np.sin(a), 4.0 - 6.0 * np.cos(a), *[0.5] * (dimensions - 2)) for k, a in enumerate(around)}


def drive(dimensions=2, start_s=1000, seed=0, first=0):
    """Measurements of the drive: odometry that drifts, and landmarks up to 4 m away."""
    rng, group = np.random.default_rng(seed), se2 if dimensions == 2 else se3
    at, before = group.IDENTITY, None
    for k, truth in enumerate(poses(dimensions, first)):
        stamp_ns = (start_s + k * STEP_S) * 10**9
        if before is not None:
            step = tuple(map(float, group.between(before, truth)))
            at = group.compose(at, (step[0] * 1.02, *step[1:]))
        before = truth
        yield Odometry(stamp_ns, tuple(map(float, at)))
        seen = []
        for name, mark in marks(dimensions).items():
            point = np.array(group.act(group.inverse(truth), mark), dtype=float)
            if np.linalg.norm(point) < 4.0:
                point += rng.normal(0.0, _NOISE_M, dimensions)
                covariance = (_NOISE_M**2 * np.eye(dimensions)).ravel().tolist()
                seen.append(Sighting(name, "position", tuple(point.tolist()), tuple(covariance)))
        if seen:
            yield Sightings(stamp_ns, "detections", tuple(seen))
    yield Control("end")
    yield Control("optimize")


def run(folder, dimensions=2, **options):
    """The run of a drive."""
    record_run(folder, config(dimensions), drive(dimensions, **options), [])
    return folder
