"""The numbers of a measurement as text: their names and units, and what was expected instead."""

import math
from collections.abc import Sequence

import numpy as np

from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.lie import se2, se3, so3
from graph_slam_ros.runs.ledger_file import Entry
from graph_slam_ros.typing import Array

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


def columns(entries: Sequence[Entry]) -> dict[str, Array]:
    """The numbers of measurements that sentences have fields for, in the units that are shown: NaN where one has less.

    ``measured0``, ``sigmas0``, ``expected0`` and so on: what was measured, as many numbers as the residual has, with
    rotations in space as vectors; the standard deviation of each; what was expected when it was judged first.
    """
    out: dict[str, Array] = {}
    by_tag: dict[str, list[int]] = {}
    for row, e in enumerate(entries):
        if e.label != PLACES:  # which measures a whole visit
            by_tag.setdefault(e.tag, []).append(row)
    for tag, rows in by_tag.items():
        several = [entries[row] for row in rows]
        dof = several[0].dof
        upper, information = np.triu_indices(dof), np.zeros((len(several), dof, dof))
        values = np.array([e.information for e in several])
        information[:, upper[0], upper[1]] = information[:, upper[1], upper[0]] = values
        z, r = (tuple(np.array(of).T) for of in zip(*((e.measured, e.residual) for e in several), strict=True))
        found = {"measured": _measured(tag, dof, z), "expected": _expected(tag, dof, z, r)}
        for name, numbers in {**found, "sigmas": tuple(sigmas_of(information).T)}.items():
            for k, (column, of) in enumerate(zip(numbers, _names(tag, dof), strict=True)):
                unit = _DEGREES if of.endswith("rad") else 1.0
                out.setdefault(f"{name}{k}", np.full(len(entries), np.nan))[rows] = column * unit
    return out


def template(entry: Entry, name: str) -> str:
    """Fields for the numbers of a name of ``columns``, with what they are and their units; angles in degrees."""
    words = []
    for k, (what, unit) in enumerate(of.rsplit(" ", 1) for of in _names(entry.tag, entry.dof)):
        words.append(f"{what} {{{name}{k}:.2f}} deg" if unit == "rad" else f"{what} {{{name}{k}:.3f}} {unit}")
    return ", ".join(words)


def _names(tag: str, dof: int) -> Sequence[str]:
    return _NAMES.get(tag) or (_XY if dof == 2 else _XYZ)


def _measured(tag: str, dof: int, z: tuple[Array, ...]) -> tuple[Array, ...]:
    if tag == "EDGE_ATTITUDE_SE3":
        return tuple(so3.log(z))
    if dof == 6:
        return (*z[:3], *so3.log(z[3:]))
    if tag.startswith("EDGE_COORDINATE"):  # behind its direction, before the place on the robot
        return z[len(z) // 2 : len(z) // 2 + 1]
    return z[:dof]


def _expected(tag: str, dof: int, z: tuple[Array, ...], r: tuple[Array, ...]) -> tuple[Array, ...]:
    if tag in ("EDGE_SE2", "EDGE_PRIOR_SE2"):
        x, y, heading = se2.compose(z, r)
        return (x, y, se2.wrap(heading))
    if tag == "EDGE_ATTITUDE_SE3":
        return tuple(so3.log(so3.compose(z, so3.exp(r))))
    if dof == 6:
        pose = se3.compose(z, (*r[:3], *so3.exp(r[3:])))
        return (*pose[:3], *so3.log(pose[3:]))
    return tuple(a + b for a, b in zip(_measured(tag, dof, z), r, strict=True))


def sigmas_of(information: Array) -> Array:
    """Standard deviations (..., m) of information matrices (..., m, m); infinite where they determine nothing."""
    values, vectors = np.linalg.eigh(information)
    is_known = values > _LEAST * np.abs(values).max(axis=-1, keepdims=True)
    variances = np.where(is_known, 1.0 / np.where(is_known, values, 1.0), 0.0)
    out = np.sqrt(np.einsum("...ij,...j,...ij->...i", vectors, variances, vectors))
    unknown = np.einsum("...ij,...j,...ij->...i", vectors, np.where(is_known, 0.0, 1.0), vectors)
    return np.where(unknown > _LEAST, np.inf, out)
