"""Strict reading of text: refuses what Python's own conversions would accept by mistake."""

import gzip
import io
import itertools
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from reprlib import repr as shortened
from typing import Any

import numpy as np

from graph_slam_ros.errors import FormatError, similar_file
from graph_slam_ros.formats.files import opened

# float() also accepts 1_0, inf, nan and digits of other scripts. No part can match what the one before it gave back:
# time is linear in the length of a word.
_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+-]?\d+)?", re.ASCII)
MOST_DIGITS = 1100
"""Characters of a number; the longest double, written out, has 1,077 of them."""
MOST_LINE = 2**20
"""Characters of a line: a list of 100,000 ids fits."""
MOST_TEXT_RATIO = 100
"""Text of graphs is compressed 4 to 30 times; what grows beyond this is made to exhaust its reader."""
_FREE = 2**20  # characters that may be unpacked whatever the ratio
_ID = re.compile(r"[+-]?\d{1,20}", re.ASCII)  # GTSAM's keys have 64 bits
_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?", re.ASCII)

_FOREIGN = {
    b"SQLite format 3": "a database. RTAB-Map's exports its graph: rtabmap-databaseViewer, File, Export poses, g2o",
    b"22 serialization::archive": "a Boost archive, as slam_toolbox's .posegraph: no text of vertices and edges",
    b"\xff\xfe": "UTF-16: iconv -f utf-16 -t utf-8 makes UTF-8 of it",
    b"PK\3\4": "a zip archive: unzip it first",
    b"\x1f\x8b": "compressed: give it a name that ends in .gz (a .tar.gz: tar xf)",
    b"\x89MCAP": "a recording: graph_slam info prints how to replay it",
    b"#ROSBAG": "a recording: graph_slam info prints how to replay it",
}


def lines(path: Path, *, follow: bool = True) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file, gzipped where its name ends so; ``follow``: it may be a symbolic link.

    Raises FormatError.
    """
    try:
        with opened(path, follow=follow) as raw:
            most = max(_FREE, MOST_TEXT_RATIO * os.fstat(raw.fileno()).st_size) if is_gzipped(path) else None
            plain = gzip.GzipFile(fileobj=raw) if is_gzipped(path) else io.BufferedReader(raw)
            with io.TextIOWrapper(plain, encoding="utf-8-sig", newline="") as stream:  # a field may hold any line end
                yield from _bounded(stream, path, most)
    except (gzip.BadGzipFile, zlib.error, EOFError):
        raise FormatError(f"{path.name}: damaged, or not a gzip file") from None
    except UnicodeDecodeError:
        raise FormatError(f"{path.name}: not a text file{foreign(path)}") from None
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file{similar_file(path)}") from None
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None


def _bounded(stream: Any, path: Path, most: int | None) -> Iterator[tuple[int, str]]:
    """Numbered lines, none longer than ``MOST_LINE``, and no more than ``most`` characters together."""
    total = 0
    for number in itertools.count(1):
        line = stream.readline(MOST_LINE + 1)
        if not line:
            return
        if len(line) > MOST_LINE:
            raise FormatError(f"{path.name}:{number}: a line of more than {MOST_LINE} characters")
        total += len(line)
        if most is not None and total > most:
            raise FormatError(f"{path.name}: it unpacks to more than {MOST_TEXT_RATIO} times its size: not read")
        yield number, line


def foreign(path: Path) -> str:
    """Return what else a file is, and what mends that; empty where its first bytes do not tell."""
    with opened(path, follow=True) as raw:
        begins = b"" if is_gzipped(path) else raw.read(64)
    return next((f": {what}" for magic, what in _FOREIGN.items() if begins.startswith(magic)), "")


def is_gzipped(path: Path) -> bool:
    """Return whether the ending says so."""
    return path.suffix.lower() == ".gz"


def ending(path: Path) -> str:
    """Return what the file is without its compression: ``.g2o`` of ``a.g2o.gz``."""
    return (path.with_suffix("") if is_gzipped(path) else path).suffix.lower()


def expect(words: list[str], count: int) -> None:
    """Raise FormatError unless that many fields follow the tag."""
    if len(words) - 1 != count:
        raise FormatError(f"{words[0]} needs {count} fields after the tag, found {len(words) - 1}")


def integer(word: str) -> int:
    """An id. Raises FormatError."""
    if not _ID.fullmatch(word) or not -(2**63) <= int(word) < 2**64:
        raise FormatError(f"{shortened(word)} is not an id")
    return int(word)


def numbers(words: list[str]) -> list[float]:
    """Finite numbers; their exponents may be Fortran's (1.0D+00). Raises FormatError naming the first that is none."""
    found = list[float]()
    for word in words:
        is_number = len(word) <= MOST_DIGITS and _NUMBER.fullmatch(word)
        found.append(float(word.replace("D", "e").replace("d", "e")) if is_number else np.inf)
        if found[-1] in (np.inf, -np.inf):
            comma = ": a decimal comma; sed 's/,/./g' FILE > POINTS makes points of them" * bool(_COMMA.fullmatch(word))
            raise FormatError(f"{shortened(word)} is not a finite number{comma}")
    return found
