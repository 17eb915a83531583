"""The kinds of edits by hand: what each one does, and the keys that it has.

This table is the only one. Plans, ``graph_slam map edit --help``, docs/edits.md and the page are made from it.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from reprlib import repr as shortened
from typing import Any, TypeAlias

from graph_slam_ros.errors import FormatError

Argument: TypeAlias = bool | int | float | str | tuple[int, ...] | tuple[float, ...]
POSE_SIZES = {2: 3, 3: 7}  # numbers of a pose, by the dimensions of the map
_MOST_EDGES = 1_000_000
_FARTHEST = 1e9  # m, s
_STAMP = re.compile(r"\d{1,10}(\.\d{1,9})?", re.ASCII)
_UNIT = 1e-3  # so far from 1 the length of a quaternion may be


@dataclass(frozen=True, slots=True)
class Field:
    """The value of a key of an edit.

    Attributes
    ----------
    kind : by which a page chooses what to ask for
    text : what is expected, in words
    read : the value as it is kept, of one from JSON; raises ValueError without a text
    """

    kind: str
    text: str
    read: Callable[[Any], Argument]


@dataclass(frozen=True, slots=True)
class Action:
    """A kind of edit.

    Attributes
    ----------
    fields : the keys that it needs
    either : sets of keys of which it needs exactly one; empty: there are none
    done : what it did, in words, of its keys
    help : what it does, for a table
    """

    fields: Mapping[str, Field]
    done: str
    help: str
    either: tuple[Mapping[str, Field], ...] = ()

    @property
    def known(self) -> dict[str, Field]:
        """All keys that it may have."""
        return {key: field for several in (self.fields, *self.either) for key, field in several.items()}

    @property
    def keys_text(self) -> str:
        """The keys, for a table: ``either edges or from, until``."""
        names = [", ".join(several) for several in self.either]
        return ", ".join([*self.fields, *([f"either {' or '.join(names)}"] if names else [])])


def _whole(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError
    return value


def _several(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list | tuple) or not 0 < len(value) <= _MOST_EDGES:
        raise ValueError
    edges = tuple(map(_whole, value))
    if len(set(edges)) < len(edges):
        raise ValueError
    return edges


def _text(most: int) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if not isinstance(value, str) or not value.strip() or len(value) > most:
            raise ValueError
        return value

    return read


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or abs(value) > _FARTHEST:
        raise ValueError
    return float(value)


def _positive(value: Any) -> float:
    if (number := _number(value)) <= 0.0:
        raise ValueError
    return number


def _not_negative(value: Any) -> float:
    if (number := _number(value)) < 0.0:
        raise ValueError
    return number


def _pose(value: Any) -> tuple[float, ...]:
    if not isinstance(value, list | tuple) or len(value) not in POSE_SIZES.values():
        raise ValueError
    numbers = tuple(map(_number, value))
    if len(numbers) == 7 and abs(math.hypot(*numbers[3:]) - 1.0) > _UNIT:
        raise ValueError
    return numbers


def _keyframe(value: Any) -> int | str:
    if isinstance(value, str) and _STAMP.fullmatch(value):
        return value
    return _whole(value)


EDGE = Field("edge", "the id of an edge: a whole number, 0 or more", _whole)
EDGES = Field("edges", "a list of ids of edges, each once", _several)
LANDMARK = Field("landmark", "the name of a landmark: a text of up to 10000 characters", _text(10_000))
NAME = Field("name", "a text of up to 128 characters", _text(128))
KEYFRAME = Field("keyframe", 'the number of a keyframe, or a stamp [s] as a text: 17 or "1700000000.5"', _keyframe)
POSE = Field("pose", "a pose: [x, y, theta], or in space [x, y, z, qx, qy, qz, qw], the last four of length 1", _pose)
SIGMA_M = Field("sigma_m", "a standard deviation in metres, above 0", _positive)
SIGMA_RAD = Field("sigma_rad", "a standard deviation in radians, above 0", _positive)
EXACT_M = Field("exact_m", "a standard deviation in metres; 0: exact (1 mm)", _not_negative)
EXACT_RAD = Field("exact_rad", "a standard deviation in radians; 0: exact (0.001 rad)", _not_negative)
_RANGE = {"from": KEYFRAME, "until": KEYFRAME}

ACTIONS: dict[str, Action] = {
    "remove_edge": Action(
        {"edge": EDGE},
        "edge {edge} taken out",
        "A closure, fix or sighting is taken out. A landmark goes with the last edge that determines it.",
    ),
    "let_in_edge": Action(
        {"edge": EDGE},
        "edge {edge} let in",
        "An edge is in with its full weight and without a loss. A new edge of class `by_hand` replaces it.",
    ),
    "add_closure": Action(
        {"from_keyframe": KEYFRAME, "to_keyframe": KEYFRAME, "pose": POSE, "sigma_m": SIGMA_M, "sigma_rad": SIGMA_RAD},
        "closure from keyframe {from_keyframe} to keyframe {to_keyframe} added",
        "A loop closure between two keyframes: `pose` is that of the second in the frame of the first. It has class "
        "`by_hand`, full weight and no loss. A warning says where all else contradicts it.",
    ),
    "remove_landmark": Action(
        {"landmark": LANDMARK},
        "landmark {landmark} deleted",
        "A landmark is deleted with all of its edges. If it is observed again, it begins anew.",
    ),
    "rename_landmark": Action(
        {"landmark": LANDMARK, "to": NAME},
        "landmark {landmark} renamed to {to}",
        "A landmark gets another name, which no other has. What is observed under the old name later begins another "
        "landmark.",
    ),
    "merge_landmarks": Action(
        {"landmark": LANDMARK, "into": LANDMARK},
        "landmark {landmark} merged into {into}",
        "Two landmarks are one. Observations of both identities are of `into` from then on.",
    ),
    "split_landmark": Action(
        {"landmark": LANDMARK, "to": NAME},
        "landmark {landmark} split: {chosen} of {to}",
        "Some of its sightings are of another landmark, with a name that no other has: those of `edges`, or those from "
        "keyframe `from` to keyframe `until`. Later observations are of the first.",
        ({"edges": EDGES}, _RANGE),
    ),
    "move_anchor": Action(
        {"keyframe": KEYFRAME, "pose": POSE, "sigma_m": EXACT_M, "sigma_rad": EXACT_RAD},
        "map moved: keyframe {keyframe} anchored",
        "The map is moved rigidly, so that a keyframe has this pose. It is anchored there, and nowhere else.",
    ),
    "move_map": Action(
        {"pose": POSE, "sigma_m": EXACT_M, "sigma_rad": EXACT_RAD},
        "map moved",
        "The map is moved rigidly: `pose` is where its origin was, in the axes that it gets. It stays anchored at the "
        "same keyframe.",
    ),
}
"""What can be done by hand, by the value of ``do``."""
ALL_FIELDS = {key: field for action in ACTIONS.values() for key, field in action.known.items()}
"""What each key holds."""


def read_arguments(do: str, values: Mapping[str, Any], common: tuple[str, ...]) -> dict[str, Argument]:
    """The arguments of an edit, as they are kept.

    Raises
    ------
    FormatError
        A key is unknown or missing, or its value is not what it has to be; the text names the key.
    """
    action, has = ACTIONS[do], ", ".join(common)
    has = f"{do} has {has}, {ACTIONS[do].keys_text}"
    for key in values:
        if key not in action.known and key not in common:
            raise FormatError(f"{shortened(key)}: unknown key; {has}")
    chosen = [several for several in action.either if any(key in values for key in several)]
    if action.either and len(chosen) != 1:
        raise FormatError(f"{' or '.join(map(', '.join, action.either))}: expected one of them; {has}")
    read: dict[str, Argument] = {}
    for key, field in {**action.fields, **(chosen[0] if chosen else {})}.items():
        if key not in values:
            raise FormatError(f"{key}: missing; {has}")
        try:
            read[key] = field.read(values[key])
        except ValueError:
            raise FormatError(f"{key}: {shortened(values[key])} is not {field.text}") from None
    for key in ("to", "into"):
        if key in read and read[key] == read["landmark"]:
            raise FormatError(f"{key}: {shortened(read[key])} is the landmark itself")
    return read
