"""Landmarks whose place in the map is known before they are seen: from a survey, in the frame of a floor plan.

A survey is a table with a header. It has the position of each landmark with its noise and, where that was measured, its
orientation: of the landmark's axes in those of map, as a pose of ROS has it.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from graph_slam_ros.errors import ConfigError, NoiseError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.typing import Numbers

Columns = tuple[str, ...]
Matrix = tuple[Numbers, ...]  # row by row

_PLACE: tuple[Columns, ...] = (("id", "x", "y"), ("id", "x", "y", "z"))
_PLACE_NOISE: tuple[Columns, ...] = (
    *(("sigma_x", "sigma_y"), ("cov_xx", "cov_xy", "cov_yy")),  # these and yaw are for the plane alone
    *(("sigma",), ("sigma_x", "sigma_y", "sigma_z")),
    ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"),
)
_TURN: tuple[Columns, ...] = (("yaw",), ("roll", "pitch", "yaw"), ("qx", "qy", "qz", "qw"))
_TURN_NOISE: tuple[Columns, ...] = (("sigma_yaw",), ("sigma_rad",), ("sigma_roll", "sigma_pitch", "sigma_yaw"))
_GROUPS = (_PLACE, _PLACE_NOISE, _TURN, _TURN_NOISE)
_KNOWN = (
    *("id", "x", "y", "z", "sigma", "sigma_x", "sigma_y", "sigma_z"),
    *("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz", "roll", "pitch", "yaw", "qx", "qy", "qz", "qw"),
    *("sigma_rad", "sigma_roll", "sigma_pitch", "sigma_yaw"),
)
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


class _Layout(NamedTuple):
    """The columns of a table, in order, and those that have the noise and the orientation."""

    header: Columns
    place_noise: Columns
    turn: Columns
    turn_noise: Columns


def surveyed(text: str, dimensions: int) -> dict[str, Surveyed]:
    """Landmarks by id, from lines of comma-separated values below a header.

    In the plane z is left out, and of an orientation everything but the heading of the x axis, as for a sighting.

    Raises
    ------
    ConfigError
        Naming the line, the column and what is wrong with it.
    """
    out: dict[str, Surveyed] = {}
    layout: _Layout | None = None
    rows = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells):
                continue
            if layout is None:
                layout = _layout(cells, dimensions)
                continue
            name, known = _landmark(cells, layout, dimensions)
            if name in out:
                raise ConfigError(f"{name!r} is given twice")
            out[name] = known
    except (ConfigError, csv.Error) as error:
        raise ConfigError(f"line {rows.line_num}: {error}") from None
    if text.strip() and not out:
        raise ConfigError("a header and no landmark")
    return out


# -- the header ----------------------------------------------------------------------------------------------------


def _layout(cells: Sequence[str], dimensions: int) -> _Layout:
    for key in cells:
        if key not in _KNOWN:
            raise ConfigError(f"column {key!r} is not known: expected a header with some of {','.join(_KNOWN)}")
        if cells.count(key) > 1:
            raise ConfigError(f"column {key!r} is given twice")
    in_space = dimensions == 3
    _chosen("a position", cells, _PLACE[in_space:])
    noise = _chosen("the noise of the position", cells, _PLACE_NOISE[2 * in_space :])
    turns, turn_noises = _TURN[in_space:], _TURN_NOISE[in_space:]
    turn: Columns = ()
    turn_noise: Columns = ()
    if not {key for one in (*_TURN, *_TURN_NOISE) for key in one}.isdisjoint(cells):
        turn = _chosen("an orientation", cells, turns)
        turn_noise = _chosen("the noise of the orientation", cells, turn_noises)
    return _Layout(tuple(cells), noise, turn, turn_noise)


def _chosen(what: str, cells: Sequence[str], allowed: Sequence[Columns]) -> Columns:
    """The alternative that a header has."""
    group = next(group for group in _GROUPS if allowed[-1] in group)
    present = {key for one in group for key in one}.intersection(cells)
    for one in allowed:
        if present == set(one):
            return one
    given = ",".join(key for key in cells if key in present)
    expected = " or ".join(",".join(one) for one in sorted(allowed, key=len))
    raise ConfigError(f"columns of {what}: {given or 'none'}, expected {expected}")


# -- a line ----------------------------------------------------------------------------------------------------


def _landmark(cells: Sequence[str], layout: _Layout, dimensions: int) -> tuple[str, Surveyed]:
    if len(cells) != len(layout.header):
        raise ConfigError(f"{len(cells)} values, not {','.join(layout.header)}")
    row = dict(zip(layout.header, cells, strict=True))
    name = row.pop("id")
    if not name:
        raise ConfigError("the id is empty")
    turn_columns = (*layout.turn, *layout.turn_noise)
    is_turned = any(row[key] for key in turn_columns)
    numbers = {key: _number(key, cell) for key, cell in row.items() if is_turned or key not in turn_columns}
    position = tuple(numbers[key] for key in "xyz"[:dimensions])
    covariance = _position_covariance(numbers, layout.place_noise, dimensions)
    if not is_turned:
        return name, Surveyed(position, covariance)
    angles = _angles_covariance(numbers, layout.turn_noise, dimensions)
    whole = *((*row, *[0.0] * len(angles)) for row in covariance), *((*[0.0] * dimensions, *row) for row in angles)
    return name, Surveyed(position, whole, _orientation(numbers, layout.turn, dimensions))


def _position_covariance(numbers: Mapping[str, float], columns: Columns, dimensions: int) -> Matrix:
    axes = "xyz"[:dimensions]
    if columns[0] == "cov_xx":
        out = tuple(tuple(numbers["cov_" + min(a, b) + max(a, b)] for b in axes) for a in axes)
        return _checked(out, columns)
    return _diagonal(numbers, columns * dimensions if columns == ("sigma",) else columns[:dimensions], columns)


def _angles_covariance(numbers: Mapping[str, float], columns: Columns, dimensions: int) -> Matrix:
    """Covariance about the axes of map: of the heading (1, 1) in the plane, (3, 3) in space."""
    keys = columns * 3 if columns == ("sigma_rad",) else columns
    return _diagonal(numbers, keys if dimensions == 3 else keys[-1:], columns)


def _diagonal(numbers: Mapping[str, float], keys: Columns, columns: Columns) -> Matrix:
    variances = [numbers[key] * numbers[key] for key in keys]
    return _checked(
        tuple(tuple(v if j == k else 0.0 for j in range(len(keys))) for k, v in enumerate(variances)), columns
    )


def _checked(covariance: Matrix, columns: Columns) -> Matrix:
    try:
        Gaussian.from_covariance(covariance)
    except NoiseError:
        rows = "; ".join(" ".join(f"{x:g}" for x in row) for row in covariance)
        raise ConfigError(f"{','.join(columns)}: [{rows}] is no positive definite covariance") from None
    return covariance


def _orientation(numbers: Mapping[str, float], columns: Columns, dimensions: int) -> Numbers:
    if columns == ("yaw",):
        return (numbers["yaw"],)
    given = [numbers[key] for key in columns]
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
