"""The transform map -> odom to broadcast: each stamp once, in order, and only with new odometry."""

import math

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.node import TfConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Numbers


class MapToOdom:
    """The correction to broadcast. It follows the estimate at once, or with a limited speed of the robot in the map.

    Attributes
    ----------
    behind_s : the time by which the next transform would be dated before the last one; until it is 0, none is sent
    """

    def __init__(self, config: Config) -> None:
        self._space: Geometry = config.space
        self._newest_ns: int | None = None  # odometry of the last transform
        self._sent_ns: int | None = None
        self._published: Numbers | None = None
        self.behind_s = 0.0

    def forget_time(self) -> None:
        """Begin anew with the stamps."""
        self._newest_ns = self._sent_ns = None
        self.behind_s = 0.0

    def next(
        self, config: TfConfig, now_ns: int, odometry_ns: int, T_odom_base: Numbers, T_map_odom: Numbers
    ) -> tuple[int, Numbers] | None:
        """Stamp and transform to broadcast now; None if nothing is new.

        Parameters
        ----------
        now_ns : by the clock of the node
        odometry_ns, T_odom_base : the newest odometry
        T_map_odom : as it is estimated
        """
        if self._newest_ns is not None and odometry_ns <= self._newest_ns:
            return None
        stamp_ns = odometry_ns if config.stamp == "odometry" else now_ns
        stamp_ns += round(config.transform_tolerance * 1e9)
        self.behind_s = max(0.0, ((self._sent_ns or 0) - stamp_ns) * 1e-9)
        if self._sent_ns is not None and stamp_ns <= self._sent_ns:
            return None
        elapsed_s = 0.0 if self._newest_ns is None else (odometry_ns - self._newest_ns) * 1e-9
        self._published = self._followed(config, T_map_odom, T_odom_base, elapsed_s)
        self._newest_ns, self._sent_ns = odometry_ns, stamp_ns
        return stamp_ns, self._published

    def _followed(self, config: TfConfig, T_map_odom: Numbers, T_odom_base: Numbers, elapsed_s: float) -> Numbers:
        """The last transform, moved towards the estimate as far as the limits of speed allow."""
        last, group, n = self._published, self._space.group, self._space.dimensions
        if last is None or last == T_map_odom or not (config.max_speed_m_s or config.max_turn_rad_s):
            return T_map_odom
        here, there = group.compose(last, T_odom_base), group.compose(T_map_odom, T_odom_base)
        moved = group.between(here, there)
        far, turn = math.hypot(*group.log(moved)[:n]), self._space.angle(moved)  # along the arc, not across
        part = min(
            1.0,
            config.max_speed_m_s * elapsed_s / far if config.max_speed_m_s and far else 1.0,
            config.max_turn_rad_s * elapsed_s / turn if config.max_turn_rad_s and turn else 1.0,
        )
        if part == 1.0:
            return T_map_odom
        return tuple(map(float, group.compose(group.interpolate(here, there, part), group.inverse(T_odom_base))))
