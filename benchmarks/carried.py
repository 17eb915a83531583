"""A robot that is lifted, set down elsewhere, and turned, while its odometry notices nothing.

It drives round a rectangle of 20 m by 12 m with 20 landmarks, a lap a minute; its odometry says a way that is 3 % too
long, and turns by 0.01 rad/s too much.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from benchmarks.hall import measured, seen_from
from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Measurement
from graph_slam_ros.typing import Array

MOMENTS_S = (10.0, 20.0, 30.0, 50.0)
"""Of seeds 0 to 13: 56 drives."""
_CORNERS = np.array([(0.0, 0.0), (20.0, 0.0), (20.0, 12.0), (0.0, 12.0)])
_LAP_M, _LAP_S, _LAPS, _STEP_S, _AHEAD_M = 64.0, 60.0, 2.5, 0.1, 1.5
_REACH_M, _SIGMA_RANGE, _SIGMA_BEARING = 8.0, 0.05, 0.02
_FASTEST_TURN = 1.0  # [rad/s]
_TOO_LONG, _BIAS, _NOISE = 1.03, 0.01, (0.02, 0.005, 0.02)  # the noise of a second


@dataclass(slots=True)
class Carried:
    """One drive; ``measurements`` fills in the truth.

    Attributes
    ----------
    at_s : when it is carried, after the start
    truth : true poses, each ``_STEP_S`` later than the one before
    """

    seed: int
    at_s: float
    truth: list[tuple[float, ...]] = field(default_factory=list)

    def measurements(self) -> Iterator[Measurement]:
        """Return what the robot measures; once."""
        rng = np.random.default_rng([self.seed, int(self.at_s)])
        marks = rng.uniform((-4.0, -4.0), (24.0, 16.0), (20, 2))
        pose, odom, way_m = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
        for k in range(round(_LAPS * _LAP_S / _STEP_S)):
            if k == round(self.at_s / _STEP_S):
                way_m = _elsewhere(rng, way_m, pose)
                pose = (*_on_course(way_m), float(pose[2] + rng.choice([-1.0, 1.0])))
            moved = _LAP_M / _LAP_S * _STEP_S
            goal = se2.act(se2.inverse(pose), tuple(_on_course(way_m + _AHEAD_M)))
            turned = _STEP_S * float(np.clip(2.0 * np.arctan2(goal[1], goal[0]), -_FASTEST_TURN, _FASTEST_TURN))
            near = way_m + np.linspace(-1.0, 1.0, 81)
            away = [float(np.hypot(*(_on_course(one) - pose[:2]))) for one in near.tolist()]
            way_m = max(way_m, float(near[int(np.argmin(away))]))
            noise = np.sqrt(_STEP_S) * np.multiply(_NOISE, rng.standard_normal(3))
            said = (_TOO_LONG * moved + noise[0], noise[1], turned + _BIAS * _STEP_S + noise[2])
            pose, odom = se2.compose(pose, se2.exp((moved, 0.0, turned))), se2.compose(odom, se2.exp(said))
            self.truth.append(tuple(map(float, pose)))
            seen = list(_seen(rng, marks, pose)) if k % 2 else []
            yield from measured(tuple(map(float, odom)), self.stamp_ns(k), seen)

    @staticmethod
    def stamp_ns(step: int) -> int:
        """Return the stamp of a true pose."""
        return round((step + 10) * _STEP_S * 1e9)

    def true_positions(self, stamps_ns: Array) -> Array:
        """Return the true positions (n, 2) at stamps."""
        steps = np.round(np.asarray(stamps_ns) * 1e-9 / _STEP_S).astype(int) - 10
        return np.array(self.truth)[steps, :2]


def _on_course(way_m: float) -> Array:
    """Return a point of the rectangle."""
    sides = np.linalg.norm(np.roll(_CORNERS, -1, axis=0) - _CORNERS, axis=1)
    left, side = way_m % _LAP_M, 0
    while left > sides[side]:
        left, side = left - sides[side], side + 1
    step = np.roll(_CORNERS, -1, axis=0)[side] - _CORNERS[side]
    return np.asarray(_CORNERS[side] + step * left / sides[side])


def _elsewhere(rng: np.random.Generator, way_m: float, pose: tuple[float, ...]) -> float:
    """Return where on the course it is set down, 2 to 16 m from a pose."""
    while True:
        there = way_m + float(rng.uniform(0.0, _LAP_M))
        if 2.0 < np.hypot(*(_on_course(there) - pose[:2])) < 16.0:
            return there


def _seen(rng: np.random.Generator, marks: Array, pose: tuple[float, ...]) -> Iterator[tuple[int, Array, Array]]:
    """Return sightings of the landmarks within reach, as of ``hall.measured``."""
    for mark, at in enumerate(marks.tolist()):
        there = np.array(se2.act(se2.inverse(pose), tuple(at)))
        if 0.3 < np.hypot(*there) < _REACH_M:
            yield mark, *seen_from(there, _SIGMA_RANGE, _SIGMA_BEARING, rng)
