"""Messages of packages that need not be there, as recordings define them: `;` ends a line, `|` begins a definition."""

_RULE = "=" * 80 + "\n"
_TEXTS = {
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        "std_msgs/Header header; AprilTagDetection[] detections | apriltag_msgs/AprilTagDetection; string "
        "family; int32 id; int32 hamming; float32 goodness; float32 decision_margin; Point centre; Point[4] "
        "corners; float64[9] homography | apriltag_msgs/Point; float64 x; float64 y"
    ),
    "aruco_msgs/msg/MarkerArray": (
        "std_msgs/Header header; aruco_msgs/Marker[] markers | aruco_msgs/Marker; std_msgs/Header header; "
        "uint32 id; geometry_msgs/PoseWithCovariance pose; float64 confidence"
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        "std_msgs/Header header; int64[] marker_ids; geometry_msgs/Pose[] poses"
    ),
    "aruco_opencv_msgs/msg/ArucoDetection": (
        "std_msgs/Header header; aruco_opencv_msgs/MarkerPose[] markers; aruco_opencv_msgs/BoardPose[] boards"
        " | aruco_opencv_msgs/MarkerPose; uint16 marker_id; geometry_msgs/Pose pose | "
        "aruco_opencv_msgs/BoardPose; string board_name; geometry_msgs/Pose pose"
    ),
    "aruco_markers_msgs/msg/MarkerArray": (
        "std_msgs/Header header; aruco_markers_msgs/Marker[] markers | aruco_markers_msgs/Marker; "
        "std_msgs/Header header; uint32 id; geometry_msgs/PoseStamped pose; float64 pixel_x 0; float64 "
        "pixel_y 0"
    ),
    "fiducial_msgs/msg/FiducialTransformArray": (
        "std_msgs/Header header; int32 image_seq; FiducialTransform[] transforms | "
        "fiducial_msgs/FiducialTransform; int32 fiducial_id; geometry_msgs/Transform transform; float64 "
        "image_error; float64 object_error; float64 fiducial_area"
    ),
    "rtabmap_msgs/msg/LandmarkDetections": (
        "std_msgs/Header header; LandmarkDetection[] landmarks | rtabmap_msgs/LandmarkDetection; "
        "std_msgs/Header header; string landmark_frame_id; int32 id; float32 size; "
        "geometry_msgs/PoseWithCovariance pose"
    ),
    "cartographer_ros_msgs/msg/LandmarkList": (
        "std_msgs/Header header; LandmarkEntry[] landmarks | cartographer_ros_msgs/LandmarkEntry; string id; "
        "geometry_msgs/Pose tracking_from_landmark_transform; float64 translation_weight; float64 "
        "rotation_weight"
    ),
    "mrpt_msgs/msg/ObservationRangeBearing": (
        "std_msgs/Header header; geometry_msgs/Pose sensor_pose_on_robot; float64 min_sensor_distance; "
        "float64 max_sensor_distance; float64 sensor_std_range; float64 sensor_std_yaw; float64 "
        "sensor_std_pitch; SingleRangeBearingObservation[] sensed_data | "
        "mrpt_msgs/SingleRangeBearingObservation; float64 range; float64 yaw; float64 pitch; int32 id"
    ),
    "mrpt_msgs/msg/ObservationRangeBeacon": (
        "std_msgs/Header header; geometry_msgs/Pose sensor_pose_on_robot; float64 min_sensor_distance; "
        "float64 max_sensor_distance; float64 sensor_std_range; SingleRangeBeaconObservation[] sensed_data | "
        "mrpt_msgs/SingleRangeBeaconObservation; float64 range; int32 id"
    ),
    "ar_track_alvar_msgs/msg/AlvarMarkers": (
        "std_msgs/Header header; ar_track_alvar_msgs/AlvarMarker[] markers | ar_track_alvar_msgs/AlvarMarker;"
        " std_msgs/Header header; uint32 id; geometry_msgs/PoseStamped pose"
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        "std_msgs/Header header; isaac_ros_apriltag_interfaces/AprilTagDetection[] detections | "
        "isaac_ros_apriltag_interfaces/AprilTagDetection; string family; int32 id; "
        "geometry_msgs/PoseWithCovarianceStamped pose"
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": (
        "std_msgs/Header header; apriltag_ros/AprilTagDetection[] detections | "
        "apriltag_ros/AprilTagDetection; int32[] id; float64[] size; geometry_msgs/PoseWithCovarianceStamped "
        "pose"
    ),
    "apriltags_ros/msg/AprilTagDetectionArray": (
        "std_msgs/Header header; apriltags_ros/AprilTagDetection[] detections | "
        "apriltags_ros/AprilTagDetection; int32 id; float64 size; geometry_msgs/PoseStamped pose"
    ),
}
DEFINITIONS = {name: text.replace(" | ", f"\n{_RULE}MSG: ").replace("; ", "\n") + "\n" for name, text in _TEXTS.items()}


def parts(type_name):
    """The definitions of the package that are in one of these, as .msg files have them: text by name."""
    package, _, name = type_name.split("/")
    whole, *others = DEFINITIONS[type_name].replace(f"{package}/", "").split(_RULE)
    return {one.partition("\n")[0].removeprefix("MSG: "): one.partition("\n")[2] for one in others} | {name: whole}
