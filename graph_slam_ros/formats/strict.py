"""Strict reading of text: what Python's own conversions would let through is refused by name."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graph_slam_ros.errors import FormatError

# float() also accepts 1_0, inf, nan and digits of other scripts
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_ID = re.compile(r"[+-]?\d{1,18}", re.ASCII)


def lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file. Raises FormatError."""
    try:
        if not path.is_file():
            raise FormatError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
        with path.open(encoding="utf-8") as stream:
            yield from enumerate(stream, start=1)
    except UnicodeDecodeError:
        raise FormatError(f"{path.name}: not a text file") from None
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None


def expect(words: list[str], count: int) -> None:
    """Raise FormatError unless that many fields follow the tag."""
    if len(words) - 1 != count:
        raise FormatError(f"{words[0]} needs {count} fields after the tag, found {len(words) - 1}")


def integer(word: str) -> int:
    """An id. Raises FormatError."""
    if not _ID.fullmatch(word):
        raise FormatError(f"{word!r} is not an id")
    return int(word)


def numbers(words: list[str]) -> list[float]:
    """Finite numbers. Raises FormatError naming the first that is none."""
    for word in words:
        if not _NUMBER.fullmatch(word) or float(word) in (np.inf, -np.inf):
            raise FormatError(f"{word!r} is not a finite number")
    return [float(word) for word in words]
