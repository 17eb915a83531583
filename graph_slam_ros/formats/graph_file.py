"""A graph as text files know it, and g2o's words for its vertices and edges."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from graph_slam_ros.graph import (
    ATTITUDE_PRIOR_3D,
    BEARING,
    BEARING_3D,
    COORDINATE_PRIOR,
    COORDINATE_PRIOR_3D,
    HEADING_PRIOR,
    HEADING_PRIOR_3D,
    LANDMARK_POSITION,
    LANDMARK_POSITION_3D,
    POINT_PRIOR,
    POSE_PRIOR,
    POSE_PRIOR_3D,
    POSITION_PRIOR,
    POSITION_PRIOR_3D,
    R1,
    R2,
    R3,
    RANGE,
    RANGE_3D,
    RANGE_BEARING,
    RANGE_BEARING_3D,
    RANGE_WITH_OFFSET,
    RANGE_WITH_OFFSET_3D,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    TAG_POSITION,
    TAG_POSITION_3D,
    EdgeType,
    Gaussian,
    Graph,
    VertexKind,
)
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Array

Values: TypeAlias = Callable[[Sequence[int]], Array]

VERTEX_TAGS: dict[str, VertexKind] = {
    "VERTEX_SE2": SE2,
    "VERTEX_XY": R2,
    "VERTEX_SE3:QUAT": SE3,
    "VERTEX_TRACKXYZ": R3,
    "VERTEX_OFFSET": R1,  # ours
}
EDGE_TAGS: dict[str, EdgeType] = {
    "EDGE_SE2": RELATIVE_POSE,
    "EDGE_SE2_XY": LANDMARK_POSITION,
    "EDGE_PRIOR_SE2": POSE_PRIOR,
    "EDGE_PRIOR_SE2_XY": POSITION_PRIOR,
    "EDGE_PRIOR_XY": POINT_PRIOR[R2],
    "EDGE_BEARING_SE2_XY": BEARING,
    "EDGE_SE3:QUAT": RELATIVE_POSE_3D,
    "EDGE_SE3_PRIOR": POSE_PRIOR_3D,
    "EDGE_SE3_TRACKXYZ": LANDMARK_POSITION_3D,
    "EDGE_POINTXYZ_PRIOR": POINT_PRIOR[R3],
    # ours; of a landmark that is a pose, only the POSITION was seen
    "EDGE_SE2_POSITION": TAG_POSITION,
    "EDGE_SE3_POSITION": TAG_POSITION_3D,
    "EDGE_RANGE_SE2_XY": RANGE,
    "EDGE_RANGE_BEARING_SE2_XY": RANGE_BEARING,
    "EDGE_RANGE_OFFSET_SE2_XY": RANGE_WITH_OFFSET,
    "EDGE_PRIOR_OFFSET": POINT_PRIOR[R1],
    "EDGE_COORDINATE_SE2": COORDINATE_PRIOR,
    "EDGE_HEADING_SE2": HEADING_PRIOR,
    "EDGE_RANGE_SE3_XYZ": RANGE_3D,
    "EDGE_BEARING_SE3_XYZ": BEARING_3D,
    "EDGE_RANGE_BEARING_SE3_XYZ": RANGE_BEARING_3D,
    "EDGE_RANGE_OFFSET_SE3_XYZ": RANGE_WITH_OFFSET_3D,
    "EDGE_POSITION_SE3": POSITION_PRIOR_3D,
    "EDGE_COORDINATE_SE3": COORDINATE_PRIOR_3D,
    "EDGE_ATTITUDE_SE3": ATTITUDE_PRIOR_3D,
    "EDGE_HEADING_SE3": HEADING_PRIOR_3D,
}
OFFSET = "PARAMS_SE3OFFSET"
AT_OFFSET = ("EDGE_SE3_PRIOR", "EDGE_SE3_TRACKXYZ")  # a parameter's number follows the vertices
# of our residual, in g2o's
HALVED = dict.fromkeys((RELATIVE_POSE_3D, POSE_PRIOR_3D), np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]))


@dataclass(slots=True)
class G2oFile:
    """A graph as read from, or to be written to, a g2o file.

    Attributes
    ----------
    ids : the file's id of each vertex of the graph
    fixed : vertices (ids of the graph) that FIX lines hold
    offsets : the parameters, where on the robot sensors are: T_base_sensor (7,) by number
    seen_from : the number of the parameter of each edge that has one
    unknown : lines with tags that are not understood, in order
    notes : what was repaired or had to be assumed, and where
    skipped : in lenient reading, what was wrong with each line left out
    raw : whether the information of rotations in space was, and is to be written, unscaled
    has_values : whether the file gave initial values; without, all are at the origin
    """

    graph: Graph
    ids: list[int]
    fixed: list[int] = field(default_factory=list)
    offsets: dict[int, se3.Pose] = field(default_factory=dict)
    seen_from: dict[int, int] = field(default_factory=dict)
    unknown: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    raw: bool = False
    has_values: bool = True
    notes: list[str] = field(default_factory=list)


def moved(points: Array, root: Array, offsets: Sequence[se3.Pose]) -> tuple[Array, Gaussian]:
    """Points (n, 3) seen in the frames of sensors, in the robot's frame: ``R p + t``, and their noise with them."""
    turn = np.array([so3.matrix(se3.rotation(offset)) for offset in offsets]).reshape(-1, 3, 3)
    shift = np.array([se3.position(offset) for offset in offsets]).reshape(-1, 3)
    return np.einsum("nij,nj->ni", turn, points) + shift, Gaussian(root @ np.swapaxes(turn, 1, 2))
