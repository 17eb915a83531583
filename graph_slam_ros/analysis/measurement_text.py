"""The numbers of a measurement as text: their names and units, and what was expected instead."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.runs.ledger_file import Entry

_DEGREES = 180.0 / math.pi
_LEAST = 1e-12  # of the largest eigenvalue: less is no information
_XY, _XYZ = ("x m", "y m"), ("x m", "y m", "z m")
_POSE, _POSE_3D = (*_XY, "heading rad"), (*_XYZ, "turn x rad", "turn y rad", "turn z rad")
_NAMES = {
    "EDGE_SE2": _POSE,
    "EDGE_PRIOR_SE2": _POSE,
    "EDGE_SE3:QUAT": _POSE_3D,
    "EDGE_SE3_PRIOR": _POSE_3D,
    "EDGE_ATTITUDE_SE3": _POSE_3D[3:],
    "EDGE_HEADING_SE2": _POSE[2:],
    "EDGE_HEADING_SE3": _POSE[2:],
    "EDGE_COORDINATE_SE2": ("coordinate m",),
    "EDGE_COORDINATE_SE3": ("coordinate m",),
    "EDGE_RANGE_SE2_XY": ("range m",),
    "EDGE_RANGE_SE3_XYZ": ("range m",),
    "EDGE_RANGE_OFFSET_SE2_XY": ("range m",),
    "EDGE_RANGE_OFFSET_SE3_XYZ": ("range m",),
    "EDGE_PRIOR_OFFSET": ("offset m",),
    "EDGE_BEARING_SE2_XY": ("bearing rad",),
    "EDGE_RANGE_BEARING_SE2_XY": ("range m", "bearing rad"),
    "EDGE_BEARING_SE3_XYZ": ("azimuth rad", "elevation rad"),
    "EDGE_RANGE_BEARING_SE3_XYZ": ("range m", "azimuth rad", "elevation rad"),
}


def units(tag: str, count: int) -> list[tuple[str, str]]:
    """Name and unit (m or rad) of each number that an edge measures."""
    return [(what, unit) for what, unit in (name.rsplit(" ", 1) for name in _named(tag, count))]


def _named(tag: str, count: int) -> Sequence[str]:
    return _NAMES.get(tag) or (_XY if count == 2 else _XYZ)


def with_units(entry: Entry, numbers: Sequence[float]) -> str:
    """One number for each that the edge measures, with their names; angles in degrees."""
    words = []
    for (what, unit), number in zip(units(entry.tag, len(numbers)), numbers, strict=True):
        words.append(f"{what} {number * _DEGREES:.2f} deg" if unit == "rad" else f"{what} {number:.3f} {unit}")
    return ", ".join(words)


def measured(entry: Entry) -> tuple[float, ...]:
    """Return what was measured, as many numbers as the residual has; rotations in space as vectors."""
    z = entry.measured
    if entry.tag == "EDGE_ATTITUDE_SE3":
        return tuple(so3.log(z))
    if entry.dof == 6:
        return (*z[:3], *so3.log(z[3:]))
    if entry.tag.startswith("EDGE_COORDINATE"):  # behind its direction, before the place on the robot
        return z[len(z) // 2 : len(z) // 2 + 1]
    return z[: entry.dof]


def expected(entry: Entry) -> tuple[float, ...]:
    """Return what was expected when it was judged first, in the same numbers."""
    z, r = entry.measured, entry.residual
    if entry.tag in ("EDGE_SE2", "EDGE_PRIOR_SE2"):
        x, y, heading = se2.compose(z, r)
        return (x, y, se2.wrap(heading))
    if entry.tag == "EDGE_ATTITUDE_SE3":
        return tuple(so3.log(so3.compose(z, so3.exp(r))))
    if entry.dof == 6:
        pose = se3.compose(z, (*r[:3], *so3.exp(r[3:])))
        return (*pose[:3], *so3.log(pose[3:]))
    return tuple(a + b for a, b in zip(measured(entry), r, strict=True))


def sigmas(entry: Entry) -> tuple[float, ...]:
    """Standard deviation of each of these numbers."""
    deviations: list[float] = sigmas_of(entry.information_matrix).tolist()
    return tuple(deviations)


def sigmas_of(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations (..., m) of information matrices (..., m, m); infinite where they determine nothing."""
    values, vectors = np.linalg.eigh(information)
    is_known = values > _LEAST * np.abs(values).max(axis=-1, keepdims=True)
    variances = np.where(is_known, 1.0 / np.where(is_known, values, 1.0), 0.0)
    out = np.sqrt(np.einsum("...ij,...j,...ij->...i", vectors, variances, vectors))
    unknown = np.einsum("...ij,...j,...ij->...i", vectors, np.where(is_known, 0.0, 1.0), vectors)
    return np.where(unknown > _LEAST, np.inf, out)
