"""Recorded message definitions: a bag is decoded by its own definitions if they have the fields that we need."""

from dataclasses import replace

from rosbags.typesys import get_types_from_msg

from graph_slam_ros.messages.from_msg import Decoder, decoder
from graph_slam_ros.messages.inputs.landmark_types import fields_used
from graph_slam_ros.messages.inputs.plugins import input_type
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import BagError, Topic
from graph_slam_ros.recordings.recorded_types import MOST_TEXT, MOST_VALUES, has_too_many_values, store_with

_NEEDED = {
    "nav_msgs/msg/Odometry": "header child_frame_id pose twist",
    "vision_msgs/msg/Detection3DArray": "header detections",
    "vision_msgs/msg/Detection3D": "header results bbox id",
    "vision_msgs/msg/ObjectHypothesisWithPose": "hypothesis pose",
    "vision_msgs/msg/ObjectHypothesis": "class_id",
    "vision_msgs/msg/BoundingBox3D": "center",
    "tf2_msgs/msg/TFMessage": "transforms",
    "std_msgs/msg/Header": "stamp frame_id",
    "builtin_interfaces/msg/Time": "sec nanosec",
    "geometry_msgs/msg/PoseWithCovariance": "pose covariance",
    "geometry_msgs/msg/TwistWithCovariance": "covariance",
    "geometry_msgs/msg/Pose": "position orientation",
    "geometry_msgs/msg/Point": "x y z",
    "geometry_msgs/msg/Quaternion": "x y z w",
    "geometry_msgs/msg/TransformStamped": "header child_frame_id transform",
    "geometry_msgs/msg/Transform": "translation rotation",
    "geometry_msgs/msg/Vector3": "x y z",
    "geometry_msgs/msg/PoseStamped": "header pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "header pose",
    "sensor_msgs/msg/NavSatFix": "header status latitude longitude"
    " altitude position_covariance position_covariance_type",
    "sensor_msgs/msg/NavSatStatus": "status",
    "sensor_msgs/msg/Imu": "header orientation orientation_covariance",
    "sensor_msgs/msg/PointCloud2": "header height width fields is_bigendian point_step row_step data",
    "sensor_msgs/msg/PointField": "name offset datatype",
    "visualization_msgs/msg/MarkerArray": "markers",
    "visualization_msgs/msg/Marker": "header ns id action pose",
    **fields_used(),
}
"""What the converters read of each type. Those of packages that we have no layout of are compared by name only."""


def recorded_decoder(topic: Topic) -> Decoder:
    """A decoder from CDR bytes of a topic to message objects, by the recorded definition.

    Raises
    ------
    BagError
        Another encoding than CDR, a definition that cannot be parsed, or one that lacks a field we read.
    """
    if topic.encoding != "cdr":
        raise BagError(f"topic {topic.name}: messages are encoded as {topic.encoding!r}, not cdr")
    if not topic.definition and topic.type in typestore().types:
        return decoder(topic.type)
    if not topic.definition:
        plugin = input_type(topic.type)
        if plugin is None or not plugin.definition:
            raise BagError(f"topic {topic.name}: no definition of {topic.type} in the recording")
        return _by_definition(replace(topic, definition=plugin.definition), "the plugin's")
    return _by_definition(topic, "the recorded")


def _by_definition(topic: Topic, whose: str) -> Decoder:
    if len(topic.definition) > MOST_TEXT:
        raise BagError(f"topic {topic.name}: {whose} definition of {topic.type} is longer than {MOST_TEXT} bytes")
    try:
        recorded = get_types_from_msg(topic.definition, topic.type)
    except Exception as error:  # rosbags' parser raises errors of its own grammar library
        raise BagError(f"topic {topic.name}: {whose} definition of {topic.type} is not valid") from error
    ours = typestore().fielddefs
    if all(ours.get(name) == definition for name, definition in recorded.items()):
        return decoder(topic.type)
    for name, (_, fields) in recorded.items():
        there = dict(fields)
        known = dict(ours[name][1]) if name in ours else there
        for field in _NEEDED.get(name, "").split():
            if field not in there:
                raise BagError(f"topic {topic.name}: {name} of this recording has no field {field!r}")
            if there[field] != known[field]:
                raise BagError(f"topic {topic.name}: field {field!r} of {name} has another type in this recording")
    if has_too_many_values(recorded, topic.type):
        raise BagError(f"topic {topic.name}: {whose} {topic.type} has more than {MOST_VALUES} values")
    store = store_with(recorded)
    return lambda cdr: store.deserialize_cdr(cdr, topic.type)
