"""Odometry since the newest keyframe: relative motion and its covariance."""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.slam.config import OdometryConfig
from graph_slam_ros.slam.measurements import Odometry

Array = NDArray[np.float64]


class Motion:
    """``T_keyframe_base`` and its covariance (3, 3) in right tangent coordinates, grown odometry by odometry.

    Noise is a density: a step of dt seconds adds density^2 dt. From a twist covariance C a step adds C dt max(dt, tau),
    since errors of velocity last for about tau. A robot that stands gathers none.
    """

    __slots__ = ("T_keyframe_base", "_config", "_density", "_flat", "_square", "covariance", "moving_s")

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._density = np.diag(
            np.square([config.translation_density, config.lateral_density, config.rotation_density])
        )
        self._flat: tuple[float, ...] = ()
        self._square: Array = self._density
        self.restart()

    def restart(self) -> None:
        """Begin at a new keyframe."""
        self.T_keyframe_base: se2.Pose = se2.IDENTITY
        self.covariance: Array = np.zeros((3, 3))
        self.moving_s = 0.0

    def step(self, a: Odometry, b: Odometry) -> None:
        """Go on from odometry a to odometry b."""
        self._append(se2.between(a.T_odom_base, b.T_odom_base), (b.stamp_ns - a.stamp_ns) * 1e-9, b)

    def between(self, a: Odometry, b: Odometry, stamp_ns: int) -> "Motion":
        """The motion until a stamp between odometry a, where this one ends, and b."""
        part = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        out = Motion(self._config)
        out.T_keyframe_base, out.covariance = self.T_keyframe_base, self.covariance
        step = se2.between(a.T_odom_base, se2.interpolate(a.T_odom_base, b.T_odom_base, part))
        out._append(step, (stamp_ns - a.stamp_ns) * 1e-9, b)
        return out

    def _append(self, step: se2.Pose, dt: float, source: Odometry) -> None:
        self.T_keyframe_base = se2.compose(self.T_keyframe_base, step)
        self.covariance = se2.propagate_during(self.covariance, step, self._noise(step, dt, source))

    def _noise(self, step: se2.Pose, dt: float, source: Odometry) -> Array:
        c = self._config
        if step[0] ** 2 + step[1] ** 2 < (c.still_m_s * dt) ** 2 and abs(step[2]) < c.still_rad_s * dt:
            return np.zeros((3, 3))
        self.moving_s += dt
        if c.noise == "twist" and source.twist_covariance is not None:
            return self._twist(source.twist_covariance) * (dt * max(dt, c.twist_correlation_s))
        return self._density * dt

    def _twist(self, flat: tuple[float, ...]) -> Array:
        if flat is not self._flat:  # drivers repeat the same covariance
            self._flat, self._square = flat, np.array(flat).reshape(3, 3)
        return self._square
