"""Edits of a map by hand: the kinds of edits, the keys of each, and the record of an edit that was applied.

The table of kinds is the only one. Plans, ``graph_slam map edit --help``, docs/edits.md and the page are made from it.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from reprlib import repr as shortened
from typing import Any, TypeAlias

from graph_slam_ros.errors import FormatError, did_you_mean

Argument: TypeAlias = bool | int | float | str | tuple[int, ...] | tuple[float, ...]
_MOST_EDGES = 1_000_000
_FARTHEST = 1e9  # m, s
_STAMP = re.compile(r"\d{1,10}(\.\d{1,9})?", re.ASCII)
_DAY, _CLOCK = r"\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])", r"([01]\d|2[0-3]):[0-5]\d(:[0-5]\d(\.\d{1,9})?)?"
_WHEN = re.compile(_DAY + "[T ]" + _CLOCK + r"(Z|[+-]\d\d:?\d\d)", re.ASCII)
_UNIT = 1e-3  # so far from 1 the length of a quaternion may be


@dataclass(frozen=True, slots=True)
class Field:
    """The value of a key of an edit.

    Attributes
    ----------
    kind : by which a page chooses what to ask for
    text : what is expected, in words
    is_valid : whether a value from JSON is that
    kept : a valid value as it is kept
    """

    kind: str
    text: str
    is_valid: Callable[[Any], bool]
    kept: Callable[[Any], Argument] = lambda value: value


@dataclass(frozen=True, slots=True)
class Action:
    """A kind of edit.

    Attributes
    ----------
    fields : the keys that it needs
    done : what it did, in words, of its keys
    help : what it does, for a table
    either : sets of keys of which it needs exactly one; empty: there are none
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


