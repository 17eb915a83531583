"""Recorded message definitions: a bag is decoded by its own definitions if they have the fields that we need."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graph_slam_ros.messages.from_msg import TRANSFORMS, Decoder, own_decoder
from graph_slam_ros.messages.inputs import LANDMARK_TYPES, known_types
from graph_slam_ros.messages.inputs.plugins import input_type
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.recordings.part import BagError, Topic

_MOST_TEXT = 2**16
"""Of a recorded definition; rosbags' parser takes a minute for two megabytes of blank lines."""
_MOST_VALUES = 10_000
"""Of a message of a recorded definition, each sequence with one value: rosbags' decoder is as long as that."""
_HEADER = "std_msgs/msg/Header"
_OF_ROS1 = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")  # words of its language
_NEEDED = {
    "vision_msgs/msg/Detection3D": "header results bbox",
    "vision_msgs/msg/ObjectHypothesisWithPose": "pose",
    "vision_msgs/msg/ObjectHypothesis": "",
    "vision_msgs/msg/BoundingBox3D": "center size",
    "visualization_msgs/msg/Marker": "header ns id action pose",
}
"""What the converters read of each type; of others all that ours have."""
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
        return own_decoder(topic.type)
    if not topic.definition:
        plugin = input_type(topic.type)
        if plugin is None or not plugin.definition:
            raise BagError(f"topic {topic.name}: no definition of {topic.type} in the recording")
        return _by_definition(replace(topic, definition=plugin.definition), "the plugin's")
    return _by_definition(topic, "the recorded")


def _of_any_version(type_name: str) -> Decoder:
    """A decoder without a recorded definition: by ours, else by the older one."""
    ours, recorded = own_decoder(type_name), dict[str, Any]()
    for name, text in _OLDER.items():
        recorded |= get_types_from_msg(text, name)
    older = _store_with(recorded)

    def decoded(cdr: bytes) -> Any:
        try:
            return ours(cdr)
        except Exception:  # of a message of the other version rosbags raises errors of many kinds
            return older.deserialize_cdr(cdr, type_name)

    return decoded


def _by_definition(topic: Topic, whose: str) -> Decoder:
    if len(topic.definition) > _MOST_TEXT:
        raise BagError(f"topic {topic.name}: {whose} definition of {topic.type} is longer than {_MOST_TEXT} bytes")
    try:
        recorded = get_types_from_msg(topic.definition, topic.type)
    except Exception as error:  # rosbags' parser raises errors of its own grammar library
        raise BagError(f"topic {topic.name}: {whose} definition of {topic.type} is not valid") from error
    ours = typestore().fielddefs
    if all(ours.get(name) == definition for name, definition in recorded.items()):
        return own_decoder(topic.type)
    theirs = {field for name, (_, fields) in recorded.items() if name not in ours for field, _ in fields}
    for field in LANDMARK_TYPES[topic.type].fields.split() if topic.type in LANDMARK_TYPES else ():
        if field not in theirs:
            raise BagError(f"topic {topic.name}: {topic.type} of this recording has no field {field!r}")
    for name, (_, fields) in recorded.items():
        there, known = dict(fields), dict(ours[name][1]) if name in ours else {}
        for field in _NEEDED[name].split() if name in _NEEDED else known:
            if field not in there:
                raise BagError(f"topic {topic.name}: {name} of this recording has no field {field!r}")
            if there[field] != known[field]:
                raise BagError(f"topic {topic.name}: field {field!r} of {name} has another type in this recording")
    if _has_too_many_values(recorded, topic.type):
        raise BagError(f"topic {topic.name}: {whose} {topic.type} has more than {_MOST_VALUES} values")
    store = _store_with(recorded)
    return lambda cdr: store.deserialize_cdr(cdr, topic.type)


def in_cdr(topic: Topic, md5: str, converters: dict[str, Callable[[bytes], bytes]]) -> Topic:
    """The topic of ROS 1 messages as it is in CDR, with its converter added; unchanged where its type is not known."""
    type_name = TRANSFORMS if topic.type == "tf/msg/tfMessage" else topic.type
    store = _ros1_store(type_name, topic.definition, md5)
    if store is None:
        return topic
    converters[topic.name] = lambda data: bytes(store.ros1_to_cdr(data, type_name))
    text = store.generate_msgdef(type_name, ros_version=2)[0] if store is not typestore() else ""
    return replace(topic, type=type_name, definition=text, encoding="cdr")


def _ros1_store(type_name: str, definition: str, md5: str = "") -> Typestore | None:
    """Return the converter of messages of a recorded ROS 1 type to CDR.

    None if the definition is unusable, or if it has other fields than ours (a header's ``seq`` aside) and no input
    reads the type. Without a definition, as rosserial and goroslib record it, that of Noetic is used.
    """
    definition = definition.strip() or _of_noetic(type_name, md5)
    if not definition or len(definition) > _MOST_TEXT:
        return None
    try:
        recorded = get_types_from_msg(definition, type_name)
    except Exception:  # rosbags' parser raises errors of its own grammar library
        return None
    if not set(re.findall(r"\w+/msg/\w+", repr(recorded))) <= {*recorded, *_OF_ROS1}:
        return None
    ours, foreign = typestore().fielddefs, {}
    for name, (constants, fields) in recorded.items():
        theirs = [field for field in fields if name != _HEADER or field[0] != "seq"]
        if name not in _OF_ROS1 and (name not in ours or theirs != list(ours[name][1])):
            foreign[name] = constants, theirs
    if not foreign:
        return typestore()
    if _HEADER in foreign or type_name not in known_types() or _has_too_many_values(foreign, type_name):
        return None
    return _store_with(foreign)


@cache
def _of_noetic(type_name: str, md5: str) -> str:
    """The definition of a type in ROS Noetic, or nothing where that has another checksum."""
    store = get_typestore(Stores.ROS1_NOETIC)
    if TRANSFORMS not in store.fielddefs:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
    if type_name not in store.fielddefs:
        return ""
    text, known = store.generate_msgdef(type_name, ros_version=1)
    return text if md5 in ("", "*", known) else ""


def _has_too_many_values(recorded: Any, type_name: str) -> bool:
    """Return whether a message with one element for each sequence is too long, or has no end as it holds itself."""
    types, values, left = {**typestore().fielddefs, **recorded}, 0, [type_name]
    while left and values <= _MOST_VALUES:
        for _, (kind, of) in types[left.pop()][1]:
            count = 1
            if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                count = min(of[1], _MOST_VALUES) if kind == Nodetype.ARRAY else 1
                kind, of = of[0]
            values += 1
            if kind == Nodetype.NAME and of in types:
                left += [of] * count
    return values > _MOST_VALUES


def _store_with(recorded: Any) -> Typestore:
    """Return a store of the recorded types, with ours for those that were not recorded."""
    store = get_typestore(Stores.EMPTY)
    basic = {name: fields for name, fields in typestore().fielddefs.items() if name not in recorded}
    store.register({**basic, **recorded})
    return store
