"""The place of a sighting on the robot."""

import numpy as np

from graph_slam_ros.lie import se3
from graph_slam_ros.measurements.types import Sighting


def located(one: Sighting) -> tuple[tuple[float, float, float], float]:
    """The point of a sighting in the base frame, NaN where it has none, and the standard deviation of it."""
    m, c = one.measured, one.covariance
    size = round(len(c) ** 0.5)
    if one.kind in ("position", "pose"):
        n = len(m) if one.kind == "position" else 2 if len(m) == 3 else 3
        sigma = (sum(c[i * (size + 1)] for i in range(n)) / n) ** 0.5
        return (m[0], m[1], m[2] if n == 3 else 0.0), sigma
    if one.kind != "range_bearing":
        return (np.nan, np.nan, np.nan), c[0] ** 0.5
    elevation = m[2] if len(m) == 3 else 0.0
    level = m[0] * np.cos(elevation)
    seen = (level * np.cos(m[1]), level * np.sin(m[1]), m[0] * np.sin(elevation))
    at = one.T_base_sensor
    if at is not None:
        T = tuple(at) if len(at) == 7 else tuple(se3.in_space(np.array([at]))[0])
        seen = se3.act(T, seen)
    sigma = ((c[0] + m[0] ** 2 * sum(c[i * (size + 1)] for i in range(1, size))) / size) ** 0.5
    return (float(seen[0]), float(seen[1]), float(seen[2])), float(sigma)
