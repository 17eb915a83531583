"""Jumps of odometry: its pose changes as no robot moves, because the driver restarted or a message is wrong."""

import math

from graph_slam_ros.config.frontend import OdometryConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Numbers

JUMP_SIGMA_M, JUMP_SIGMA_RAD = 10.0, 3.0  # of the motion across a jump: any heading, and anywhere within a hall
_AT_ZERO = 1e-9  # [m, rad]
_RESET_M, _RESET_RAD, _UNUSUAL = 0.1, 0.1, 3.0
_LEAST_S = 0.02  # stamps of some drivers crowd together: a pair of them says nothing of speed


class OdometryJumps:
    """Detects jumps by the motion between two messages of one odometry."""

    def __init__(self, config: OdometryConfig, space: Geometry) -> None:
        self._config, self._space = config, space

    def kind(self, motion: Numbers, T_odom_base: Numbers, dt: float, last: Numbers) -> str:
        """Return ``reset_to_zero`` or ``jump``; empty if a robot can move like this.

        Parameters
        ----------
        motion, dt : from the message before [s]
        T_odom_base : where odometry is now
        last : the motion before
        """
        if self._is_reset(motion, T_odom_base, last):
            reason = "reset_to_zero"
        else:
            is_jump = self._space.square(motion) > (self._config.max_speed_m_s * max(dt, _LEAST_S)) ** 2
            reason = "jump" if is_jump else ""
        return reason

    def _is_reset(self, motion: Numbers, T_odom_base: Numbers, last: Numbers) -> bool:
        """Return whether the driver restarted: odometry is at the origin, farther away than robots move in a step.

        The pause may have any length, because nothing arrives while a driver starts.
        """
        if abs(T_odom_base[0]) > _AT_ZERO or max(self._size(T_odom_base)) > _AT_ZERO:
            return False
        (far_m, far_rad), (usual_m, usual_rad) = self._size(motion), self._size(last)
        return far_m > max(_RESET_M, _UNUSUAL * usual_m) or far_rad > max(_RESET_RAD, _UNUSUAL * usual_rad)

    def _size(self, pose: Numbers) -> tuple[float, float]:
        """Return the size of a motion in metres and radians."""
        return math.hypot(*pose[: self._space.dimensions]), self._space.angle(pose)
