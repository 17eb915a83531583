"""The table of what is wrong in a recording or a graph that faults were put into: what should have been doubted."""

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from graph_slam_ros.formats.g2o_writer import write_text


@dataclass(frozen=True, slots=True)
class WrongMessage:
    """A line of a recording's table: a message that is wrong, or one of its detections.

    Attributes
    ----------
    index : of the detection or point in its message; empty of odometry
    id : that it carries; of a closure, the earlier stamp
    true_id : the landmark that was seen
    """

    topic: str
    stamp_ns: int
    index: int | str
    id: str
    fault: str
    true_id: str


@dataclass(frozen=True, slots=True)
class WrongLine:
    """A line of a graph's table: an edge that is wrong.

    Attributes
    ----------
    line : of the file, from 1
    first, second : ids of its vertices, as in the file
    true_second : the landmark that was seen
    """

    line: int
    tag: str
    first: int
    second: int
    fault: str
    true_second: int | str


def write_table(path: Path | str, of: type, rows: Sequence[WrongMessage] | Sequence[WrongLine]) -> None:
    """Write a table as CSV, below the names of the fields. Raises FormatError."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(of))
    writer.writerows(astuple(row) for row in rows)
    write_text(path, text.getvalue())
