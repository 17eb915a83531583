"""True motion, and the odometry that measures it with errors of velocity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.tools.simulation.options import option
from graph_slam_ros.typing import Array, Numbers

SIGMA_SPEED = option(0.05, "error of the measured speed", "m/s", 1e-6, 1)
SIGMA_SIDEWAYS = option(0.01, "speed of slipping sideways", "m/s", 1e-6, 1)
SIGMA_TURN = option(0.05, "error of the measured turning speed", "rad/s", 1e-6, 1)
CORRELATION_TIME = option(0.5, "how long such an error lasts (1/e)", "s", 0, 100)


@dataclass(frozen=True, slots=True)
class VelocityNoise:
    """Errors of measured velocity: an Ornstein-Uhlenbeck process in each component.

    Attributes
    ----------
    sigmas : standard deviations in tangent order: forward, sideways and turning speed in the plane, six in space
        [m/s, rad/s]
    correlation_time_s : how long an error lasts (1/e); 0: each tick draws its own, which holds for the tick
    """

    sigmas: tuple[float, ...]
    correlation_time_s: float = 0.0

    @property
    def covariance(self) -> Array:
        """(d, d) of one measured twist."""
        return np.diag(np.square(self.sigmas))

    def _memory(self, dt_s: float) -> float:
        return float(np.exp(-dt_s / self.correlation_time_s)) if self.correlation_time_s > 0.0 else 0.0

    def draw(self, rng: Generator, ticks: int, dt_s: float) -> Array:
        """Errors (ticks, d) of successive ticks, stationary from the first."""
        memory = self._memory(dt_s)
        errors = rng.standard_normal((ticks, len(self.sigmas)))
        fresh = np.sqrt(1.0 - memory**2)
        if memory:
            for k in range(1, ticks):
                errors[k] = memory * errors[k - 1] + fresh * errors[k]
        return errors * self.sigmas

    def per_tick(self, dt_s: float) -> Array:
        """Covariance (d, d) that a tick adds to the integral in the long run: sigma^2 dt^2 (1 + a) / (1 - a)."""
        memory = self._memory(dt_s)
        return self.covariance * (dt_s**2 * (1.0 + memory) / (1.0 - memory))


def space_of(pose: Sequence[float] | Array) -> Geometry:
    """Return the space of a pose by its number of values."""
    return PLANAR if len(pose) == PLANAR.pose.size else SPATIAL


def integrate(start: Numbers, steps: Array) -> Array:
    """Poses (n + 1, 3) or (n + 1, 7) from a start by n tangent steps: ``T[k + 1] = T[k] Exp(steps[k])``."""
    if space_of(start) is PLANAR:
        return _integrate_planar(start, steps)
    poses = [start]
    for step in steps.tolist():
        poses.append(se3.retract(poses[-1], tuple(step)))
    return np.array(poses)


def _integrate_planar(start: Numbers, steps: Array) -> Array:
    """Integrate in closed form, since headings add up; angles wrapped."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    dx, dy, _ = se2.exp(tuple(steps.T))
    x = start[0] + np.concatenate([[0.0], np.cumsum(c * dx - s * dy)])
    y = start[1] + np.concatenate([[0.0], np.cumsum(s * dx + c * dy)])
    return np.stack([x, y, se2.wrap(theta)], axis=1)


def accumulated(steps: Array, per_tick: Array) -> Array:
    """Covariance (n + 1, d, d) of the poses that n steps lead to, each in its tangent space; the first is zero."""
    n, d = steps.shape
    group = se2 if d == 3 else se3
    out = np.zeros((n + 1, d, d))
    for k, step in enumerate(steps.tolist()):
        moved = tuple(float(number) for number in group.exp(tuple(step)))  # plain floats, for the kernels
        out[k + 1] = group.propagate(out[k], moved, group.noise_during(moved, per_tick))
    return out