def _is_whole(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _are_ids(value: Any) -> bool:
    is_list = isinstance(value, list | tuple) and 0 < len(value) <= _MOST_EDGES
    return is_list and all(map(_is_whole, value)) and len(set(value)) == len(value)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and -_FARTHEST <= value <= _FARTHEST


def _is_not_negative(value: Any) -> bool:
    return _is_number(value) and value >= 0


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_time(value: Any) -> bool:
    return isinstance(value, str) and bool(_WHEN.fullmatch(value))


def _is_pose(value: Any) -> bool:
    is_list = isinstance(value, list | tuple) and len(value) in (3, 7) and all(map(_is_number, value))
    return is_list and (len(value) == 3 or abs(math.hypot(*value[3:]) - 1.0) <= _UNIT)


def _text(kind: str, what: str, most: int) -> Field:
    def is_valid(value: Any) -> bool:
        return isinstance(value, str) and 0 < len(value) <= most and not value.isspace()

    return Field(kind, f"{what} of up to {most} characters", is_valid)


_EDGE = Field("edge", "the id of an edge: a whole number, 0 or more", _is_whole)
_EDGES = Field("edges", "a list of ids of edges, each once", _are_ids, tuple)
_LANDMARK = _text("landmark", "the name of a landmark: a text", 10_000)
_NAME = _text("name", "a text", 128)
_KEYFRAME = Field(
    "keyframe",
    'the number of a keyframe, or a stamp [s] as a text: 17 or "1700000000.5"',
    lambda value: _is_whole(value) or (isinstance(value, str) and _STAMP.fullmatch(value) is not None),
)
_POSE = Field(
    "pose",
    "a pose: [x, y, theta], or in space [x, y, z, qx, qy, qz, qw], the last four of length 1",
    _is_pose,
    lambda value: tuple(map(float, value)),
)
_SIGMAS = {
    "sigma_m": Field("sigma_m", "a standard deviation in metres, above 0", _is_positive, float),
    "sigma_rad": Field("sigma_rad", "a standard deviation in radians, above 0", _is_positive, float),
}
_EXACT = {
    "sigma_m": Field("exact_m", "a standard deviation in metres; 0: exact (1 mm)", _is_not_negative, float),
    "sigma_rad": Field("exact_rad", "a standard deviation in radians; 0: exact (0.001 rad)", _is_not_negative, float),
}

ACTIONS: dict[str, Action] = {
    "remove_edge": Action(
        {"edge": _EDGE},
        "edge {edge} taken out",
        "A closure, fix or sighting is taken out. A landmark goes with the last edge that determines it.",
    ),
    "let_in_edge": Action(
        {"edge": _EDGE},
        "edge {edge} let in",
        "An edge is in with its full weight and without a loss. A new edge of class `by_hand` replaces it.",
    ),
    "add_closure": Action(
        {"from_keyframe": _KEYFRAME, "to_keyframe": _KEYFRAME, "pose": _POSE, **_SIGMAS},
        "closure from keyframe {from_keyframe} to keyframe {to_keyframe} added",
        "A loop closure between two keyframes: `pose` is that of the second in the frame of the first. It has class "
        "`by_hand`, full weight and no loss. A warning says where all else contradicts it.",
    ),
    "remove_landmark": Action(
        {"landmark": _LANDMARK},
        "landmark {landmark} deleted",
        "A landmark is deleted with all of its edges. If it is observed again, it begins anew.",
    ),
    "rename_landmark": Action(
        {"landmark": _LANDMARK, "to": _NAME},
        "landmark {landmark} renamed to {to}",
        "A landmark gets another name, which no other has. What is observed under the old name later begins another "
        "landmark.",
    ),
    "merge_landmarks": Action(
        {"landmark": _LANDMARK, "into": _LANDMARK},
        "landmark {landmark} merged into {into}",
        "Two landmarks are one. Observations of both identities are of `into` from then on.",
    ),
    "split_landmark": Action(
        {"landmark": _LANDMARK, "to": _NAME},
        "landmark {landmark} split: {chosen} of {to}",
        "Some of its sightings are of another landmark, with a name that no other has: those of `edges`, or those from "
        "keyframe `from` to keyframe `until`. Later observations are of the first.",
        ({"edges": _EDGES}, {"from": _KEYFRAME, "until": _KEYFRAME}),
    ),
    "move_anchor": Action(
        {"keyframe": _KEYFRAME, "pose": _POSE, **_EXACT},
        "map moved: keyframe {keyframe} anchored",
        "The map is moved rigidly, so that a keyframe has this pose. It is anchored there, and nowhere else.",
    ),
    "move_map": Action(
        {"pose": _POSE, **_EXACT},
        "map moved",
        "The map is moved rigidly: `pose` is where its origin was, in the axes that it gets. It stays anchored at the "
        "same keyframe.",
    ),
}
"""What can be done by hand, by the value of ``do``."""
_COMMON = {
    "name": _text("name", "a text", 80),
    "who": _text("who", "a text", 200),
    "when": Field("when", "a time with its zone, such as 2026-05-04T10:30:00Z", _is_time),
    "why": _text("why", "a text", 2000),
}


@dataclass(frozen=True, slots=True)
class Edit:
    """An edit of a map by hand.

    Attributes
    ----------
    name : unique in a map
    who, when, why : the person, an ISO 8601 time with its zone, and the reason
    do : one of ``ACTIONS``
    arguments : of the action
    """

    name: str
    who: str
    when: str
    why: str
    do: str
    arguments: Mapping[str, Argument]

    @property
    def values(self) -> dict[str, Argument]:
        """All of it, flat, as in a plan."""
        return {name: getattr(self, name) for name in (*_COMMON, "do")} | dict(self.arguments)

    @property
    def text(self) -> str:
        """Return what the edit does, in words."""
        a = {key: _ids(value) if isinstance(value, tuple) else value for key, value in self.arguments.items()}
        if "edges" in a:
            a["chosen"] = f"edges {a['edges']}"
        elif "from" in a:
            a["chosen"] = f"its sightings from keyframe {a['from']} until {a['until']}"
        return ACTIONS[self.do].done.format(**a)


def edit_of(values: Any) -> Edit:
    """The edit of its flat values.

    Raises
    ------
    FormatError
        A key is unknown or missing, or a value is not of its type; the text names the key.
    """
    if not isinstance(values, Mapping):
        raise FormatError(f"{shortened(values)} is not an object with the keys of an edit")
    if "do" not in values:
        raise FormatError("do: missing")
    do = values["do"]
    if not isinstance(do, str) or do not in ACTIONS:
        near = did_you_mean(do, ACTIONS) if isinstance(do, str) else ""
        raise FormatError(f"do: {shortened(do)} is none of {', '.join(ACTIONS)}{near}")
    action = ACTIONS[do]
    has = f"{do} has {', '.join(_COMMON)}, do, {action.keys_text}"
    for key in values:
        if key not in action.known and key not in _COMMON and key != "do":
            raise FormatError(f"{shortened(key)}: unknown key; {has}")
    chosen = [several for several in action.either if not several.keys().isdisjoint(values)]
    if action.either and len(chosen) != 1:
        raise FormatError(f"{' or '.join(map(', '.join, action.either))}: expected one of them; {has}")
    fields = {**_COMMON, **action.fields, **(chosen[0] if chosen else {})}
    read: dict[str, Any] = {}
    for key, field in fields.items():
        if key not in values:
            raise FormatError(f"{key}: missing; {has}")
        if not field.is_valid(values[key]):
            raise FormatError(f"{key}: {shortened(values[key])} is not {field.text}")
        read[key] = field.kept(values[key])
    for key in ("to", "into"):
        if key in read and read[key] == read["landmark"]:
            raise FormatError(f"{key}: {shortened(read[key])} is the landmark itself")
    return Edit(**{key: read.pop(key) for key in _COMMON}, do=do, arguments=read)


@dataclass(frozen=True, slots=True)
class AppliedEdit:
    """An edit that was applied to a map.

    Attributes
    ----------
    keyframe : the number of the newest keyframe then
    edges : ids of the edges that it took out
    added : ids of the edges that it added
    """

    edit: Edit
    keyframe: int
    edges: tuple[int, ...]
    added: tuple[int, ...]

    @property
    def text(self) -> str:
        """Return what the edit did, by whom, when and why."""
        e = self.edit
        added = f", as edge{'s' * (len(self.added) > 1)} {_ids(self.added)}" if self.added else ""
        return f"{e.text}{added}, by {e.who}, {e.when}: {e.why} (edit {e.name})"

    @property
    def record(self) -> list[Any]:
        """The record in ``map.mcap``."""
        return [self.edit.values, self.keyframe, list(self.edges), list(self.added)]


def applied_edit(record: Any) -> AppliedEdit:
    """Inverse of ``AppliedEdit.record``. Raises FormatError."""
    values, keyframe, edges, added = record
    if not all(type(one) is int and one >= 0 for one in (keyframe, *edges, *added)):
        raise FormatError("an edit: its keyframe and edges are not whole numbers")
    return AppliedEdit(edit_of(values), keyframe, tuple(edges), tuple(added))


def _ids(edges: tuple[float, ...]) -> str:
    shown = " ".join(f"{edge:g}" if isinstance(edge, float) else str(edge) for edge in edges[:5])
    return shown if len(edges) <= 5 else f"{shown} and {len(edges) - 5} more"


def aliases(edits: list[AppliedEdit]) -> dict[str, str]:
    """The landmark that each identity is of, where edits have merged landmarks."""
    out: dict[str, str] = {}
    for one in edits:
        a = {name: str(value) for name, value in one.edit.arguments.items()}
        match one.edit.do:
            case "merge_landmarks":
                out = {name: a["into"] if of == a["landmark"] else of for name, of in out.items()}
                out[a["landmark"]] = a["into"]
            case "split_landmark":
                out.pop(a["to"], None)
            case "rename_landmark":
                out = {name: a["to"] if of == a["landmark"] else of for name, of in out.items() if name != a["to"]}
            case "remove_landmark":
                out = {name: of for name, of in out.items() if of != a["landmark"]}
    return out
