"""Types of landmark messages of packages that need not be installed: one row for each.

A new type is a row here, and a generator in ``detections`` or ``ranges`` where ``marks`` does not read it: the
converters, the fields that a recorded definition must have, and what ``graph_slam info`` offers are made of these rows.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from graph_slam_ros.messages.inputs import detections, ranges
from graph_slam_ros.messages.inputs.landmarks import ObservedLandmark
from graph_slam_ros.messages.inputs.source import InputContext


@dataclass(frozen=True, slots=True)
class LandmarkType:
    """A type of landmark messages, and its reader.

    Attributes
    ----------
    input_name : what ``graph_slam info`` calls an input of this type
    read : yields one ``ObservedLandmark`` for each landmark of a message
    fields : the fields that ``read`` uses, of the message and of its parts from the same package
    """

    input_name: str
    read: Callable[[InputContext, Any], Iterable[ObservedLandmark]]
    fields: str


def _marks(*things: str) -> LandmarkType:
    """Tags in arrays, of each the fields: the array, and in it identity and pose."""
    read = partial(detections.marks, [one.split() for one in things])
    return LandmarkType("tags", read, " ".join(("header", *things)))


APRILTAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
_APRILTAGS = "header detections family id hamming decision_margin"
_WEIGHED = "header landmarks id tracking_from_landmark_transform translation_weight rotation_weight"
_BEACON = "header sensor_pose_on_robot sensor_std_range sensed_data range id"

LANDMARK_TYPES: Mapping[str, LandmarkType] = {
    APRILTAGS: LandmarkType("tags", detections.apriltags, _APRILTAGS),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": _marks("detections id pose"),
    "apriltag_ros/msg/AprilTagDetectionArray": _marks("detections id pose"),
    "apriltags_ros/msg/AprilTagDetectionArray": _marks("detections id pose"),
    "ar_track_alvar_msgs/msg/AlvarMarkers": _marks("markers id pose"),
    "aruco_msgs/msg/MarkerArray": _marks("markers id pose"),
    "aruco_markers_msgs/msg/MarkerArray": _marks("markers id pose"),
    "ros2_aruco_interfaces/msg/ArucoMarkers": LandmarkType("tags", detections.ros2_aruco, "header marker_ids poses"),
    "aruco_opencv_msgs/msg/ArucoDetection": _marks("markers marker_id pose", "boards board_name pose"),
    "fiducial_msgs/msg/FiducialTransformArray": _marks("transforms fiducial_id transform"),
    "rtabmap_msgs/msg/LandmarkDetections": LandmarkType("tags", detections.rtabmap, "header landmarks id pose"),
    "cartographer_ros_msgs/msg/LandmarkList": LandmarkType("reflectors", detections.cartographer, _WEIGHED),
    "mrpt_msgs/msg/ObservationRangeBearing": LandmarkType(
        "beacons", ranges.mrpt, f"{_BEACON} sensor_std_yaw sensor_std_pitch yaw pitch"
    ),
    "mrpt_msgs/msg/ObservationRangeBeacon": LandmarkType("beacons", ranges.mrpt, _BEACON),
}
