"""Edits of a map by hand: the fields of each kind, and the record of an edit that was applied."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from reprlib import repr as shortened
from typing import Any, TypeAlias

from graph_slam_ros.errors import FormatError

Value: TypeAlias = bool | int | float | str
ACTIONS: dict[str, dict[str, type]] = {
    "remove_edge": {"edge": int},
    "let_in_edge": {"edge": int},
    "remove_landmark": {"landmark": str},
    "rename_landmark": {"landmark": str, "to": str},
    "merge_landmarks": {"landmark": str, "into": str},
}
"""The arguments of each kind of edit (``do``), with their types."""
COMMON: dict[str, type] = {"name": str, "who": str, "when": str, "why": str, "do": str}
_MOST = {"name": 80, "who": 200, "why": 2000, "landmark": 10_000, "to": 128, "into": 10_000}  # characters
_DAY, _CLOCK = r"\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])", r"([01]\d|2[0-3]):[0-5]\d(:[0-5]\d(\.\d{1,9})?)?"
_WHEN = re.compile(_DAY + "[T ]" + _CLOCK + r"(Z|[+-]\d\d:?\d\d)", re.ASCII)


@dataclass(frozen=True, slots=True)
class Edit:
    """An edit of a map by hand.

    Attributes
    ----------
    name : by which it is undone; unique in a map
    who, when, why : the person, an ISO 8601 time with its zone, and the reason
    do : one of ``ACTIONS``
    arguments : of the action
    """

    name: str
    who: str
    when: str
    why: str
    do: str
    arguments: Mapping[str, Value]

    @property
    def values(self) -> dict[str, Value]:
        """All of it, flat, as in a plan and in a control event."""
        return {name: getattr(self, name) for name in COMMON} | dict(self.arguments)

    @property
    def text(self) -> str:
        """Return what the edit does, in words."""
        a = self.arguments
        return {
            "remove_edge": "edge {edge} taken out",
            "let_in_edge": "edge {edge} let in",
            "remove_landmark": "landmark {landmark} deleted",
            "rename_landmark": "landmark {landmark} renamed to {to}",
            "merge_landmarks": "landmark {landmark} merged into {into}",
        }[self.do].format(**a)


def edit_of(values: Any) -> Edit:
    """The edit of its flat values.

    Raises
    ------
    FormatError
        A key is unknown or missing, or a value is not of its type; the text names the key.
    """
    if not isinstance(values, Mapping):
        raise FormatError(f"{shortened(values)} is not an object with the keys of an edit")
    do = values.get("do")
    if not isinstance(do, str) or do not in ACTIONS:
        raise FormatError(f"do: {shortened(do)} is none of {', '.join(ACTIONS)}" if "do" in values else "do: missing")
    known = COMMON | ACTIONS[do]
    for key in values:
        if key not in known:
            raise FormatError(f"{shortened(key)}: unknown key; {do} has {', '.join(known)}")
    for key, kind in known.items():
        if key not in values:
            raise FormatError(f"{key}: missing; {do} has {', '.join(known)}")
        _check(key, kind, values[key])
    for key in ("to", "into"):
        if key in known and values[key] == values["landmark"]:
            raise FormatError(f"{key}: {shortened(values[key])} is the landmark itself")
    arguments = {key: values[key] for key in ACTIONS[do]}
    return Edit(**{key: values[key] for key in COMMON}, arguments=arguments)


def _check(key: str, kind: type, value: Any) -> None:
    if kind is int:
        if type(value) is not int or not 0 <= value < 2**63:
            raise FormatError(f"{key}: {shortened(value)} is not a whole number, 0 or more")
        return
    if not isinstance(value, str):
        raise FormatError(f"{key}: {shortened(value)} is not a text")
    if not value.strip():
        raise FormatError(f"{key}: empty")
    if len(value) > (most := _MOST.get(key, 100)):
        raise FormatError(f"{key}: {len(value)} characters, at most {most}")
    if key == "when" and not _WHEN.fullmatch(value):
        raise FormatError(f"when: {shortened(value)} is not a time with its zone, such as 2026-05-04T10:30:00Z")


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


def _ids(edges: tuple[int, ...]) -> str:
    shown = " ".join(map(str, edges[:5]))
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
            case "rename_landmark":
                out = {name: a["to"] if of == a["landmark"] else of for name, of in out.items() if name != a["to"]}
            case "remove_landmark":
                out = {name: of for name, of in out.items() if of != a["landmark"]}
    return out
