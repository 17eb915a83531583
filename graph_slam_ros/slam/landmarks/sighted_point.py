"""The point of a sighting without id, and its covariance with the extent of the landmark."""

from dataclasses import replace

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.typing import Array


def sighted_point(space: Geometry, s: Sighting) -> tuple[Array, Array]:
    """Return the observed point (n,) in the base frame, and its covariance (n, n)."""
    n, own = space.dimensions, motion_compensation.as_matrix(s.covariance)
    if s.kind == "range_bearing":
        T_base_sensor = s.T_base_sensor or space.identity
        point = tuple(motion_compensation.point_of(space, s.measured).tolist())
        to_base = space.turn(T_base_sensor) @ motion_compensation.polar_derivative(space, s.measured)
        point, own = tuple(map(float, space.group.act(T_base_sensor, point))), to_base @ own @ to_base.T
    else:
        point = s.measured[:n]
        own = space.in_parent_axes(s.measured, own)[:n, :n] if s.kind == "pose" else own
    rounding = motion_compensation.ROUNDING * (float(np.trace(own)) + sum(x * x for x in point))
    return np.array(point), own + rounding * np.eye(n)


def with_extent(space: Geometry, s: Sighting, sigma_m: float) -> Sighting:
    """Return a sighting with a covariance that includes where on its landmark it is seen."""
    n, covariance = space.dimensions, motion_compensation.as_matrix(s.covariance)
    axes = np.eye(n)
    if s.kind == "range_bearing":
        axes = motion_compensation.gradient(space, s.kind, motion_compensation.point_of(space, s.measured))
    covariance[:n, :n] += sigma_m**2 * axes @ axes.T
    return replace(s, covariance=tuple(covariance.ravel().tolist()))
