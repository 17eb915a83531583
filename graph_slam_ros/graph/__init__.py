"""The problem: vertices, edges, their noise and loss. Nothing here knows how it is solved."""

from graph_slam_ros.graph.check_edge import check_edge
from graph_slam_ros.graph.edge_type import EdgeType, edge_from_residual, numeric_jacobian
from graph_slam_ros.graph.edges import (
    DIFFERENCE,
    INVERSE_RELATIVE_POSE,
    LANDMARK_POSITION,
    POINT_PRIOR,
    POSE_PRIOR,
    RELATIVE_POSE,
    TAG_POSITION,
)
from graph_slam_ros.graph.edges_3d import LANDMARK_POSITION_3D, POSE_PRIOR_3D, RELATIVE_POSE_3D, TAG_POSITION_3D
from graph_slam_ros.graph.graph import Graph
from graph_slam_ros.graph.losses import CAUCHY, HUBER, NONE, Loss
from graph_slam_ros.graph.noise import Gaussian
from graph_slam_ros.graph.place import PLACE_OF_ONE, place_edge
from graph_slam_ros.graph.priors import (
    ATTITUDE_PRIOR_3D,
    COORDINATE_PRIOR,
    COORDINATE_PRIOR_3D,
    HEADING_PRIOR,
    HEADING_PRIOR_3D,
    POSITION_PRIOR,
    POSITION_PRIOR_3D,
)
from graph_slam_ros.graph.sensors import (
    BEARING,
    BEARING_3D,
    RANGE,
    RANGE_3D,
    RANGE_BEARING,
    RANGE_BEARING_3D,
    RANGE_WITH_OFFSET,
    RANGE_WITH_OFFSET_3D,
)
from graph_slam_ros.graph.tables import Edge, Vertex
from graph_slam_ros.graph.vertices import GROUPS, R1, R2, R3, SE2, SE3, VertexKind

POINT_SEEN_FROM = {SE2: LANDMARK_POSITION, SE3: LANDMARK_POSITION_3D}
"""The edge type by which a pose of a kind sees where a point is."""

__all__ = [
    "ATTITUDE_PRIOR_3D",
    "BEARING",
    "BEARING_3D",
    "CAUCHY",
    "COORDINATE_PRIOR",
    "COORDINATE_PRIOR_3D",
    "DIFFERENCE",
    "GROUPS",
    "HEADING_PRIOR",
    "HEADING_PRIOR_3D",
    "HUBER",
    "INVERSE_RELATIVE_POSE",
    "LANDMARK_POSITION",
    "LANDMARK_POSITION_3D",
    "NONE",
    "PLACE_OF_ONE",
    "POINT_PRIOR",
    "POINT_SEEN_FROM",
    "POSE_PRIOR",
    "POSE_PRIOR_3D",
    "POSITION_PRIOR",
    "POSITION_PRIOR_3D",
    "R1",
    "R2",
    "R3",
    "RANGE",
    "RANGE_3D",
    "RANGE_BEARING",
    "RANGE_BEARING_3D",
    "RANGE_WITH_OFFSET",
    "RANGE_WITH_OFFSET_3D",
    "RELATIVE_POSE",
    "RELATIVE_POSE_3D",
    "SE2",
    "SE3",
    "TAG_POSITION",
    "TAG_POSITION_3D",
    "Edge",
    "EdgeType",
    "Gaussian",
    "Graph",
    "Loss",
    "Vertex",
    "VertexKind",
    "check_edge",
    "edge_from_residual",
    "numeric_jacobian",
    "place_edge",
]
