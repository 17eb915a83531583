"""The problem: vertices, edges, their noise and loss. Nothing here knows how it is solved."""

from graph_slam_ros.graph.edge_type import EdgeType, check_edge, edge_from_residual, numeric_jacobian
from graph_slam_ros.graph.edges import *  # noqa: F403 (all edge types)
from graph_slam_ros.graph.graph import Graph
from graph_slam_ros.graph.losses import CAUCHY, HUBER, NONE, Loss
from graph_slam_ros.graph.noise import Gaussian
from graph_slam_ros.graph.place import PLACE_OF_ONE, place_edge
from graph_slam_ros.graph.tables import Edge, Vertex
from graph_slam_ros.graph.vertices import GROUPS, R1, R2, R3, SE2, SE3, VertexKind

__all__ = [
    "CAUCHY",
    "GROUPS",
    "HUBER",
    "NONE",
    "PLACE_OF_ONE",
    "R1",
    "R2",
    "R3",
    "SE2",
    "SE3",
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
