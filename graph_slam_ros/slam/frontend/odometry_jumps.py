"""Jumps of odometry: its pose changes as no robot moves, because the driver restarted or a message is wrong."""

import math

from graph_slam_ros.config.pipeline import OdometryConfig
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

    def kind(self, motion: Numbers, T_odom_base: Numbers, dt: float, last: Numbers, *, is_gap: bool = False) -> str:
        """Return ``reset_to_zero`` or ``jump``; empty if a robot can move like this.

        Parameters
        ----------
        motion, dt : from the message before [s]
        T_odom_base : where odometry is now
        last : the motion before
        is_gap : odometry was silent for so long that its driver may have restarted, and driven on since
        """
        if self._is_reset(motion, T_odom_base, last, is_gap=is_gap):
            return "reset_to_zero"
        is_jump = self._space.square(motion) > (self._config.max_speed_m_s * max(dt, _LEAST_S)) ** 2
        return "jump" if is_jump else ""

    def _is_reset(self, motion: Numbers, T_odom_base: Numbers, last: Numbers, *, is_gap: bool) -> bool:
        """Return whether the driver restarted: odometry is at the origin, farther away than robots move in a step."""
        if abs(T_odom_base[0]) > _AT_ZERO and not is_gap:
            return False
        (far_m, far_rad), (at_m, at_rad), (usual_m, usual_rad) = map(self._size, (motion, T_odom_base, last))
        most_m, most_rad = max(_RESET_M, _UNUSUAL * usual_m), max(_RESET_RAD, _UNUSUAL * usual_rad)
        is_at_zero = at_m <= most_m and at_rad <= most_rad if is_gap else max(at_m, at_rad) <= _AT_ZERO
        return is_at_zero and (far_m > most_m or far_rad > most_rad)

    def _size(self, pose: Numbers) -> tuple[float, float]:
        """Return the size of a motion in metres and radians."""
        return math.hypot(*pose[: self._space.dimensions]), self._space.angle(pose)
