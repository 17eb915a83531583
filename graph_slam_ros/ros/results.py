"""The state of a run as messages: what the node publishes and what a run's recording holds are the same bytes."""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.ros import to_msg
from graph_slam_ros.slam import GraphSlam, Odometry

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Numbers = tuple[float, ...]

PATH, POSE, ODOMETRY, LANDMARKS, TF = (
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "visualization_msgs/msg/MarkerArray",
    "tf2_msgs/msg/TFMessage",
)


def newest_pose(slam: GraphSlam) -> Numbers:
    """Estimated ``T_map_base`` at the newest keyframe."""
    out: Numbers = slam.config.space.group.compose(slam.T_map_odom, slam.keyframes[-1].T_odom_base)
    return out


def path(slam: GraphSlam, most: int = 0) -> bytes:
    """The corrected path: every keyframe at its own stamp, or so many of them as ``thinned`` chooses."""
    kept = thinned(len(slam.keyframes), most)
    return to_msg.path(slam.config.frames.map, slam.keyframes.stamps_ns[kept], slam.trajectory()[kept])


def thinned(count: int, most: int) -> Index:
    """Which of ``count`` to show where no more than ``most`` (two or more; 0: all) may be, the first and last included.

    Every second, every fourth, and so on: as more come the same are chosen until they are too many, then half of them.
    """
    stride = 1
    while most and -(-(count - 1) // stride) + 1 > max(most, 2):
        stride *= 2
    kept = np.arange(0, count, stride)
    return kept if count == 0 or kept[-1] == count - 1 else np.append(kept, count - 1)


def pose(slam: GraphSlam) -> bytes:
    """The newest keyframe's pose and covariance."""
    return to_msg.pose_with_covariance_stamped(
        slam.keyframes[-1].stamp_ns,
        slam.config.frames.map,
        newest_pose(slam),
        slam.pose_covariance,
        slam.config.output.pose_covariance_max,
    )


def map_to_odom(slam: GraphSlam, stamp_ns: int) -> bytes:
    """The correction as a transform."""
    return to_msg.transform(stamp_ns, slam.config.frames.map, slam.config.frames.odom, slam.T_map_odom)


def odometry(slam: GraphSlam, m: Odometry, twist: bytes | None = None) -> bytes | None:
    """The robot in the map at an odometry message, as soon as that comes; with ``from_msg.twist_of`` the message.

    None where another odometry is in use, or this one has jumped.
    """
    now = slam.pose_at(m)
    if now is None:
        return None
    frames, unused = slam.config.frames, slam.config.output.pose_covariance_max
    return to_msg.odometry(m.stamp_ns, frames.map, frames.base, *now, unused, twist)


def odom_to_base(slam: GraphSlam) -> bytes:
    """The newest keyframe's odometry as a transform: recorded, never published (the robot's driver does that)."""
    newest, frames = slam.keyframes[-1], slam.config.frames
    return to_msg.transform(newest.stamp_ns, frames.odom, frames.base, newest.T_odom_base)


def landmarks(slam: GraphSlam) -> bytes:
    """Landmarks as 2-sigma ellipses, in space ellipsoids, with names."""
    n = slam.config.space.dimensions
    names, values, covariances = zip(*landmark_estimates(slam), strict=True) if slam.landmarks else ((), (), ())
    positions = np.array([value[:n] for value in values]).reshape(-1, n)
    spreads = [covariance[:n, :n] for covariance in covariances]
    return to_msg.landmark_markers(slam.keyframes[-1].stamp_ns, slam.config.frames.map, names, positions, spreads)


def landmark_estimates(slam: GraphSlam) -> list[tuple[str, Numbers, Array]]:
    """(id, point or pose, its covariance), all in the axes of the map frame; NaN where a covariance is unknown."""
    space, out = slam.config.space, []
    marginals = slam.landmark_covariances() if slam.landmarks else []
    for (name, landmark), marginal in zip(slam.landmarks.items(), marginals, strict=True):
        value = tuple(slam.solver.estimate([landmark.vertex])[0].tolist())
        if slam.graph.kind_of(landmark.vertex) is space.pose:
            marginal = space.in_parent_axes(value, marginal)
        out.append((name, value, marginal))
    return out
