"""The one family of errors that a user may see: each message names the culprit and fits on one line.

Where a name is close to a known one, it asks for that.
"""

import difflib
import os
import re
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

_CLOSE = 0.6  # of the letters, in order
_MOST = 10_000  # names that are compared


class GraphSlamError(Exception):
    """Something was refused: a file, a parameter, a topic, a graph. The command line turns it into exit code 2."""


class NoiseError(GraphSlamError):
    """A covariance or information matrix that is not symmetric positive definite."""


class GaugeError(GraphSlamError):
    """Nothing fixes the position of a part of the graph."""


class SingularError(GraphSlamError):
    """The edges do not determine a vertex.

    Attributes
    ----------
    vertex : which; None where it has no number
    """

    def __init__(self, message: str, vertex: int | None = None) -> None:
        super().__init__(message)
        self.vertex = vertex


class DivergedError(GraphSlamError):
    """A solve whose result is not finite, or cannot be."""


class FormatError(GraphSlamError):
    """A file that cannot be read as what it claims to be."""


class ConfigError(GraphSlamError):
    """A configuration key, value or combination that is not valid."""


def message_of(error: BaseException) -> str:
    """An exception in one line: one of ours says enough by itself."""
    return str(error) if isinstance(error, GraphSlamError) else f"{type(error).__name__}: {error}"


def nearest(name: str, known: Iterable[str]) -> str:
    """Return the known name that is most like another: by its letters, else by the words that both have."""
    names = list(known)
    if near := difflib.get_close_matches(name, names, 1, 0.8):
        return near[0]

    def words(text: str) -> set[str]:
        return {word.removesuffix("s") for word in re.split(r"[._]", text.lower())}

    def likeness(one: str) -> tuple[int, float]:
        return len(words(one) & words(name)), difflib.SequenceMatcher(None, one, name).ratio()

    return max(names, key=likeness)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of an error that asks for the known name that is close to another; empty where none is."""
    by_letters = {one.lower(): one for one in islice(known, _MOST)}
    near = difflib.get_close_matches(name.lower(), by_letters, 1, _CLOSE)
    return f"; did you mean {by_letters[near[0]]!r}?" if near else ""


def similar_file(path: Path) -> str:
    """Return the same for a file or folder that is not there, by what is in its folder; empty where it is there."""
    if os.path.lexists(path):
        return ""
    try:
        return did_you_mean(path.name, (one.name for one in path.parent.iterdir()))
    except OSError:  # there is no such folder either
        return ""
