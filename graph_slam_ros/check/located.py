"""The place of a sighting on the robot."""

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.typing import Array, Numbers


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


def mount_corrections(config: Config) -> dict[str, Numbers]:
    """x, y, z, roll, pitch, yaw by which the mount of each input is corrected; in the plane only x, y and yaw."""
    out: dict[str, Numbers] = {}
    for one in config.sources:
        mount = one.numbers("mount_correction", 6) or (0.0,) * 6
        out[one.name] = mount if config.world.dimensions == 3 else (*mount[:2], 0.0, 0.0, 0.0, mount[5])
    return out


def moved(points: Array, T_base_frame: se3.Pose, mount: Numbers) -> Array:
    """Points (k, 3) in the base frame, after their sensor was turned about its origin and moved."""
    if not any(mount):
        return points
    origin = np.array(T_base_frame[:3])
    turned = np.stack(so3.act(so3.exp(tuple(mount[3:])), tuple((points - origin).T)), axis=1)
    return np.asarray(turned + origin + mount[:3])
