"""Results as messages: the node publishes the same bytes that the recording of a run has."""

from collections.abc import Sequence

import numpy as np

from graph_slam_ros.lie import se3
from graph_slam_ros.messages import markers, to_msg
from graph_slam_ros.messages.markers import graph_view, thinned
from graph_slam_ros.slam import MapView
from graph_slam_ros.typing import Array, Numbers

Estimate = tuple[str, Numbers, Array]

PATH, POSE, ODOMETRY, LANDMARKS, ESTIMATES, TF = (
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "visualization_msgs/msg/MarkerArray",
    "vision_msgs/msg/Detection3DArray",
    "tf2_msgs/msg/TFMessage",
)


def newest_pose(view: MapView) -> Numbers:
    """Estimated ``T_map_base`` at the newest keyframe."""
    out: Numbers = view.config.space.group.compose(view.T_map_odom, view.keyframes[-1].T_odom_base)
    return out


def path(view: MapView, most: int = 0) -> bytes:
    """The corrected path: every keyframe of the graph at its own stamp, or those that ``thinned`` selects."""
    stamps_ns, poses = view.shown_path()
    kept = thinned(len(stamps_ns), most)
    return to_msg.path(view.config.frames.map, stamps_ns[kept], poses[kept])


def pose(view: MapView) -> bytes:
    """The newest keyframe's pose and covariance."""
    return to_msg.pose_with_covariance_stamped(
        view.keyframes[-1].stamp_ns, view.config.frames.map, newest_pose(view), view.pose_covariance, to_msg.UNUSED
    )


def map_to_odom(view: MapView, stamp_ns: int) -> bytes:
    """The correction as a transform."""
    return to_msg.transform(stamp_ns, view.config.frames.map, view.config.frames.odom, view.T_map_odom)


def odom_to_base(view: MapView) -> bytes:
    """The newest keyframe's odometry as a transform. It is recorded, and only the robot's driver publishes it."""
    newest, frames = view.keyframes[-1], view.config.frames
    return to_msg.transform(newest.stamp_ns, frames.odom, frames.base, newest.T_odom_base)


def landmarks(view: MapView, estimates: Sequence[Estimate] | None = None) -> bytes:
    """Landmarks as 2-sigma ellipses, in space ellipsoids, with names; all, or those of ``landmark_estimates``."""
    n = view.config.space.dimensions
    known = landmark_estimates(view) if estimates is None else estimates
    positions = np.array([value[:n] for _, value, _ in known]).reshape(-1, n)
    spreads = [covariance[:n, :n] for _, _, covariance in known]
    names = [name for name, _, _ in known]
    return markers.landmark_markers(_stamp_ns(view), view.config.frames.map, names, positions, spreads)


def landmarks_estimate(view: MapView, estimates: Sequence[Estimate] | None = None) -> bytes:
    """Landmarks with identity, pose and covariance in the map's axes; all, or some estimates.

    What a point does not have, in the plane also height, roll and pitch, is zero with the variance ``to_msg.UNKNOWN``;
    so is all of a covariance that is unknown.
    """
    known = landmark_estimates(view) if estimates is None else estimates
    space, unused = view.space, to_msg.UNKNOWN
    poses, covariances = np.empty((len(known), 7)), np.empty((len(known), 36))
    for k, (_, value, covariance) in enumerate(known):
        full, size = unused * np.eye(space.dof), len(covariance)
        if np.isfinite(covariance).all():
            full[:size, :size] = covariance
        covariances[k] = to_msg.covariance6(full, unused)
        poses[k] = se3.in_space((*value, *space.identity[len(value) :]))
    names = [name for name, _, _ in known]
    return to_msg.detections(_stamp_ns(view), view.config.frames.map, names, poses, covariances)


def graph(view: MapView, most: int) -> bytes:
    """The graph with a limited number of keyframes, landmarks and edges, coloured by how well they fit."""
    return markers.graph_markers(_stamp_ns(view), view.config.frames.map, graph_view(view, most))


def landmark_estimates(view: MapView) -> list[Estimate]:
    """(id, point or pose, its covariance), all in the axes of the map frame; NaN where a covariance is unknown."""
    space, out = view.config.space, []
    marginals = view.landmark_covariances() if view.landmarks else []
    for (name, landmark), marginal in zip(view.landmarks.items(), marginals, strict=True):
        value = tuple(view.solver.estimate([landmark.vertex])[0].tolist())
        if view.graph.kind_of(landmark.vertex) is space.pose:
            marginal = space.in_parent_axes(value, marginal)
        out.append((name, value, marginal))
    return out


def _stamp_ns(view: MapView) -> int:
    return int(view.keyframes.stamps_ns[-1]) if view.keyframes else 0
