"""The world of the graph SLAM example in PythonRobotics: a circle among five radio tags."""

import numpy as np

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Sighting
from graph_slam_ros.tools.simulation.options import option, random
from graph_slam_ros.tools.simulation.recording import Recording, VelocityNoise, drive
from graph_slam_ros.tools.simulation.sensing import KINDS, RangeBearing
from graph_slam_ros.typing import Numbers

LANDMARKS = ((10.0, -2.0), (15.0, 10.0), (3.0, 15.0), (-5.0, 20.0), (-5.0, 5.0))
SPEED_M_S, TURN_RAD_S = 1.0, 0.1
TICK_NS = 2 * 10**9
MAX_RANGE_M = 30.0
SIDEWAYS_M_S = 1e-3  # a covariance needs a sideways part; this one is drawn too


def simulate(
    seed: int,
    poses: int = option(50, "ticks to drive, 2 s each", "", 1, 1e6),
    sensor: str = option("position", "what the sensor measures of a landmark", choices=KINDS),
) -> Recording:
    """Drive in a circle at 1 m/s and 0.1 rad/s, in ticks of 2 s. The noise is drawn once for each tick.

    Everything within 30 m is seen at every tick.
    """
    rng = random(seed)
    receiver = RangeBearing(0.2, np.deg2rad(1.0), MAX_RANGE_M)
    points = np.array(LANDMARKS)
    landmarks = {str(k): at for k, at in enumerate(LANDMARKS)}

    def observe(T_world_base: Numbers) -> list[Sighting]:
        return receiver.observe(rng, T_world_base, list(landmarks), points, sensor)

    twists = np.tile([SPEED_M_S, 0.0, TURN_RAD_S], (poses, 1))
    noise = VelocityNoise((0.1, SIDEWAYS_M_S, np.deg2rad(10.0)))
    return drive(rng, se2.IDENTITY, twists, TICK_NS, noise, observe, 1, landmarks)
