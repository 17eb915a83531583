"""Types from the definitions in recordings: the least length of their messages, and ROS 1 types as CDR."""

import re
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graph_slam_ros.messages.inputs import known_types
from graph_slam_ros.messages.interfaces import typestore

MOST_TEXT = 2**16
"""Of a recorded definition; rosbags' parser takes a minute for two megabytes of blank lines."""
MOST_VALUES = 10_000
"""Of a message of a recorded definition, each sequence with one value: rosbags' decoder is as long as that."""
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


def ros1_store(type_name: str, definition: str) -> Typestore | None:
    """Return the converter of messages of a recorded ROS 1 type to CDR.

    None if a type of ours that it is or contains has other fields there (a header's ``seq`` aside), if the definition
    is unusable, or if no input reads the type.
    """
    if len(definition) > MOST_TEXT:
        return None
    try:
        recorded = get_types_from_msg(definition, type_name)
    except Exception:  # rosbags' parser raises errors of its own grammar library
        return None
    ours = typestore().fielddefs
    for name, (_, fields) in recorded.items():
        theirs = [field for field in fields if field[0] != "seq"]
        if name in ours and name not in _OF_ROS1 and theirs != list(ours[name][1]):
            return None
    if not set(re.findall(r"\w+/msg/\w+", repr(recorded))) <= {*recorded, *_OF_ROS1}:
        return None
    foreign = {name: fields for name, fields in recorded.items() if name not in ours}
    if not foreign:
        return typestore()
    if type_name not in known_types() or has_too_many_values(foreign, type_name):
        return None
    return store_with(foreign)
