"""Landmarks whose place in the map is known before they are seen: from a survey, in the frame of a floor plan.

A survey is a table with a header. It has the position of each landmark with its noise and, where that was measured, its
orientation: of the landmark's axes in those of map, as a pose of ROS has it.
"""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

from graph_slam_ros.errors import ConfigError, NoiseError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Numbers

Columns = tuple[str, ...]
Matrix = tuple[Numbers, ...]  # row by row

_SPATIAL_COVARIANCE = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
_GROUPS: dict[str, tuple[tuple[Columns, ...], tuple[Columns, ...]]] = {  # what the plane has alone, then both
    "a position": ((("id", "x", "y"),), (("id", "x", "y", "z"),)),
    "the noise of the position": (
        (("sigma_x", "sigma_y"), ("cov_xx", "cov_xy", "cov_yy")),
        (("sigma",), ("sigma_x", "sigma_y", "sigma_z"), _SPATIAL_COVARIANCE),
    ),
    "an orientation": ((("yaw",),), (("roll", "pitch", "yaw"), ("qx", "qy", "qz", "qw"))),
    "the noise of the orientation": ((("sigma_yaw",),), (("sigma_rad",), ("sigma_roll", "sigma_pitch", "sigma_yaw"))),
}
_OPTIONAL = ("an orientation", "the noise of the orientation")
_KNOWN = {
    what: tuple(dict.fromkeys(key for one in (*both, *plane) for key in one)) for what, (plane, both) in _GROUPS.items()
}
_ANGLES = {"roll", "pitch", "yaw", "sigma_rad", "sigma_roll", "sigma_pitch", "sigma_yaw"}
_UNIT = 0.1  # a quaternion this far from unit length is normalised, as in messages
_FLAT = 0.5  # the horizontal part of an x axis that is too short to have a heading, as in messages


@dataclass(frozen=True, slots=True)
class Surveyed:
    """The surveyed pose of a landmark, and its covariance.

    Attributes
    ----------
    position : (n,) in map [m]
    covariance : rows of that of the position (n, n) or, with an orientation, of the pose (dof, dof); along and about
        the axes of map, m^2 and rad^2
    orientation : yaw in the plane, quaternion x, y, z, w in space; empty where it was not surveyed
    """

    position: Numbers
    covariance: Matrix
    orientation: Numbers = ()

    @property
    def pose(self) -> Numbers:
        """Pose in map of a landmark with a surveyed orientation."""
        return *self.position, *self.orientation

    @property
    def position_covariance(self) -> Matrix:
        """Rows of the covariance of the position (n, n)."""
        n = len(self.position)
        return tuple(row[:n] for row in self.covariance[:n])


def surveyed(text: str, dimensions: int) -> dict[str, Surveyed]:
    """Landmarks by id, from lines of comma-separated values below a header.

    In the plane z is left out, and of an orientation everything but the heading of the x axis, as for a sighting.

    Raises
    ------
    ConfigError
        Naming the line, the column and what is wrong with it.
    """
    out: dict[str, Surveyed] = {}
    table: _Table | None = None
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if table is None:
                table = _Table(cells, dimensions)
                continue
            name, known = table.landmark(cells)
            if name in out:
                raise ConfigError(f"{name!r} is given twice")
            out[name] = known
    except (ConfigError, csv.Error) as error:
        raise ConfigError(f"line {rows.line_num}: {error}") from None
    if text.strip() and not out:
        raise ConfigError("a header and no landmark")
    return out


