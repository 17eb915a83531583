"""True motion, and the odometry that measures it with errors of velocity."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from graph_slam_ros.lie import se2

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class VelocityNoise:
    """Errors of measured velocity: an Ornstein-Uhlenbeck process in each component.

    Attributes
    ----------
    sigmas : standard deviations of forward, sideways and turning speed [m/s, m/s, rad/s]
    correlation_time_s : how long an error lasts (1/e); 0: each tick draws its own, which holds for the tick
    """

    sigmas: tuple[float, float, float]
    correlation_time_s: float = 0.0

    @property
    def covariance(self) -> Array:
        """(3, 3) of one measured twist."""
        return np.diag(np.square(self.sigmas))

    def _memory(self, dt_s: float) -> float:
        return float(np.exp(-dt_s / self.correlation_time_s)) if self.correlation_time_s > 0.0 else 0.0

    def draw(self, rng: Generator, ticks: int, dt_s: float) -> Array:
        """Errors (ticks, 3) of successive ticks, stationary from the first."""
        memory = self._memory(dt_s)
        errors = rng.standard_normal((ticks, 3))
        fresh = np.sqrt(1.0 - memory**2)
        if memory:
            for k in range(1, ticks):
                errors[k] = memory * errors[k - 1] + fresh * errors[k]
        return errors * self.sigmas

    def per_tick(self, dt_s: float) -> Array:
        """Covariance (3, 3) that a tick adds to the integral in the long run: sigma^2 dt^2 (1 + a) / (1 - a)."""
        memory = self._memory(dt_s)
        return self.covariance * (dt_s**2 * (1.0 + memory) / (1.0 - memory))


def integrate(start: se2.Pose, steps: Array) -> Array:
    """Poses (n + 1, 3) from a start by n tangent steps: ``T[k + 1] = T[k] Exp(steps[k])``, angles wrapped."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    dx, dy, _ = se2.exp(tuple(steps.T))
    x = start[0] + np.concatenate([[0.0], np.cumsum(c * dx - s * dy)])
    y = start[1] + np.concatenate([[0.0], np.cumsum(s * dx + c * dy)])
    return np.stack([x, y, se2.wrap(theta)], axis=1)


def step_covariance(step: Array, per_tick: Array) -> Array:
    """Covariance (3, 3) of ``Exp(step)`` in its tangent space, from that of the step's components."""
    return se2.noise_during(se2.exp(tuple(step.tolist())), per_tick)


def accumulated(steps: Array, per_tick: Array) -> Array:
    """Covariance (n + 1, 3, 3) of the poses that n steps lead to, each in its tangent space; the first is zero."""
    out = np.zeros((len(steps) + 1, 3, 3))
    for k, step in enumerate(steps):
        x, y, theta = se2.exp(tuple(step.tolist()))
        out[k + 1] = se2.propagate(out[k], (float(x), float(y), float(theta)), step_covariance(step, per_tick))
    return out
