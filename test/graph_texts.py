"""Two small g2o files, in the plane and in space, and the lines of g2o files in other dialects."""

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

PLANE = """\
VERTEX_SE2 10 0.1 -2e-07 3
VERTEX_SE2 11 1.5 -0.002 0.25
VERTEX_XY 7 3 4
EDGE_SE2 10 11 1 0 0.1 10 1 -2 20 3 30
EDGE_SE2_XY 11 7 1 2 4 1 9
"""
UPPER = " ".join(str(float(v)) for v in (np.eye(6) * [1, 2, 3, 4, 5, 6] + 0.25)[np.triu_indices(6)])
SPACE = f"""\
VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 2 3 0.1 -0.7 0.1 0.7
EDGE_SE3:QUAT 0 1 1 2 3 0.5 0.5 -0.5 0.5 {UPPER}
"""


def in_dialect(text, dialect):
    """Return the lines of a g2o text that ``toro``, ``gtsam``, ``isam`` or ``rows`` can say, and their twins."""
    pairs = [(line, twin) for line in text.splitlines() if line and (twin := _twin(line.split(), dialect))]
    return "\n".join(line for line, _ in pairs), "\n".join(" ".join(map(str, twin)) for _, twin in pairs)


def _twin(words, dialect):
    tag, plane = words[0], dialect in ("toro", "isam", "rows")
    if tag == "VERTEX_SE2":
        return ["VERTEX2" if plane else tag, *words[1:]]
    if tag == "VERTEX_XY" and dialect == "gtsam":
        return words
    if tag == "EDGE_SE2":
        noise = _noise(words[6:], dialect)
        noise = [noise[k] for k in (0, 1, 3, 5, 2, 4)] if dialect == "toro" else noise
        return ["EDGE2" if plane else "ODOMETRY", *words[1:6], *noise]
    if tag == "EDGE_SE2_XY" and dialect == "gtsam":
        return ["LANDMARK", *words[1:5], *_noise(words[5:], dialect)]
    if tag == "VERTEX_SE3:QUAT" and dialect in ("toro", "isam"):
        return ["VERTEX3", words[1], *_xyz_rpy(words[2:])]
    if tag == "EDGE_SE3:QUAT" and dialect in ("toro", "isam"):
        return ["EDGE3", *words[1:3], *_xyz_rpy(words[3:10]), *_noise(words[10:], dialect)]
    return None


def _noise(upper, dialect):
    """The information in g2o's rows as the dialect has it: of the rotation vector, inverted, or its root."""
    size = {3: 2, 6: 3, 21: 6}[len(upper)]
    at, matrix = np.triu_indices(size), np.zeros((size, size))
    matrix[at] = [float(word) for word in upper]
    matrix = matrix + np.triu(matrix, 1).T
    if size == 6:
        halved = np.repeat([1.0, 0.5], 3)
        matrix *= np.outer(halved, halved)
    if dialect == "gtsam":
        matrix = np.linalg.inv(matrix)
    if dialect == "isam":
        matrix = np.linalg.cholesky(matrix).T
    return matrix[at].tolist()


def _xyz_rpy(words):
    pose = [float(word) for word in words]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a nose that points up has any roll
        return [*pose[:3], *Rotation.from_quat(pose[3:]).as_euler("xyz").tolist()]
