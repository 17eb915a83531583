"""What the problem is: vertices, edges, their noise and loss. Nothing here knows how it is solved."""

from graph_slam_ros.graph.edges import (
    DIFFERENCE,
    INVERSE_RELATIVE_POSE,
    LANDMARK_POSITION,
    POINT_PRIOR,
    POSE_PRIOR,
    RELATIVE_POSE,
    TAG_POSITION,
    EdgeType,
    numeric_jacobian,
)
from graph_slam_ros.graph.graph import Graph
from graph_slam_ros.graph.losses import CAUCHY, HUBER, NONE, Loss
from graph_slam_ros.graph.noise import Gaussian
from graph_slam_ros.graph.vertices import R1, R2, R3, SE2, VertexKind

__all__ = [
    "CAUCHY",
    "DIFFERENCE",
    "HUBER",
    "INVERSE_RELATIVE_POSE",
    "LANDMARK_POSITION",
    "NONE",
    "POINT_PRIOR",
    "POSE_PRIOR",
    "R1",
    "R2",
    "R3",
    "RELATIVE_POSE",
    "SE2",
    "TAG_POSITION",
    "EdgeType",
    "Gaussian",
    "Graph",
    "Loss",
    "VertexKind",
    "numeric_jacobian",
]
