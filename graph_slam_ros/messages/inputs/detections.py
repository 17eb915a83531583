"""Reading of landmark messages with positions or poses; ``landmarks`` judges what they contain."""

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.landmarks import ObservedLandmark
from graph_slam_ros.messages.inputs.source import InputContext

_ADD, _DELETE, _DELETEALL = 0, 2, 3
_NOTHING = np.zeros(36)  # all zero is unknown by custom


def detections(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """vision_msgs/Detection3DArray: the first result's pose, or the centre of the box."""
    by_class = source.config.landmarks.id_from == "class_id"
    for one in m.detections:
        first = one.results[0] if len(one.results) else None
        own, sort = names_of(one)
        name = sort if by_class else own
        at, covariance = (first.pose.pose, first.pose.covariance) if first else (one.bbox.center, _NOTHING)
        frame = one.header.frame_id or m.header.frame_id
        size = _size(one.bbox.size)
        yield ObservedLandmark(
            m.header.stamp, frame, name, at.position, at.orientation, covariance, sort=sort, size=size
        )


def names_of(one: Any) -> tuple[str, str]:
    """The id and the class of a vision_msgs/Detection3D, in ROS 1 and Foxy those of its track and its hypothesis."""
    first = one.results[0] if len(one.results) else None
    of = getattr(first, "hypothesis", first)
    sort = getattr(of, "class_id", getattr(of, "id", ""))
    return getattr(one, "id", getattr(one, "tracking_id", "")), str(sort)


def _size(box: Any) -> float:
    """The geometric mean of the sides of a box that are not zero [m]; zero where all are, negative where one is."""
    sides = [side for side in (box.x, box.y, box.z) if side != 0.0]
    if not sides:
        return 0.0
    return -1.0 if min(sides) < 0.0 else math.prod(sides) ** (1.0 / len(sides))


def pose_stamped(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """geometry_msgs/PoseStamped and PoseWithCovarianceStamped: one landmark, with the configured id."""
    has_covariance = hasattr(m.pose, "covariance")
    at, covariance = (m.pose.pose, m.pose.covariance) if has_covariance else (m.pose, None)
    yield ObservedLandmark(m.header.stamp, m.header.frame_id, "", at.position, at.orientation, covariance)


def transforms(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """tf2_msgs/TFMessage: frames whose names begin as configured. A repeated stamp is left out."""
    last = source.state.setdefault("stamps", {})
    for t in m.transforms:
        child = t.child_frame_id.lstrip("/")
        if not source.settings.frame_prefix or not child.startswith(source.settings.frame_prefix):
            continue
        sent = last.get(child)
        if sent is not None and sent is not t and sent.header.stamp == t.header.stamp:
            source.count("sent_again")
            continue
        last[child] = t
        at = t.transform
        yield ObservedLandmark(t.header.stamp, t.header.frame_id, child, at.translation, at.rotation)


def markers(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """visualization_msgs/MarkerArray: the id is namespace and id. Only added or modified markers are sightings."""
    for one in m.markers:
        if one.action in (_DELETE, _DELETEALL):
            continue
        if one.action != _ADD:
            source.count("unknown_action")
            continue
        name = f"{one.ns}/{one.id}" if one.ns else str(one.id)
        yield ObservedLandmark(one.header.stamp, one.header.frame_id, name, one.pose.position, one.pose.orientation)


# -- of packages that need not be there: rows of LANDMARK_TYPES -------------------------------------------------------


def apriltags(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """apriltag_msgs/AprilTagDetectionArray: poses are on /tf below the header's frame, named by family and id."""
    settings, stamp_ns = source.settings, source.stamp_ns(m.header.stamp)
    camera = settings.frame or m.header.frame_id.removeprefix("/")
    for one in m.detections:
        if one.hamming > settings.hamming_max or one.decision_margin < settings.decision_margin_min:
            source.count("poor_tag")
            continue
        name = f"{one.family}:{one.id}"
        try:
            at = source.T_sensor(camera, name, stamp_ns)
        except MessageError as reason:
            source.count(str(reason))
            continue
        x, y, z, qx, qy, qz, qw = at
        position, orientation = SimpleNamespace(x=x, y=y, z=z), SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, name, position, orientation)


def tags_with_poses(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """Markers and AprilTags with poses: the header of the pose, else of the tag, else of the array (sent later)."""
    for one in m.markers if hasattr(m, "markers") else m.detections:
        headers = [of.header for of in (one.pose, one, m) if hasattr(of, "header")]
        stamp = next((h.stamp for h in headers if h.stamp.sec or h.stamp.nanosec), headers[0].stamp)
        frame = next((h.frame_id for h in headers if h.frame_id), "")
        of = one.pose.pose if hasattr(one.pose.pose, "pose") else one.pose
        number = "_".join(str(part) for part in np.ravel(one.id))
        name = f"{one.family}:{number}" if getattr(one, "family", "") else number
        covariance = getattr(of, "covariance", None)
        yield ObservedLandmark(stamp, frame, name, of.pose.position, of.pose.orientation, covariance)


def ros2_aruco(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """ros2_aruco_interfaces/ArucoMarkers: two parallel arrays."""
    if len(m.marker_ids) != len(m.poses):
        raise MessageError("lengths_differ")
    for name, at in zip(m.marker_ids, m.poses, strict=True):
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, str(int(name)), at.position, at.orientation)


def aruco_opencv(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """aruco_opencv_msgs/ArucoDetection: single markers by number and boards by name."""
    named = [(str(one.marker_id), one.pose) for one in m.markers] + [(one.board_name, one.pose) for one in m.boards]
    for name, at in named:
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, name, at.position, at.orientation)


def fiducials(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """fiducial_msgs/FiducialTransformArray: its errors are those in the image, not a covariance."""
    for one in m.transforms:
        at = one.transform
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, str(one.fiducial_id), at.translation, at.rotation)


def rtabmap(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """rtabmap_msgs/LandmarkDetections: an id of zero or less means none."""
    for one in m.landmarks:
        name = str(one.id) if one.id > 0 else ""
        frame, at = one.header.frame_id or m.header.frame_id, one.pose.pose
        yield ObservedLandmark(m.header.stamp, frame, name, at.position, at.orientation, one.pose.covariance)


def cartographer(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """cartographer_ros_msgs/LandmarkList: sigma is 1 / weight, as a residual times its weight is one; 0: unknown."""
    for one in m.landmarks:
        at = one.tracking_from_landmark_transform
        sigmas = [1.0 / w if w else 0.0 for w in (one.translation_weight, one.rotation_weight)]
        covariance = np.diag([sigma * sigma for sigma in sigmas for _ in range(3)]).ravel()
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, one.id, at.position, at.orientation, covariance)
