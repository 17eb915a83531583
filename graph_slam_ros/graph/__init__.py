"""What the problem is: vertices, edges, their noise and loss. Nothing here knows how it is solved."""

from graph_slam_ros.graph.edge_type import EdgeType, numeric_jacobian
from graph_slam_ros.graph.edges import (
    DIFFERENCE,
    INVERSE_RELATIVE_POSE,
    LANDMARK_POSITION,
    POINT_PRIOR,
    POSE_PRIOR,
    RELATIVE_POSE,
    TAG_POSITION,
)
from graph_slam_ros.graph.edges_3d import LANDMARK_POSITION_3D, POSE_PRIOR_3D, RELATIVE_POSE_3D
from graph_slam_ros.graph.graph import Graph
from graph_slam_ros.graph.losses import CAUCHY, HUBER, NONE, Loss
from graph_slam_ros.graph.noise import Gaussian
from graph_slam_ros.graph.vertices import R1, R2, R3, SE2, SE3, VertexKind

__all__ = [
    "CAUCHY",
    "DIFFERENCE",
    "HUBER",
    "INVERSE_RELATIVE_POSE",
    "LANDMARK_POSITION",
    "LANDMARK_POSITION_3D",
    "NONE",
    "POINT_PRIOR",
    "POSE_PRIOR",
    "POSE_PRIOR_3D",
    "R1",
    "R2",
    "R3",
    "RELATIVE_POSE",
    "RELATIVE_POSE_3D",
    "SE2",
    "SE3",
    "TAG_POSITION",
    "EdgeType",
    "Gaussian",
    "Graph",
    "Loss",
    "VertexKind",
    "numeric_jacobian",
]
