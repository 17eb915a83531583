"""A city of square blocks: a robot drives along its streets and sees a landmark at every corner."""

import numpy as np
from numpy.random import Generator

from graph_slam_ros.slam import Sighting
from graph_slam_ros.tools.simulation.options import option, random
from graph_slam_ros.tools.simulation.recording import (
    CORRELATION_TIME,
    SIGMA_SIDEWAYS,
    SIGMA_SPEED,
    SIGMA_TURN,
    Recording,
    VelocityNoise,
    drive,
)
from graph_slam_ros.tools.simulation.sensing import KINDS, RangeBearing
from graph_slam_ros.typing import Array, Index, Numbers

STEP_M = 1.0
STEPS_PER_BLOCK = 4
SPEED_M_S, TURN_RAD_S = 1.0, 0.5 * np.pi  # a step and a turn take a second each
TICK_NS = 100_000_000
OBSERVE_EVERY = 10
CURB_M = 1.0  # from the middle of the crossing to the landmark, in x and in y
SENSOR = RangeBearing(0.1, np.deg2rad(1.0), 5.0)
_DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])


def stroll(rng: Generator, steps: int, blocks: int) -> tuple[Index, Index]:
    """Walk along the streets from the city's middle: straight on at half of the crossings, never back, never out.

    Returns
    -------
    cells : (steps + 1, 2) positions in steps of the street grid
    directions : (steps,) the way of each step: 0 east, 1 north, 2 west, 3 south
    """
    size = blocks * STEPS_PER_BLOCK
    x = y = blocks // 2 * STEPS_PER_BLOCK
    way = 0
    cells, ways = np.empty((steps + 1, 2), dtype=np.int64), np.empty(steps, dtype=np.int64)
    cells[0] = x, y
    wishes = rng.permuted(np.tile([0, 0, 1, 3], (steps // STEPS_PER_BLOCK + 1, 1)), axis=1).tolist()
    moves = _DIRECTIONS.tolist()
    for k in range(steps):
        if k % STEPS_PER_BLOCK == 0:
            for turn in wishes[k // STEPS_PER_BLOCK]:
                dx, dy = moves[(way + turn) % 4]
                if 0 <= x + dx <= size and 0 <= y + dy <= size:
                    way = (way + turn) % 4
                    break
        x, y = x + moves[way][0], y + moves[way][1]
        cells[k + 1] = x, y
        ways[k] = way
    return cells, ways


def simulate(
    seed: int,
    poses: int = option(500, "steps to drive, 1 m each", "", 1, 1e6),
    sensor: str = option("position", "what the sensor measures of a landmark", choices=KINDS),
    blocks: int = option(60, "the city is this many blocks wide and deep", "", 1, 1000),
    sigma_speed_m_s: float = SIGMA_SPEED,
    sigma_sideways_m_s: float = SIGMA_SIDEWAYS,
    sigma_turn_rad_s: float = SIGMA_TURN,
    correlation_time_s: float = CORRELATION_TIME,
) -> Recording:
    """Drive through the city, turning on the spot at crossings.

    Its blocks are of 4 m; the robot drives 1 m a step and chooses its way at every crossing.
    """
    rng = random(seed)
    cells, ways = stroll(rng, poses, blocks)
    side = blocks + 1
    corners = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.asarray(corners * (STEPS_PER_BLOCK * STEP_M) + CURB_M, dtype=np.float64)
    names = [f"{i}/{j}" for i, j in corners.tolist()]

    def observe(T_world_base: Numbers) -> list[Sighting]:
        return SENSOR.observe(rng, T_world_base, names, points, sensor)

    noise = VelocityNoise((sigma_speed_m_s, sigma_sideways_m_s, sigma_turn_rad_s), correlation_time_s)
    start = (*(STEP_M * cells[0]).tolist(), 0.5 * np.pi * float(ways[0]))
    landmarks = dict(zip(names, map(tuple, points.tolist()), strict=True))
    return drive(rng, start, _twists(ways), TICK_NS, noise, observe, OBSERVE_EVERY, landmarks)


def _twists(ways: Index) -> Array:
    """Velocities (n, 3), ten ticks for a step and ten for a quarter turn before it."""
    turns = (np.diff(ways, prepend=ways[:1]) + 1) % 4 - 1
    ticks = 10**9 // TICK_NS
    pieces = []
    for turn in turns.tolist():
        if turn:
            pieces.append(np.tile([0.0, 0.0, turn * TURN_RAD_S], (ticks, 1)))
        pieces.append(np.tile([SPEED_M_S, 0.0, 0.0], (ticks, 1)))
    return np.concatenate(pieces)
