"""Other texts for graphs, read as g2o's lines: TORO, iSAM (VERTEX2, EDGE2), GTSAM (ODOMETRY, LANDMARK).

Each line is turned into the g2o line of the same meaning, so there is one reader, one set of checks and one graph.

* TORO: the information of EDGE2 as I11 I12 I22 I33 I13 I23, that of EDGE3 in rows of the upper triangle; angles in
  radians, roll, pitch and yaw about fixed axes. It has poses and what is between them, nothing else.
* iSAM 1: as TORO's tags in the plane, and ODOMETRY and LANDMARK, but with the square root R of the information
  (``R'R``), in rows of the upper triangle. No line tells it from information in rows, so it must be named.
* GTSAM: covariances, in rows of the upper triangle, in the plane. Landmarks have numbers of their own.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from graph_slam_ros.edge_tags import SWITCHED
from graph_slam_ros.errors import FormatError, NoiseError
from graph_slam_ros.formats.strict import expect, integer, numbers
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array

Words: TypeAlias = list[str]

LANDMARK_IDS_FROM = 1_000_000_000  # GTSAM's text numbers landmarks apart from poses

_TORO = [0, 1, 4, 2, 5, 3]  # where g2o's rows of the upper triangle stand in TORO's order
_HALVED = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
_UPPER_3D = np.triu_indices(6)


@dataclass(frozen=True, slots=True)
class Text:
    """The interpretation of a text's lines.

    Attributes
    ----------
    dialect : ``g2o``, ``toro``, ``gtsam``, ``isam`` or ``rows`` (EDGE2 with its information in rows of the upper
        triangle); None: each line is known by its tag
    raw : whether g2o's information of rotations in space belongs to the rotation vector, as TORO's does
    landmarks_from : what the text's number of a VERTEX_XY lacks to its id
    """

    dialect: str | None = None
    raw: bool = False
    landmarks_from: int = 0


def in_g2o_words(words: Words, text: Text) -> Words:
    """The same line as a line of g2o. A line of no dialect is returned unchanged.

    Raises
    ------
    FormatError
        Wrong number of fields, or fields that are not numbers; a line of another dialect than the text's.
    """
    tag = words[0]
    if text.dialect and tag not in _TAGS[text.dialect] and any(tag in tags for tags in _TAGS.values()):
        raise FormatError(f"{tag} is no line of a {text.dialect} file")
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite then is refused with its line
        return _READ[tag](words, text) if tag in _READ else words


def may_be_roots(words: Words, text: Text) -> bool:
    """Return whether a line may contain the root of its information: in EDGE3 both look the same."""
    if text.dialect or words[0] != "EDGE3" or len(words) != 3 + 6 + 21:
        return False
    return not np.array_equal(numbers(words[9:]), np.eye(6)[_UPPER_3D])  # which is its own root


def _edge2(words: Words, text: Text) -> Words:
    """The fields of a g2o line from an EDGE2, in the order of its dialect; an order that must be named is refused."""
    expect(words, 11)
    rows = numbers(words[6:])
    if text.dialect == "isam":
        return ["EDGE_SE2", *words[1:6], *_written(_squared(rows))]
    toro = [rows[k] for k in _TORO]
    if text.dialect is None and min(rows[0], rows[3], rows[5]) > 0.0:
        try:
            Gaussian.from_information(symmetric(toro))
        except NoiseError:
            remedy = "--from isam (square roots of the information) or --from rows (information)"
            raise FormatError(f"EDGE2 is not in TORO's order: {remedy}") from None
    return ["EDGE_SE2", *words[1:6], *_written(rows if text.dialect == "rows" else toro)]


def _vertex3(words: Words, _: Text) -> Words:
    expect(words, 7)
    return ["VERTEX_SE3:QUAT", words[1], *_written(se3.from_xyz_rpy(numbers(words[2:])))]


def _edge3(words: Words, text: Text) -> Words:
    if len(words) != 9:
        expect(words, 29)
    values = numbers(words[3:])
    information = np.array(_squared(values[6:]) if text.dialect == "isam" and values[6:] else values[6:])
    if not text.raw and len(information):
        information = information / np.outer(_HALVED, _HALVED)[_UPPER_3D]
    return ["EDGE_SE3:QUAT", *words[1:3], *_written(se3.from_xyz_rpy(values[:6])), *_written(information.tolist())]


def _odometry(words: Words, text: Text) -> Words:
    expect(words, 11)
    return ["EDGE_SE2", *words[1:6], *_information(words[6:], text)]


def _landmark(words: Words, text: Text) -> Words:
    expect(words, 7)
    landmark = str(LANDMARK_IDS_FROM + integer(words[2]))
    return ["EDGE_SE2_XY", words[1], landmark, *words[3:5], *_information(words[5:], text)]


def _information(words: Words, text: Text) -> Words:
    return _written((_squared if text.dialect == "isam" else _inverse)(numbers(words)))


def _point(words: Words, text: Text) -> Words:
    if len(words) < 2 or not text.landmarks_from:
        return words
    return ["VERTEX_XY", str(text.landmarks_from + integer(words[1])), *words[2:]]


def _horizontal(words: Words, _: Text) -> Words:
    expect(words, 6)
    x, y, xx, xy, yy = words[2:]
    return ["EDGE_POSITION_SE3", words[1], x, y, "0", xx, xy, "0", yy, "0", "0"]


def _named(tag: str, dropped: int = 0) -> "Translation":
    """Translate a line that is g2o's or ours but for its tag, and maybe a field that is dropped."""
    return lambda words, _: [tag, *(word for k, word in enumerate(words[1:], start=1) if k != dropped)]


