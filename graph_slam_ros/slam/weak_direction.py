"""The weakest direction of a pose or landmark: the eigenvector of its marginal covariance, in words.

Lengths and angles are never mixed: a position has a weakest direction [m], an orientation has one of its own [rad].
"""

from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Numbers

_SECTOR = np.radians(22.5)
_ALONG, _ACROSS = np.cos(_SECTOR), np.sin(_SECTOR)
_ALIKE = 1.25  # between the largest and the smallest sigma: no direction is weaker than the others


@dataclass(frozen=True, slots=True)
class WeakDirection:
    """The weakest direction of a position or of an orientation.

    Attributes
    ----------
    sigma : standard deviation in this direction [m or rad]
    axis : (n,) unit vector in the axes of the map; in the plane a turn has the axis (1,)
    words : the direction for a person: "across the path", "along x of map", "heading"
    """

    sigma: float
    axis: Array
    words: str


def weakest_position(covariance: Array, path: Array | None = None) -> WeakDirection:
    """Return the weakest direction of a position.

    Parameters
    ----------
    covariance : (n, n) in the axes of the map [m^2]
    path : (n,) the direction in which the robot drives there, in the map; None for a landmark
    """
    values, vectors = np.linalg.eigh(covariance)
    sigmas, axis = np.sqrt(np.maximum(values, 0.0)), vectors[:, -1]
    words = "in all directions alike" if sigmas[-1] < _ALIKE * sigmas[0] else _direction(axis, path)
    return WeakDirection(float(sigmas[-1]), axis, words)


def weakest_turn(space: Geometry, pose: Numbers, covariance: Array) -> WeakDirection:
    """Return the weakest direction of an orientation, from the tangent-space covariance (dof, dof) of a pose."""
    n = space.dimensions
    turns = space.in_parent_axes(pose, covariance)[n:, n:]
    if n == 2:
        return WeakDirection(float(np.sqrt(max(turns[0, 0], 0.0))), np.ones(1), "heading")
    values, vectors = np.linalg.eigh(turns)
    axis = vectors[:, -1]
    up = abs(axis[2])
    words = "heading" if up > _ALONG else "roll and pitch" if up < _ACROSS else "heading with roll and pitch"
    return WeakDirection(float(np.sqrt(max(values[-1], 0.0))), axis, words)


def position_covariance(space: Geometry, value: Numbers, covariance: Array) -> Array:
    """Return the covariance (n, n) of a position in the axes of the map.

    Parameters
    ----------
    value, covariance : of a point, or of a pose with its tangent-space covariance
    """
    n = space.dimensions
    return covariance if len(value) == n else space.in_parent_axes(value, covariance)[:n, :n]


def _direction(axis: Array, path: Array | None) -> str:
    length = 0.0 if path is None else float(np.linalg.norm(path))
    if path is not None and length > 0.0:
        along = abs(float(axis @ path)) / length
        if along > _ALONG:
            return "along the path"
        if len(axis) == 3 and abs(axis[2]) > _ALONG:
            return "along z of map"
        if along < _ACROSS:
            return "across the path"
    for name, share in zip("xyz", np.abs(axis), strict=False):
        if share > _ALONG:
            return f"along {name} of map"
    angle = np.degrees(np.arctan2(axis[1], axis[0])) % 180.0
    return f"{angle:.0f} deg from x of map"
