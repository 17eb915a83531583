"""Put a drive together: true motion, odometry and what was seen on the way."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.simulation.motion import VelocityNoise, accumulated, integrate
from graph_slam_ros.simulation.recording import START_NS, Recording, Seen

Array = NDArray[np.float64]
Look = Callable[[se2.Pose], tuple[tuple[str, ...], Array, Array]]
"""From the true pose, what is seen: ids, measured and covariance as in ``Seen``."""


def drive(
    rng: Generator,
    start: se2.Pose,
    twists: Array,
    dt_ns: int,
    noise: VelocityNoise,
    look: Look,
    look_every: int,
    landmarks: dict[str, se2.Pose],
) -> Recording:
    """Drive and record.

    Parameters
    ----------
    start : true pose at the first stamp; odometry begins at (0, 0, 0)
    twists : (n, 3) true velocities in base_link, each for one tick [m/s, rad/s]
    look_every : ticks from one look to the next, the first after the first tick
    """
    dt_s = dt_ns * 1e-9
    measured = twists + noise.draw(rng, len(twists), dt_s)
    truth = integrate(start, twists * dt_s)
    stamps_ns = START_NS + dt_ns * np.arange(len(truth), dtype=np.int64)
    seen = []
    for k in range(look_every, len(truth), look_every):
        ids, z, covariance = look(tuple(truth[k].tolist()))
        if ids:
            seen.append(Seen(int(stamps_ns[k]), ids, z, covariance))
    return Recording(
        stamps_ns=stamps_ns,
        T_odom_base=integrate(se2.IDENTITY, measured * dt_s),
        twist=np.concatenate([np.zeros((1, 3)), measured]),
        twist_covariance=noise.covariance,
        odom_covariance=accumulated(measured * dt_s, noise.per_tick(dt_s)),
        seen=tuple(seen),
        T_world_base=truth,
        landmarks=landmarks,
    )
