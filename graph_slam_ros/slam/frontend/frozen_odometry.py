"""A robot that moves while its odometry stands still: what it saw from there stands elsewhere since."""

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.types import Sighting, Sightings
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise
from graph_slam_ros.typing import Array, Numbers

_SIGMAS, _LEAST_M, _OF_RANGE = 5.0, 0.1, 0.05  # a landmark is elsewhere: all three, the last times its distance
_FEWEST = 2  # landmarks, more than half of those seen again, or one that goes on moving; and messages in a row


class FrozenOdometry:
    """Compares the landmarks of each message with the first that was seen from the same place by odometry."""

    def __init__(self, noise: OdometryNoise, space: Geometry) -> None:
        self._noise, self._space = noise, space
        self._at: Numbers = ()
        self._seen: dict[tuple[str, str], tuple[Array, float]] = {}
        self._in_a_row, self._one_moved = 0, False

    def has_moved(self, m: Sightings, T_odom_base: Numbers) -> bool:
        """Return whether the robot has left a place where odometry says that it still is."""
        group = self._space.group
        if not self._at or not self._noise.is_jitter(group.between(self._at, T_odom_base)):
            self._at, self._seen, self._in_a_row, self._one_moved = T_odom_base, {}, 0, False
        points = {(m.topic, s.id): p for s in m.sightings if s.id and (p := self._point(s)) is not None}
        again = [self._is_elsewhere(*self._seen[name], *p) for name, p in points.items() if name in self._seen]
        if again:
            self._in_a_row = self._in_a_row + 1 if 2 * sum(again) > len(again) else 0
        self._seen = points | self._seen
        if self._in_a_row < _FEWEST:
            return False
        is_sure = self._one_moved or sum(again) >= _FEWEST
        self._seen, self._in_a_row, self._one_moved = points, 0, not is_sure
        return is_sure

    def _point(self, s: Sighting) -> tuple[Array, float] | None:
        """The position of a landmark from the base, and the largest variance of it; None where it has none."""
        n, space = self._space.dimensions, self._space
        point = np.array(s.measured[:n])
        if s.kind == "range_bearing":
            seen = motion_compensation.point_of(space, tuple(s.measured))
            point = np.array(space.group.act(s.T_base_sensor or space.identity, tuple(seen.tolist())))
        elif s.kind not in ("position", "pose"):
            return None
        return point, float(np.max(s.covariance)) * (float(point @ point) if s.kind == "range_bearing" else 1.0)

    def _is_elsewhere(self, before: Array, variance: float, now: Array, other: float) -> bool:
        least_m = max(_LEAST_M, _OF_RANGE * float(np.linalg.norm(now)), _SIGMAS * (variance + other) ** 0.5)
        return float(np.linalg.norm(now - before)) > least_m
