"""Put a drive or flight together: true motion, odometry and what was seen on the way."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.random import Generator

from graph_slam_ros.simulation.motion import VelocityNoise, accumulated, integrate, space_of
from graph_slam_ros.simulation.recording import LANDMARKS_TOPIC, START_NS, Recording
from graph_slam_ros.slam import Sighting, Sightings
from graph_slam_ros.typing import Array, Numbers

Observe = Callable[[Numbers], list[Sighting]]
"""From the true pose, what is seen."""


def drive(
    rng: Generator,
    start: Numbers,
    twists: Array,
    dt_ns: int,
    noise: VelocityNoise,
    observe: Observe,
    observe_every: int,
    landmarks: Mapping[str, Numbers],
) -> Recording:
    """Drive and record.

    Parameters
    ----------
    start : true pose at the first stamp; odometry begins at the origin
    twists : (n, 3) or (n, 6) true velocities in base_link, each for one tick [m/s, rad/s]
    observe_every : ticks from one look to the next, the first after the first tick
    landmarks : true poses or points by id
    """
    dt_s = dt_ns * 1e-9
    measured = twists + noise.draw(rng, len(twists), dt_s)
    truth = integrate(start, twists * dt_s)
    stamps_ns = START_NS + dt_ns * np.arange(len(truth), dtype=np.int64)
    seen = []
    for k in range(observe_every, len(truth), observe_every):
        sightings = observe(tuple(truth[k].tolist()))
        if sightings:
            seen.append(Sightings(int(stamps_ns[k]), LANDMARKS_TOPIC, tuple(sightings)))
    return Recording(
        stamps_ns=stamps_ns,
        T_odom_base=integrate(space_of(start).identity, measured * dt_s),
        twist=np.concatenate([np.zeros((1, twists.shape[1])), measured]),
        twist_covariance=noise.covariance,
        odom_covariance=accumulated(measured * dt_s, noise.per_tick(dt_s)),
        seen=tuple(seen),
        T_world_base=truth,
        landmarks=dict(landmarks),
    )