class _Table:
    """The header of a table: its columns, and those that have the noise and the orientation."""

    def __init__(self, header: Sequence[str], dimensions: int) -> None:
        self._header, self._dimensions = header, dimensions
        for key in header:
            if not any(key in known for known in _KNOWN.values()):
                known = ",".join(key for keys in _KNOWN.values() for key in keys)
                raise ConfigError(f"column {key!r} is not known: expected a header with some of {known}")
            if header.count(key) > 1:
                raise ConfigError(f"column {key!r} is given twice")
        is_turned = any(key in _KNOWN[what] for what in _OPTIONAL for key in header)
        _, self._noise, self._turn, self._turn_noise = (
            self._chosen(what) if is_turned or what not in _OPTIONAL else () for what in _GROUPS
        )

    def _chosen(self, what: str) -> Columns:
        plane, both = _GROUPS[what]
        allowed = both if self._dimensions == 3 else plane + both
        given = [key for key in self._header if key in _KNOWN[what]]
        for one in allowed:
            if set(given) == set(one):
                return one
        expected = " or ".join(",".join(one) for one in sorted(allowed, key=len))
        raise ConfigError(f"columns of {what}: {','.join(given) or 'none'}, expected {expected}")

    def landmark(self, cells: Sequence[str]) -> tuple[str, Surveyed]:
        """The landmark of a line, and its id."""
        if len(cells) != len(self._header):
            raise ConfigError(f"{len(cells)} values, not {','.join(self._header)}")
        row = dict(zip(self._header, cells, strict=True))
        name = row.pop("id")
        if not name:
            raise ConfigError("the id is empty")
        turn_columns = (*self._turn, *self._turn_noise)
        is_turned = any(row[key] for key in turn_columns)
        numbers = {key: _number(key, cell) for key, cell in row.items() if is_turned or key not in turn_columns}
        n, axes = self._dimensions, "xyz"[: self._dimensions]
        position = tuple(numbers[axis] for axis in axes)
        if self._noise[0] == "cov_xx":
            covariance = [[numbers["cov_" + min(a, b) + max(a, b)] for b in axes] for a in axes]
        else:
            covariance = _diagonal([numbers[key] for key in (self._noise * n)[:n]])
        place = _checked(covariance, self._noise)
        if not is_turned:
            return name, Surveyed(position, place)
        sigmas = [numbers[key] for key in (self._turn_noise * 3)[-3 if n == 3 else -1 :]]
        angles = _checked(_diagonal(sigmas), self._turn_noise)
        whole = *((*one, *[0.0] * len(angles)) for one in place), *((*[0.0] * n, *one) for one in angles)
        return name, Surveyed(position, whole, _orientation([numbers[key] for key in self._turn], self._turn, n))


def _diagonal(sigmas: Sequence[float]) -> list[list[float]]:
    return [[one * one if j == k else 0.0 for j in range(len(sigmas))] for k, one in enumerate(sigmas)]


def _checked(covariance: list[list[float]], columns: Columns) -> Matrix:
    try:
        Gaussian.from_covariance(covariance)
    except NoiseError:
        rows = "; ".join(" ".join(f"{x:g}" for x in row) for row in covariance)
        raise ConfigError(f"{','.join(columns)}: [{rows}] is no positive definite covariance") from None
    return tuple(map(tuple, covariance))


def _orientation(given: Sequence[float], columns: Columns, dimensions: int) -> Numbers:
    if columns == ("yaw",):
        return tuple(given)
    if columns[0] == "qx":
        length = math.hypot(*given)
        if abs(length - 1.0) > _UNIT:
            raise ConfigError(f"{','.join(columns)}: a quaternion of length {length:.3g}, expected 1")
        q = given[0] / length, given[1] / length, given[2] / length, given[3] / length
    else:
        q = se3.rotation(se3.from_xyz_rpy((0.0, 0.0, 0.0, *given)))
    if dimensions == 3:
        return q
    x, y, _ = so3.act(q, (1.0, 0.0, 0.0))
    if math.hypot(x, y) < _FLAT:
        raise ConfigError(f"{','.join(columns)}: the x axis of the landmark is upright: it has no heading in the plane")
    return (math.atan2(y, x),)


def _number(key: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in cell:
        raise ConfigError(f"{key} {cell!r} is not a finite number")
    if key.startswith("sigma") and value <= 0.0:
        raise ConfigError(f"{key} {cell} is not above 0: nothing is certain")
    if key in _ANGLES and abs(value) > 2.0 * math.pi:
        raise ConfigError(f"{key} {cell} is more than a turn: expected radians")
    return value
