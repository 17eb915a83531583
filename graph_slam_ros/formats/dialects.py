"""Other texts for graphs, said in g2o's words: TORO and iSAM (VERTEX2, EDGE2, ...), GTSAM (ODOMETRY, LANDMARK).

Each line is turned into the g2o line of the same meaning, so there is one reader, one set of checks and one graph.
"""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.strict import expect, integer, numbers
from graph_slam_ros.lie import so3

Array = NDArray[np.float64]

LANDMARK_IDS_FROM = 1_000_000_000  # GTSAM's text numbers landmarks apart from poses

_TORO = [0, 1, 4, 2, 5, 3]  # TORO writes I11 I12 I22 I33 I13 I23, g2o the rows of the upper triangle
_HALVED = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])


def in_g2o_words(words: list[str]) -> list[str]:
    """The same line in g2o's words; a line that is of no dialect is returned as it is.

    Raises
    ------
    FormatError
        Wrong number of fields, or fields that are not numbers.
    """
    translate = _LINES.get(words[0])
    return words if translate is None else translate(words)


def _vertex2(words: list[str]) -> list[str]:
    expect(words, 4)
    return ["VERTEX_SE2", *words[1:]]


def _edge2(words: list[str]) -> list[str]:
    expect(words, 11)
    upper = numbers(words[6:])
    toro = [upper[k] for k in _TORO]
    return ["EDGE_SE2", *words[1:6], *_written(toro if _is_definite(toro) else upper)]


def _vertex3(words: list[str]) -> list[str]:
    expect(words, 7)
    return ["VERTEX_SE3:QUAT", words[1], *_written(_pose(numbers(words[2:])))]


def _edge3(words: list[str]) -> list[str]:
    """Without an information matrix it is the identity; its rotations are taken as rotation vectors."""
    if len(words) != 9:
        expect(words, 29)
    values = numbers(words[3:])
    upper = np.triu_indices(6)
    information = np.zeros((6, 6))
    information[upper] = values[6:] if len(values) > 6 else np.eye(6)[upper]
    scaled = information / np.outer(_HALVED, _HALVED)
    return ["EDGE_SE3:QUAT", *words[1:3], *_written(_pose(values[:6])), *_written(scaled[upper].tolist())]


def _odometry(words: list[str]) -> list[str]:
    expect(words, 11)
    xx, xy, xt, yy, yt, tt = numbers(words[6:])
    covariance = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    return ["EDGE_SE2", *words[1:6], *_written(_inverse_upper(covariance))]


def _landmark(words: list[str]) -> list[str]:
    expect(words, 7)
    xx, xy, yy = numbers(words[5:])
    landmark = str(LANDMARK_IDS_FROM + integer(words[2]))
    information = _inverse_upper(np.array([[xx, xy], [xy, yy]]))
    return ["EDGE_SE2_XY", words[1], landmark, *words[3:5], *_written(information)]


_LINES = {
    "VERTEX2": _vertex2,
    "EDGE2": _edge2,
    "VERTEX3": _vertex3,
    "EDGE3": _edge3,
    "ODOMETRY": _odometry,
    "LANDMARK": _landmark,
}


def _pose(xyz_rpy: list[float]) -> list[float]:
    """Position and quaternion of a position with roll, pitch and yaw about fixed axes."""
    roll, pitch, yaw = xyz_rpy[3:6]
    about_z, about_y, about_x = so3.exp((0.0, 0.0, yaw)), so3.exp((0.0, pitch, 0.0)), so3.exp((roll, 0.0, 0.0))
    return [*xyz_rpy[:3], *(float(q) for q in so3.compose(so3.compose(about_z, about_y), about_x))]


def _is_definite(upper: list[float]) -> bool:
    a, b, c, d, e, f = upper
    return a > 0 and a * d > b * b and a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d) > 0


def _inverse_upper(covariance: Array) -> list[float]:
    if not np.isfinite(covariance).all() or np.linalg.det(covariance) <= 0.0:
        raise FormatError("the covariance is not positive definite")
    values: list[float] = np.linalg.inv(covariance)[np.triu_indices(len(covariance))].tolist()
    return values


def _written(values: list[float]) -> list[str]:
    return [repr(float(value)) for value in values]
