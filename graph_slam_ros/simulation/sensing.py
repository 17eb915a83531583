"""Sensors: what can be seen from where, and with which noise."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from graph_slam_ros.lie import se2

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RangeBearing:
    """A sensor of range and bearing.

    Attributes
    ----------
    sigma_range_m, sigma_bearing_rad : standard deviations of its noise
    max_range_m : nothing is seen farther away
    field_of_view_rad : full angle around straight ahead
    """

    sigma_range_m: float
    sigma_bearing_rad: float
    max_range_m: float
    field_of_view_rad: float = 2.0 * np.pi

    def visible(self, T_world_base: se2.Pose, points: Array) -> NDArray[np.int64]:
        """Which of the points (m, 2) in world are in range and in view."""
        x, y = se2.act(se2.inverse(T_world_base), tuple(points.T))
        near = np.hypot(x, y) <= self.max_range_m
        return np.flatnonzero(near & (np.abs(np.arctan2(y, x)) <= 0.5 * self.field_of_view_rad))

    def measure(self, rng: Generator, T_world_base: se2.Pose, points: Array) -> tuple[Array, Array]:
        """Measured positions (k, 2) of points (k, 2) in base_link, and their covariances (k, 2, 2) in its axes.

        The covariance is taken at what was measured: a driver knows no better.
        """
        x, y = se2.act(se2.inverse(T_world_base), tuple(points.T))
        noise = rng.standard_normal((len(points), 2))
        distance = np.hypot(x, y) + self.sigma_range_m * noise[:, 0]
        bearing = np.arctan2(y, x) + self.sigma_bearing_rad * noise[:, 1]
        c, s = np.cos(bearing), np.sin(bearing)
        jacobian = np.empty((len(points), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 0, 1] = c, -distance * s
        jacobian[:, 1, 0], jacobian[:, 1, 1] = s, distance * c
        variances = np.diag([self.sigma_range_m**2, self.sigma_bearing_rad**2])
        covariance = jacobian @ variances @ np.swapaxes(jacobian, 1, 2)
        return np.stack([distance * c, distance * s], axis=1), covariance
