"""Edits of a map by hand: the fields of each kind, and the record of an edit that was applied."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from reprlib import repr as shortened
from typing import Any

from graph_slam_ros.errors import FormatError, did_you_mean
from graph_slam_ros.measurements.edit_actions import ACTIONS, Argument, read_arguments

COMMON = ("name", "who", "when", "why", "do")
_MOST = {"name": 80, "who": 200, "when": 100, "why": 2000}  # characters
_DAY, _CLOCK = r"\d{4}-(0[1-9]|1[0-2])-(0[1-9]|[12]\d|3[01])", r"([01]\d|2[0-3]):[0-5]\d(:[0-5]\d(\.\d{1,9})?)?"
_WHEN = re.compile(_DAY + "[T ]" + _CLOCK + r"(Z|[+-]\d\d:?\d\d)", re.ASCII)


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
        return {name: getattr(self, name) for name in COMMON} | dict(self.arguments)

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
    do = values.get("do")
    if not isinstance(do, str) or do not in ACTIONS:
        near = did_you_mean(do, ACTIONS) if isinstance(do, str) else ""
        raise FormatError(
            f"do: {shortened(do)} is none of {', '.join(ACTIONS)}{near}" if "do" in values else "do: missing"
        )
    for key in COMMON:
        if key not in values:
            raise FormatError(f"{key}: missing; {do} has {', '.join(COMMON)}, {ACTIONS[do].keys_text}")
    arguments = read_arguments(do, values, COMMON)
    for key, most in _MOST.items():
        _check_text(key, values[key], most)
    return Edit(**{key: values[key] for key in COMMON}, arguments=arguments)


def _check_text(key: str, value: Any, most: int) -> None:
    if not isinstance(value, str):
        raise FormatError(f"{key}: {shortened(value)} is not a text")
    if not value.strip():
        raise FormatError(f"{key}: empty")
    if len(value) > most:
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
