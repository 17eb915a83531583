"""Types of landmark messages of packages that need not be installed: one row for each.

A new type is a generator in ``detections`` or ``ranges``, and a row here: the converters, the fields that a recorded
definition must have, and what ``graph_slam info`` offers are made of these rows.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
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
    fields : the fields that ``read`` uses, by the name of the message and of its parts from the same package
    """

    input_name: str
    read: Callable[[InputContext, Any], Iterable[ObservedLandmark]]
    fields: Mapping[str, str]


def _tags(read: Callable[[InputContext, Any], Iterable[ObservedLandmark]], **fields: str) -> LandmarkType:
    return LandmarkType("tags", read, fields)


APRILTAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
_MRPT = "header sensor_pose_on_robot sensor_std_range"
_POSED = detections.tags_with_poses
_APRILTAGS = _tags(_POSED, AprilTagDetectionArray="detections", AprilTagDetection="id pose")
_MARKERS = _tags(_POSED, MarkerArray="header markers", Marker="header id pose")

LANDMARK_TYPES: Mapping[str, LandmarkType] = {
    APRILTAGS: _tags(
        detections.apriltags,
        AprilTagDetectionArray="header detections",
        AprilTagDetection="family id hamming decision_margin",
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": _APRILTAGS,
    "apriltag_ros/msg/AprilTagDetectionArray": _APRILTAGS,
    "apriltags_ros/msg/AprilTagDetectionArray": _APRILTAGS,
    "ar_track_alvar_msgs/msg/AlvarMarkers": _tags(_POSED, AlvarMarkers="header markers", AlvarMarker="header id pose"),
    "aruco_msgs/msg/MarkerArray": _MARKERS,
    "aruco_markers_msgs/msg/MarkerArray": _MARKERS,
    "ros2_aruco_interfaces/msg/ArucoMarkers": _tags(detections.ros2_aruco, ArucoMarkers="header marker_ids poses"),
    "aruco_opencv_msgs/msg/ArucoDetection": _tags(
        detections.aruco_opencv,
        ArucoDetection="header markers boards",
        MarkerPose="marker_id pose",
        BoardPose="board_name pose",
    ),
    "fiducial_msgs/msg/FiducialTransformArray": _tags(
        detections.fiducials, FiducialTransformArray="header transforms", FiducialTransform="fiducial_id transform"
    ),
    "rtabmap_msgs/msg/LandmarkDetections": _tags(
        detections.rtabmap, LandmarkDetections="header landmarks", LandmarkDetection="header id pose"
    ),
    "cartographer_ros_msgs/msg/LandmarkList": LandmarkType(
        "reflectors",
        detections.cartographer,
        {
            "LandmarkList": "header landmarks",
            "LandmarkEntry": "id tracking_from_landmark_transform translation_weight rotation_weight",
        },
    ),
    "mrpt_msgs/msg/ObservationRangeBearing": LandmarkType(
        "beacons",
        ranges.mrpt,
        {
            "ObservationRangeBearing": f"{_MRPT} sensor_std_yaw sensor_std_pitch sensed_data",
            "SingleRangeBearingObservation": "range yaw pitch id",
        },
    ),
    "mrpt_msgs/msg/ObservationRangeBeacon": LandmarkType(
        "beacons",
        ranges.mrpt,
        {"ObservationRangeBeacon": f"{_MRPT} sensed_data", "SingleRangeBeaconObservation": "range id"},
    ),
}


def fields_used() -> dict[str, str]:
    """Return the fields that these types are read by, by full name of the message and of its parts."""
    return {
        f"{type_name.split('/')[0]}/msg/{name}": fields
        for type_name, row in LANDMARK_TYPES.items()
        for name, fields in row.fields.items()
    }
