"""The position, variance and heading of a landmark by one sighting alone."""

import numpy as np

from graph_slam_ros.graph import Edge
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.typing import Array, Numbers


def seen_point(space: Geometry, one: Edge) -> Array | None:
    """Return a landmark's position (n,) in the keyframe's frame [m]; None where a sighting does not tell one."""
    measured = one.measured
    if one.type in (space.relative_pose, space.tag_position, space.sightings["position"]):
        return np.array(measured[: space.dimensions])
    if one.type is space.sightings["range_bearing"]:
        n = space.dimensions
        point = motion_compensation.point_of(space, tuple(measured[:n].tolist()))
        return np.array(space.group.act(tuple(measured[n:].tolist()), tuple(point.tolist())))
    return None


def seen_variance(space: Geometry, one: Edge, point: Array) -> float:
    """Return the variance of that position [m^2], the largest of any direction."""
    n = space.dimensions
    covariance = np.linalg.inv(one.sqrt_information.T @ one.sqrt_information)
    if one.type is space.sightings["range_bearing"]:
        return float(max(covariance[0, 0], point @ point * np.diag(covariance)[1:].max()))
    return float(np.linalg.eigvalsh(covariance[:n, :n])[-1])


def seen_heading(space: Geometry, one: Edge, base: Numbers) -> tuple[float, float]:
    """Return the heading [rad] of a landmark seen as a pose in the plane from a pose, and its variance [rad^2]."""
    if one.type is not space.relative_pose or space.dimensions != 2:
        return np.nan, 0.0
    variance = float(np.linalg.inv(one.sqrt_information.T @ one.sqrt_information)[2, 2])
    return base[2] + float(one.measured[2]), variance
