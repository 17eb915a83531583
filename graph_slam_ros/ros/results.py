"""The state of a run as messages: what the node publishes and what a run's recording holds are the same bytes."""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph import SE2
from graph_slam_ros.lie import se2
from graph_slam_ros.ros import to_msg
from graph_slam_ros.slam import GraphSlam

Array = NDArray[np.float64]

PATH, POSE, LANDMARKS, TF = (
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "visualization_msgs/msg/MarkerArray",
    "tf2_msgs/msg/TFMessage",
)


def newest_pose(slam: GraphSlam) -> se2.Pose:
    """Estimated ``T_map_base`` at the newest keyframe."""
    return se2.compose(slam.T_map_odom, slam.keyframes[-1].T_odom_base)


def path(slam: GraphSlam) -> bytes:
    """The corrected path: every keyframe at its own stamp."""
    return to_msg.path(slam.config.frames.map, slam.keyframes.stamps_ns, slam.trajectory())


def pose(slam: GraphSlam) -> bytes:
    """The newest keyframe's pose and covariance."""
    return to_msg.pose_with_covariance(
        slam.keyframes[-1].stamp_ns,
        slam.config.frames.map,
        newest_pose(slam),
        slam.pose_covariance,
        slam.config.output.pose_covariance_max,
    )


def map_to_odom(slam: GraphSlam, stamp_ns: int) -> bytes:
    """The correction as a transform."""
    return to_msg.transform(stamp_ns, slam.config.frames.map, slam.config.frames.odom, slam.T_map_odom)


def odom_to_base(slam: GraphSlam) -> bytes:
    """The newest keyframe's odometry as a transform: recorded, never published (the robot's driver does that)."""
    newest, frames = slam.keyframes[-1], slam.config.frames
    return to_msg.transform(newest.stamp_ns, frames.odom, frames.base, newest.T_odom_base)


def landmarks(slam: GraphSlam) -> bytes:
    """Landmarks as 2-sigma ellipses with names."""
    found = landmark_estimates(slam)
    positions = np.array([pose[:2] for _, pose, _ in found]).reshape(-1, 2)
    names, covariances = [name for name, _, _ in found], [covariance for _, _, covariance in found]
    return to_msg.landmark_markers(slam.keyframes[-1].stamp_ns, slam.config.frames.map, names, positions, covariances)


def landmark_estimates(slam: GraphSlam) -> list[tuple[str, tuple[float, ...], Array]]:
    """(id, (x, y) or (x, y, theta), covariance (2, 2) of the position), all in the map frame."""
    vertices = [landmark.vertex for landmark in slam.landmarks.values()]
    marginals = slam.landmark_covariances() if vertices else []
    out = []
    for name, vertex, marginal in zip(slam.landmarks, vertices, marginals, strict=True):
        value = tuple(slam.solver.estimate([vertex])[0].tolist())
        if slam.graph.kind_of(vertex) is SE2:
            marginal = to_msg.in_parent_axes((value[0], value[1], value[2]), marginal)
        out.append((name, value, marginal[:2, :2]))
    return out
