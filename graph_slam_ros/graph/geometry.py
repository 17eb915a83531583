"""The plane and space: what the pipeline needs to know of where the robot moves, to be written once for both."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graph_slam_ros import graph
from graph_slam_ros.graph import EdgeType, VertexKind
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.typing import Array, Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """A group of rigid motions with its vertices and edges.

    Attributes
    ----------
    pose, point : kinds of vertices
    group : ``lie.se2`` or ``lie.se3``
    turn : rotation matrix of a pose
    sightings, fixes : edge types by the kind of ``Sighting`` and ``Fix``
    dimensions : 2 or 3
    dof : degrees of freedom of a pose, 3 or 6
    """

    pose: VertexKind
    point: VertexKind
    group: Any
    identity: Numbers
    turn: Callable[[Numbers], Array]
    relative_pose: EdgeType
    pose_prior: EdgeType
    tag_position: EdgeType
    coordinate_prior: EdgeType
    sightings: Mapping[str, EdgeType]
    fixes: Mapping[str, EdgeType]
    dimensions: int = field(init=False)
    dof: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "dimensions", self.point.dof)
        object.__setattr__(self, "dof", self.pose.dof)

    def sigmas(self, sigma_m: float, sigma_rad: float) -> list[float]:
        """Standard deviations (dof,) of a pose, one for all lengths [m] and one for all angles [rad]."""
        return [sigma_m] * self.dimensions + [sigma_rad] * (self.dof - self.dimensions)

    def square(self, pose: Numbers) -> float:
        """Squared distance [m^2] of a pose from its parent's origin."""
        square = pose[0] * pose[0] + pose[1] * pose[1]
        return float(square if self.dimensions == 2 else square + pose[2] * pose[2])

    def angle(self, pose: Numbers) -> float:
        """Angle [rad] by which a pose is turned, about whatever axis."""
        if self.dimensions == 2:
            return abs(pose[2])
        return float(2.0 * np.arctan2(np.linalg.norm(pose[3:6]), abs(pose[6])))

    def normalized(self, pose: Numbers) -> Numbers:
        """The pose with a quaternion of length 1, where it has one."""
        if self.dimensions == 2:
            return pose
        return *pose[:3], *map(float, so3.normalize((pose[3], pose[4], pose[5], pose[6])))

    def heading(self, pose: Numbers) -> float:
        """Angle from the parent's x to the pose's x, seen from above."""
        turn = self.turn(pose)
        return float(np.arctan2(turn[1, 0], turn[0, 0]))

    def in_parent_axes(self, pose: Numbers, covariance: Array) -> Array:
        """Tangent-space covariance of a pose turned into the axes of its parent frame, as ROS publishes it."""
        n = self.dimensions
        turn: Array = self.group.adjoint((*self.identity[:n], *pose[n:]))
        return turn @ covariance @ turn.T

    def in_tangent(self, pose: Numbers, covariance: Array) -> Array:
        """Inverse of ``in_parent_axes``."""
        return self.in_parent_axes(self.group.inverse(pose), covariance)


def rigid_motions(points: Array) -> Array:
    """Return how points (m, d) move with the whole, (m d, 3) in the plane and (m d, 6) in space, about the origin."""
    m, size = points.shape
    out = np.zeros((m, size, 3 if size == 2 else 6))
    for axis in range(size):
        out[:, axis, axis] = 1.0
    if size == 2:
        out[:, 0, 2], out[:, 1, 2] = -points[:, 1], points[:, 0]
    else:
        x, y, z = points.T
        out[:, 1, 3], out[:, 2, 3] = -z, y
        out[:, 0, 4], out[:, 2, 4] = z, -x
        out[:, 0, 5], out[:, 1, 5] = -y, x
    return out.reshape(m * size, -1)


def _turn_2d(pose: Numbers) -> Array:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s], [s, c]])


def _turn_3d(pose: Numbers) -> Array:
    return so3.matrix((pose[3], pose[4], pose[5], pose[6]))


_SIGHTINGS = {
    "position": "LANDMARK_POSITION",
    "pose": "RELATIVE_POSE",
    "range_bearing": "RANGE_BEARING",
    "bearing": "BEARING",
    "range": "RANGE",
}
_OTHERS = "RELATIVE_POSE", "POSE_PRIOR", "TAG_POSITION", "COORDINATE_PRIOR"
_FIXES = {"pose": "POSE_PRIOR", "position": "POSITION_PRIOR", "heading": "HEADING_PRIOR", "attitude": "ATTITUDE_PRIOR"}


def _geometry(pose: VertexKind, point: VertexKind, group: Any, turn: Callable[[Numbers], Array], ends: str) -> Geometry:
    """Return the geometry of edge types whose names end so."""
    edges = {name.removesuffix(ends): edge for name, edge in vars(graph).items() if name.endswith(ends)}
    sightings = {kind: edges[name] for kind, name in _SIGHTINGS.items()}
    fixes = {kind: edges[name] for kind, name in _FIXES.items() if name in edges}
    others = {name.lower(): edges[name] for name in _OTHERS}
    return Geometry(pose, point, group, group.IDENTITY, turn, sightings=sightings, fixes=fixes, **others)


PLANAR = _geometry(graph.SE2, graph.R2, se2, _turn_2d, "")
SPATIAL = _geometry(graph.SE3, graph.R3, se3, _turn_3d, "_3D")
