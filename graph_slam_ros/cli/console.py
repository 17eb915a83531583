"""Shared by the commands: exit codes, output, and the check whether ROS is installed."""

import importlib.util
import os
import re
import shlex
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.files import is_regular

# Control characters, and those that change the direction of a text or are not seen.
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]")
_MAX_CHARACTERS, _MAX_LINES = 200, 20  # characters of a line on standard error; lines of losses
SENTENCE = 1000  # characters of what falls short: reason, meaning and the settings that mend it
_LEAST_WORD = 40  # characters that a word keeps when it is shortened: the name of a file, and a part of its folder
_GAP = "..."
DONE, FAULT, REFUSED, LOSSES, INTERRUPTED = 0, 1, 2, 3, 130
NOT_CERTIFIED, NOT_APPLICABLE = 4, 5  # of optimize --certify
DIFFERENT = 4  # of map diff
FOUND = 4  # of check


def escaped(text: str) -> str:
    r"""A text of one line that a terminal shows as it is: control characters as Python writes them (``\x1b``)."""
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)


def show(*lines: str) -> None:
    """Print the answer of a command to standard output.

    Each argument is one line. Control characters in it, line ends included, are escaped, because its names may come
    from a file or a message.
    """
    for line in lines:
        print(escaped(line))


def then(what: str) -> None:
    """The last line of an answer: what to do next."""
    show(f"next: {what}")


def command(*words: object) -> str:
    """A command line of ``graph_slam`` as a person types it."""
    return shlex.join(["graph_slam", *map(str, words)])


def check_file(*paths: Path | None, force: bool, source: Path | None = None) -> None:
    """Refuse to replace a file, before anything is computed.

    Raises GraphSlamError: a file exists and is not to be replaced, what has its name is not a regular file, or it is
    the source that is about to be read.
    """
    for path in paths:
        if path is not None and os.path.lexists(path):
            if source is not None and path.exists() and source.exists() and path.samefile(source):
                raise GraphSlamError(f"{path}: cannot be read from and written to at once")
            if not is_regular(path):
                raise GraphSlamError(f"{path}: not a regular file, and so not replaced: choose another name")
            if not force:
                raise GraphSlamError(f"{path}: exists already: choose another name, or --force replaces it")


def warn(what: str, programme: str = "graph_slam", most: int = _MAX_CHARACTERS) -> None:
    """Print a line on standard error, with control characters escaped.

    Parameters
    ----------
    most : characters of the line; of a longer one the beginning is kept (the culprit) and the end (the remedy)
    """
    print(shortened(escaped(f"{programme}: {what}"), most), file=sys.stderr)


def shortened(line: str, most: int) -> str:
    """A line of limited length. The longest words, such as paths, lose their middle first."""
    for word in sorted(set(line.split(" ")), key=len, reverse=True)[:4]:
        excess = len(line) - most
        if excess > 0 and len(word) > _LEAST_WORD:
            line = line.replace(word, _without_middle(word, max(_LEAST_WORD, len(word) - excess)), 1)
    return _without_middle(line, most)


def _without_middle(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    end = (most - len(_GAP)) // 2
    return text[: most - len(_GAP) - end] + _GAP + text[len(text) - end :]


class Throttled:
    """Prints the progress of something: at once, and then every few seconds."""

    def __init__(self, period_s: float = 5.0) -> None:
        self._period_s, self._due_s = period_s, 0.0

    def __call__(self, message: str) -> None:
        """Print it if it is time."""
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + self._period_s
            warn(message)


def report_losses(losses: Sequence[str], warnings: Sequence[str] = ()) -> int:
    """Print what was lost, and warnings; returns the exit code."""
    for warning in warnings:
        warn(f"beware: {warning}", most=SENTENCE)
    distinct = list(dict.fromkeys(losses))
    for loss in distinct[:_MAX_LINES]:
        warn(f"lost: {loss}")
    if len(distinct) > _MAX_LINES:
        warn(f"lost: and {len(distinct) - _MAX_LINES} more of this kind")
    return LOSSES if losses else DONE


def progress(label: str, unit: str = "msg") -> Any:
    """Wrap an iterable in a progress bar on standard error, if that is a terminal."""
    from tqdm import tqdm

    def bar(items: Iterable[Any], total: int) -> Iterable[Any]:
        quiet = None if os.environ.get("GRAPH_SLAM_PROGRESS") is None else False
        return tqdm(items, desc=label, total=total or None, unit=unit, leave=False, disable=quiet, file=sys.stderr)

    return bar


def has_ros() -> bool:
    """Return whether the node and the player can run."""
    names = ("rclpy", "tf2_msgs", "vision_msgs")
    return all(getattr(importlib.util.find_spec(name), "origin", None) for name in names)
