"""Landmarks whose place in the map is known before they are seen: from a survey, in the frame of a floor plan."""

import csv
import io
import math
from dataclasses import dataclass

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.typing import Numbers

_HEADERS = (["id", "x", "y", "sigma"], ["id", "x", "y", "z", "sigma"])


@dataclass(frozen=True, slots=True)
class Surveyed:
    """The surveyed position of a landmark, and how well that is known: standard deviation along each axis."""

    position: Numbers
    sigma_m: float


def surveyed(text: str, dimensions: int) -> dict[str, Surveyed]:
    """Landmarks by identity, of lines of comma-separated values below a header; in the plane z is left out.

    Raises
    ------
    ConfigError
        Naming the line and what is wrong with it.
    """
    out: dict[str, Surveyed] = {}
    header: list[str] = []
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if not header:
                header = _header(cells, dimensions)
                continue
            name, numbers = _landmark(cells, header)
            if name in out:
                raise ConfigError(f"{name!r} is given twice")
            out[name] = Surveyed(numbers[:dimensions], numbers[-1])
    except (ConfigError, csv.Error) as error:
        raise ConfigError(f"line {rows.line_num}: {error}") from None
    if text.strip() and not out:
        raise ConfigError("a header and no landmark")
    return out


def _header(cells: list[str], dimensions: int) -> list[str]:
    allowed = _HEADERS[dimensions - 2 :]
    if cells not in allowed:
        raise ConfigError(f"the header is {','.join(cells)!r}, not {' or '.join(map(','.join, allowed))}")
    return cells


def _landmark(cells: list[str], header: list[str]) -> tuple[str, Numbers]:
    if len(cells) != len(header):
        raise ConfigError(f"{len(cells)} values, not {','.join(header)}")
    if not cells[0]:
        raise ConfigError("the id is empty")
    numbers = [_number(key, cell) for key, cell in zip(header[1:], cells[1:], strict=True)]
    if numbers[-1] <= 0.0:
        raise ConfigError(f"sigma {cells[-1]} is not above 0: nothing is certain")
    return cells[0], tuple(numbers)


def _number(key: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in cell:
        raise ConfigError(f"{key} {cell!r} is not a finite number")
    return value
