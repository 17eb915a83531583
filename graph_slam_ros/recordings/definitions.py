"""Recorded message definitions: a bag is decoded by its own definitions if they have the fields that we need."""

from dataclasses import replace
from typing import Any

from rosbags.typesys import get_types_from_msg

from graph_slam_ros.messages.from_msg import Decoder, decoder
from graph_slam_ros.messages.inputs.landmark_types import fields_used
from graph_slam_ros.messages.inputs.plugins import input_type
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.bag import BagError, Topic
from graph_slam_ros.recordings.recorded_types import MOST_TEXT, MOST_VALUES, has_too_many_values, store_with

_NEEDED = {
    "vision_msgs/msg/Detection3D": "header results bbox",
    "vision_msgs/msg/ObjectHypothesisWithPose": "pose",
    "vision_msgs/msg/ObjectHypothesis": "",
    "vision_msgs/msg/BoundingBox3D": "center size",
    "visualization_msgs/msg/Marker": "header ns id action pose",
    **fields_used(),
}
"""What the converters read of each type; of others all that ours have, and of packages that we have not, by name."""
_OLDER = {
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox3D bbox\nsensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id",
    "vision_msgs/msg/ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose",
}
"""Definitions of ROS 2 Foxy, whose recordings have none."""


def recorded_decoder(topic: Topic) -> Decoder:
    """A decoder from CDR bytes of a topic to message objects, by the recorded definition.

    Raises
    ------
    BagError
        Another encoding than CDR, a definition that cannot be parsed, or one that lacks a field we read.
    """
    if topic.encoding == "ros1":
        why = "unusable" if topic.definition.strip() else "empty, and none of ours has its md5sum"
        mend = "write the bag again with the rosbag API where that package is installed"
        raise BagError(f"topic {topic.name}: its definition of {topic.type} in the recording is {why}: {mend}")
    if topic.encoding != "cdr":
        raise BagError(f"topic {topic.name}: messages are encoded as {topic.encoding!r}: record them in ROS")
    if not topic.definition and topic.type in _OLDER:
        return _of_any_version(topic.type)
    if not topic.definition and topic.type in typestore().types:
        return decoder(topic.type)
    if not topic.definition:
        plugin = input_type(topic.type)
        if plugin is None or not plugin.definition:
            raise BagError(f"topic {topic.name}: no definition of {topic.type} in the recording")
        return _by_definition(replace(topic, definition=plugin.definition), "the plugin's")
    return _by_definition(topic, "the recorded")


def _of_any_version(type_name: str) -> Decoder:
    """A decoder without a recorded definition: by ours, else by the older one."""
    ours, recorded = decoder(type_name), dict[str, Any]()
    for name, text in _OLDER.items():
        recorded |= get_types_from_msg(text, name)
    older = store_with(recorded)

    def decoded(cdr: bytes) -> Any:
        try:
            return ours(cdr)
        except Exception:  # of a message of the other version rosbags raises errors of many kinds
            return older.deserialize_cdr(cdr, type_name)

    return decoded


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
        for field in _NEEDED[name].split() if name in _NEEDED else known if name in ours else ():
            if field not in there:
                raise BagError(f"topic {topic.name}: {name} of this recording has no field {field!r}")
            if there[field] != known[field]:
                raise BagError(f"topic {topic.name}: field {field!r} of {name} has another type in this recording")
    if has_too_many_values(recorded, topic.type):
        raise BagError(f"topic {topic.name}: {whose} {topic.type} has more than {MOST_VALUES} values")
    store = store_with(recorded)
    return lambda cdr: store.deserialize_cdr(cdr, topic.type)
