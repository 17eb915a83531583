"""Reading of landmark messages with positions or poses; ``landmarks`` judges what they contain."""

import math
from collections.abc import Iterator, Sequence
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
    yield _posed("", m)


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

    def seen(name: str) -> ObservedLandmark:
        x, y, z, qx, qy, qz, qw = source.T_sensor(camera, name, stamp_ns)
        position, orientation = SimpleNamespace(x=x, y=y, z=z), SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
        return ObservedLandmark(m.header.stamp, m.header.frame_id, name, position, orientation)

    least = settings.decision_margin_min
    good = [one for one in m.detections if one.hamming <= settings.hamming_max and not one.decision_margin < least]
    if len(good) < len(m.detections):
        source.count("poor_tag", len(m.detections) - len(good))
    yield from source.each((f"{one.family}:{one.id}" for one in good), seen)


def marks(things: Sequence[Sequence[str]], source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """Things with a pose of any kind, by the fields of their array, and in it of identity and pose."""
    for array, name, place in things:
        for one in getattr(m, array):
            identity = "_".join(str(part) for part in np.ravel(getattr(one, name)))
            if getattr(one, "family", ""):
                identity = f"{one.family}:{identity}"
            yield _posed(identity, getattr(one, place), one, m)


def _posed(name: str, *parts: Any) -> ObservedLandmark:
    """A landmark of a pose or transform, and of the messages that it is a part of, from the inside out.

    The first header with a stamp, or a frame, has it: that of an array is often the time of sending.
    """
    at, parts = parts[0], parts[1:]
    while hasattr(at, "pose"):
        at, parts = at.pose, (at, *parts)
    headers = [of.header for of in parts if hasattr(of, "header")]
    stamp = next((h.stamp for h in headers if h.stamp.sec or h.stamp.nanosec), headers[0].stamp)
    frame = next((h.frame_id for h in headers if h.frame_id), "")
    covariance = next((of.covariance for of in parts if hasattr(of, "covariance")), None)
    position, rotation = (at.translation, at.rotation) if hasattr(at, "rotation") else (at.position, at.orientation)
    return ObservedLandmark(stamp, frame, name, position, rotation, covariance)


def ros2_aruco(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """ros2_aruco_interfaces/ArucoMarkers: two parallel arrays."""
    if len(m.marker_ids) != len(m.poses):
        raise MessageError("lengths_differ")
    for name, at in zip(m.marker_ids, m.poses, strict=True):
        yield _posed(str(int(name)), at, m)


def rtabmap(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """rtabmap_msgs/LandmarkDetections: an id of zero or less means none."""
    for one in m.landmarks:
        yield _posed(str(one.id) if one.id > 0 else "", one, m)


def cartographer(source: InputContext, m: Any) -> Iterator[ObservedLandmark]:
    """cartographer_ros_msgs/LandmarkList: sigma is 1 / weight, as a residual times its weight is one; 0: unknown."""
    for one in m.landmarks:
        at = one.tracking_from_landmark_transform
        sigmas = [1.0 / w if w else 0.0 for w in (one.translation_weight, one.rotation_weight)]
        covariance = np.diag([sigma * sigma for sigma in sigmas for _ in range(3)]).ravel()
        yield ObservedLandmark(m.header.stamp, m.header.frame_id, one.id, at.position, at.orientation, covariance)
