"""Odometry since a keyframe: relative motion and its covariance."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.slam.config import OdometryConfig
from graph_slam_ros.slam.measurements import Odometry

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moved:
    """``T_keyframe_base`` at a stamp, and its covariance (3, 3) in right tangent coordinates."""

    odometry: Odometry
    T_keyframe_base: se2.Pose
    covariance: Array


class Motion:
    """The motion since a keyframe, remembered odometry by odometry.

    Noise is a density: a step of dt seconds adds density^2 dt. From a twist covariance C a step adds C dt max(dt, tau),
    since errors of velocity last for about tau. A robot that stands gathers none.
    """

    __slots__ = ("_config", "_density", "_flat", "_moved", "_square", "keyframe", "moving_ns")

    def __init__(self, config: OdometryConfig, keyframe: int, start: Odometry) -> None:
        self.keyframe = keyframe
        self.moving_ns = 0  # whole numbers: a sum of seconds would round
        self._config = config
        self._density = np.diag(
            np.square([config.translation_density, config.lateral_density, config.rotation_density])
        )
        self._flat: tuple[float, ...] = ()
        self._square: Array = self._density
        self._moved = [Moved(start, se2.IDENTITY, np.zeros((3, 3)))]

    @property
    def now(self) -> Moved:
        """At the newest odometry."""
        return self._moved[-1]

    @property
    def start_ns(self) -> int:
        """Stamp of the keyframe."""
        return self._moved[0].odometry.stamp_ns

    def step(self, b: Odometry) -> None:
        """Go on to odometry b."""
        last = self._moved[-1]
        step = se2.between(last.odometry.T_odom_base, b.T_odom_base)
        elapsed_ns = b.stamp_ns - last.odometry.stamp_ns
        dt = elapsed_ns * 1e-9
        moves = not self._stands(step, dt)
        self.moving_ns += elapsed_ns * moves
        self._moved.append(self._extended(last, step, dt * moves, b))

    def at(self, stamp_ns: int) -> Moved:
        """At a stamp from the keyframe's to the newest odometry's, between two odometry messages by interpolation."""
        k = bisect_right(self._moved, stamp_ns, key=_stamp) - 1
        a = self._moved[k]
        if a.odometry.stamp_ns == stamp_ns:
            return a
        b = self._moved[k + 1].odometry
        fraction = (stamp_ns - a.odometry.stamp_ns) / (b.stamp_ns - a.odometry.stamp_ns)
        at = se2.interpolate(a.odometry.T_odom_base, b.T_odom_base, fraction)
        step, dt = se2.between(a.odometry.T_odom_base, at), (stamp_ns - a.odometry.stamp_ns) * 1e-9
        return self._extended(a, step, dt * (not self._stands(step, dt)), b)

    def _extended(self, a: Moved, step: se2.Pose, moving_s: float, source: Odometry) -> Moved:
        covariance = se2.propagate_during(a.covariance, step, self._noise(moving_s, source))
        return Moved(source, se2.compose(a.T_keyframe_base, step), covariance)

    def _stands(self, step: se2.Pose, dt: float) -> bool:
        c = self._config
        still: bool = step[0] ** 2 + step[1] ** 2 < (c.still_m_s * dt) ** 2 and abs(step[2]) < c.still_rad_s * dt
        return still

    def _noise(self, dt: float, source: Odometry) -> Array:
        tau = self._config.twist_correlation_s
        if self._config.noise == "twist" and source.twist_covariance is not None:
            return self._twist(source.twist_covariance) * (dt * max(dt, tau))
        return self._density * dt

    def _twist(self, flat: tuple[float, ...]) -> Array:
        if flat is not self._flat:  # drivers repeat the same covariance
            self._flat, self._square = flat, np.array(flat).reshape(3, 3)
        return self._square


def _stamp(moved: Moved) -> int:
    return moved.odometry.stamp_ns
