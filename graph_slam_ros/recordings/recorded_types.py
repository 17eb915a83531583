"""Types from the definitions in recordings: the least length of their messages, and ROS 1 types as CDR."""

import re
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graph_slam_ros.messages.from_msg import TRANSFORMS
from graph_slam_ros.messages.inputs import known_types
from graph_slam_ros.messages.interfaces import typestore

MOST_TEXT = 2**16
"""Of a recorded definition; rosbags' parser takes a minute for two megabytes of blank lines."""
MOST_VALUES = 10_000
"""Of a message of a recorded definition, each sequence with one value: rosbags' decoder is as long as that."""
_HEADER = "std_msgs/msg/Header"
_OF_ROS1 = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")  # words of its language


def has_too_many_values(recorded: Any, type_name: str) -> bool:
    """Return whether a message of a type has more than ``MOST_VALUES``."""
    return not _length({**typestore().fielddefs, **recorded}, type_name, {}) <= MOST_VALUES


def _length(types: Any, name: str, known: dict[str, float]) -> float:
    """Return the least number of values of a message, with one element for each sequence."""
    known[name] = float("inf")  # of a type that holds itself, there is no end
    total = 0.0
    for _, (kind, of) in types[name][1]:
        count = 1
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            (inner, of), count = of[0], of[1] if kind == Nodetype.ARRAY else 1
            kind, count = inner, count if inner == Nodetype.NAME else 1
        if kind == Nodetype.NAME and of in types:
            total += count * (known[of] if of in known else _length(types, of, known))
        else:
            total += 1
    known[name] = total
    return total


def store_with(recorded: Any) -> Typestore:
    """Return a store of the recorded types, with ours for those that were not recorded."""
    store = get_typestore(Stores.EMPTY)
    basic = {name: fields for name, fields in typestore().fielddefs.items() if name not in recorded}
    store.register({**basic, **recorded})
    return store


def ros1_store(type_name: str, definition: str, md5: str = "") -> Typestore | None:
    """Return the converter of messages of a recorded ROS 1 type to CDR.

    None if the definition is unusable, or if it has other fields than ours (a header's ``seq`` aside) and no input
    reads the type. Without a definition, as rosserial and goroslib record it, that of Noetic is used.

    Parameters
    ----------
    md5 : the checksum that was recorded with the type; empty or ``*`` where there is none
    """
    definition = definition.strip() or _of_noetic(type_name, md5)
    if not definition or len(definition) > MOST_TEXT:
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
    if _HEADER in foreign or type_name not in known_types() or has_too_many_values(foreign, type_name):
        return None
    return store_with(foreign)


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