Translation: TypeAlias = Callable[[Words, Text], Words]

_READ: dict[str, Translation] = {
    "VERTEX2": _named("VERTEX_SE2"),
    "EDGE2": _edge2,
    "VERTEX3": _vertex3,
    "EDGE3": _edge3,
    "ODOMETRY": _odometry,
    "LANDMARK": _landmark,
    "VERTEX_XY": _point,
    "EDGE_SE3_PRIORXYZ": _named("EDGE_POSITION_SE3"),  # hdl_graph_slam's, as the next
    "EDGE_SE3_PRIORXY": _horizontal,
    "EDGE_SE3_XYZ_PRIOR": _named("EDGE_POSITION_SE3", 2),  # g2o does not use its parameter
    **{tag: _named(plain, 3) for tag, plain in SWITCHED.items()},
}

_G2O = ("VERTEX_SE2", "VERTEX_XY", "EDGE_SE2", "EDGE_SE2_XY", "EDGE_PRIOR_SE2", "EDGE_SE2_POSITION")
_G2O_3D = ("VERTEX_SE3:QUAT", "VERTEX_TRACKXYZ", "EDGE_SE3:QUAT")
_TAGS = {
    "g2o": frozenset({*_G2O, *_G2O_3D, "FIX"}),
    "toro": frozenset({"VERTEX2", "EDGE2", "VERTEX3", "EDGE3"}),
    "gtsam": frozenset({"VERTEX_SE2", "VERTEX2", "VERTEX_XY", "ODOMETRY", "LANDMARK"}),
    "isam": frozenset({"VERTEX2", "EDGE2", "ODOMETRY", "LANDMARK", "VERTEX3", "EDGE3"}),
    "rows": frozenset({"VERTEX2", "EDGE2"}),
}
DIALECTS = tuple(_TAGS)


def symmetric(upper: Any) -> Array:
    """Matrices (m, m) or (n, m, m) of the rows of their upper triangles."""
    given = np.asarray(upper, dtype=np.float64)
    size = round(np.sqrt(2 * given.shape[-1] + 0.25) - 0.5)
    full, (i, j) = np.zeros((*given.shape[:-1], size, size)), np.triu_indices(size)
    full[..., i, j] = full[..., j, i] = given
    return full


def _squared(rows: list[float]) -> list[float]:
    """The upper triangle of ``R'R``, from the rows of the upper triangle of R."""
    root = np.triu(symmetric(rows))
    return [*(root.T @ root)[np.triu_indices(len(root))]]


def _inverse(upper: list[float]) -> list[float]:
    """The upper triangle of the inverse of a covariance, from its own."""
    inverse = Gaussian.from_covariance(symmetric(upper)).information
    return [*inverse[np.triu_indices(len(inverse))]]


def _written(values: Iterable[float]) -> Words:
    return [repr(float(value)) for value in values]
