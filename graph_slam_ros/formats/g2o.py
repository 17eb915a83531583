"""Reading g2o text files: poses and point landmarks in the plane and in space, relative poses, sightings, priors, FIX.

Information matrices are taken as they are, but for one thing: g2o measures a rotation in space by the vector part of
its quaternion, which is half the rotation vector, so a rotation's information counts a quarter in our residual.
A sighting in space is measured in a sensor's frame, and names the parameter that says where that is on the robot; in
the graph it is in the robot's. Tags of ours stand for what g2o has no word for. Unknown tags are kept, word for word,
and written back. TORO's, iSAM's and GTSAM's texts are read as well (``dialects``), and files
without vertex lines.
"""

import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from graph_slam_ros.edge_tags import EDGE_TAGS, OFFSET, VERTEX_TAGS, built_in, edge_of, measured_sizes, plugin_tags
from graph_slam_ros.errors import FormatError, NoiseError
from graph_slam_ros.formats.dialects import DIALECTS, LANDMARK_IDS_FROM, Text, in_g2o_words, may_be_roots
from graph_slam_ros.formats.graph_file import AT_OFFSET, HALVED, G2oFile, moved
from graph_slam_ros.formats.strict import expect, integer, lines, numbers
from graph_slam_ros.graph import (
    ATTITUDE_PRIOR_3D,
    INVERSE_RELATIVE_POSE,
    LANDMARK_POSITION_3D,
    POSE_PRIOR_3D,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    EdgeType,
    Gaussian,
    Graph,
)
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array

_RELATIVE = ("EDGE_SE2", "EDGE_SE3:QUAT")
_CLASS = re.compile(r"#\s+(?:\d+\s+\d+\s+)?class\s+(\S+)\s*", re.ASCII)  # our comment, the label of what follows it
_PRINTED = 1e-3  # of correlations: what three printed digits leave of an eigenvalue that should not be negative
_UNIT = 1e-12  # a squared quaternion norm this near to 1 is left as it was written
ERROR_MAPS = {"relative": RELATIVE_POSE, "seed": INVERSE_RELATIVE_POSE}


@dataclass(slots=True)
class _Edge:
    line: int
    vertices: tuple[int, ...]
    measured: list[float]
    information: list[float]
    label: str
    offset: int | None = None


class _Reader:
    """The state of one reading: the declarations of each line, before they become arrays."""

    def __init__(self, name: str, lenient: bool, text: Text) -> None:
        self.name, self.lenient, self.text = name, lenient, text
        self.vertices: dict[int, tuple[str, list[float]]] = {}
        self.edges: dict[str, list[_Edge]] = {tag: [] for tag in EDGE_TAGS}
        self.fixed: list[tuple[int, int]] = []
        self.offsets: dict[int, se3.Pose] = {}
        self.unknown: list[str] = []
        self.skipped: list[str] = []
        self.repaired: list[int] = []
        self.assumed = 0  # the first line whose information may have been meant otherwise
        self.has_values = True
        self.label = ""

    def refuse(self, line: int, why: str) -> None:
        message = f"{self.name}:{line}: {why}"
        if not self.lenient:
            raise FormatError(message)
        self.skipped.append(message)

    @cached_property
    def plugin_tags(self) -> frozenset[str]:
        """Tags of plugins, looked up at the first tag that is not built in."""
        return plugin_tags()

    def read_line(self, line: int, text: str) -> None:
        words = text.split()
        if not words or words[0].startswith("#"):
            labelled = _CLASS.fullmatch(text.strip())
            self.label = labelled[1] if labelled else self.label
            return
        try:
            self.assumed = self.assumed or line * may_be_roots(words, self.text)
            words = in_g2o_words(words, self.text)
            tag = words[0]
            if tag in VERTEX_TAGS:
                self._vertex(tag, words)
            elif built_in(tag):
                self.edges.setdefault(tag, []).append(self._edge(line, tag, words))
            elif tag == OFFSET:
                self._offset(words)
            elif tag == "FIX":
                if len(words) < 2:
                    raise FormatError("FIX names no vertex")
                self.fixed += [(line, integer(word)) for word in words[1:]]
            elif tag in self.plugin_tags:
                self.edges.setdefault(tag, []).append(self._edge(line, tag, words))
            else:
                self.unknown.append(text.strip())
        except FormatError as error:
            self.refuse(line, str(error))

    def _vertex(self, tag: str, words: list[str]) -> None:
        kind = VERTEX_TAGS[tag]
        expect(words, 1 + kind.size)
        vertex, value = integer(words[1]), _with_unit_quaternion(numbers(words[2:]), 3 if kind is SE3 else None)
        if vertex in self.vertices and self.vertices[vertex] != (tag, value):
            raise FormatError(f"vertex {vertex} was declared before, with other values")
        self.vertices[vertex] = (tag, value)

    def _offset(self, words: list[str]) -> None:
        expect(words, 1 + SE3.size)
        x, y, z, *q = _with_unit_quaternion(numbers(words[2:]), 3)
        self.offsets[integer(words[1])] = (x, y, z, q[0], q[1], q[2], q[3])

    def _edge(self, line: int, tag: str, words: list[str]) -> _Edge:
        edge = edge_of(tag)
        slots, m, from_offset = len(edge.accepts), edge.residual_size, tag in AT_OFFSET
        others, size = slots + from_offset + m * (m + 1) // 2, edge.measured_size
        if len(words) - 1 - others in measured_sizes(tag):
            size = len(words) - 1 - others
        expect(words, others + size)
        vertices = tuple(integer(word) for word in words[1 : 1 + slots])
        values = numbers(words[1 + slots + from_offset :])
        measured = _with_unit_quaternion(values[:size], _quaternion_at(edge))
        measured += edge.tail[size - edge.measured_size + len(edge.tail) :]
        offset = integer(words[1 + slots]) if from_offset else None
        return _Edge(line, vertices, measured, values[size:], self.label, offset)

    def declare_all(self) -> None:
        """Declare the vertices of a file of edges alone: those that edges name, in order of id, without values."""
        self.has_values = False
        kinds: dict[int, str] = {}
        tags = {kind: tag for tag, kind in VERTEX_TAGS.items()}
        for tag, edges in self.edges.items():
            for edge in edges:
                for vertex, accepted in zip(edge.vertices, edge_of(tag).accepts, strict=True):
                    kinds.setdefault(vertex, tags[accepted[0]])
        nowhere = {"VERTEX_SE3:QUAT": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]}
        for vertex in sorted(kinds):
            tag = kinds[vertex]
            self.vertices[vertex] = (tag, nowhere.get(tag, [0.0] * VERTEX_TAGS[tag].size))

    def graph(self, relative_pose: EdgeType) -> G2oFile:
        graph = Graph()
        at: dict[int, int] = {}
        for tag, run in itertools.groupby(self.vertices.items(), key=lambda item: item[1][0]):
            values = {file_id: value for file_id, (_, value) in run}
            at.update(zip(values, graph.add_vertices(VERTEX_TAGS[tag], list(values.values())).tolist(), strict=True))
        poses = sorted(file_id for file_id, (tag, _) in self.vertices.items() if VERTEX_TAGS[tag] in (SE2, SE3))
        follows = dict(itertools.pairwise(poses))
        seen_from: dict[int, int] = {}
        for tag, edges in self.edges.items():
            edge_type = relative_pose if tag == "EDGE_SE2" else edge_of(tag)
            for label, members in _by_label(tag, self._known(tag, edges), follows).items():
                seen_from |= self._add(graph, edge_type, label, members, at)
        fixed = []
        for line, file_id in self.fixed:
            if file_id in at:
                fixed.append(at[file_id])
            else:
                self.refuse(line, f"FIX names vertex {file_id}, which is not declared")
        return G2oFile(
            graph,
            list(at),
            fixed,
            self.offsets,
            seen_from,
            self.unknown,
            self.skipped,
            self.text.raw,
            self.has_values,
            list(self._notes()),
        )

    def _notes(self) -> Iterator[str]:
        if self.repaired:
            what = f"{len(self.repaired)} information matrices" if len(self.repaired) > 1 else "an information matrix"
            yield (
                f"{self.name}:{self.repaired[0]}: {what} not positive definite by the rounding of print alone:"
                " weights from the traces of position and rotation are used instead"
            )
        if self.assumed:
            yield (
                f"{self.name}:{self.assumed}: EDGE3 is read as TORO's information (--from toro says that it is); iSAM"
                " writes its square root: --from isam"
            )

    def _known(self, tag: str, edges: Sequence[_Edge]) -> Iterator[_Edge]:
        """Edges whose vertices exist and are of the right kind, and whose information is positive definite."""
        for edge in edges:
            for file_id, kinds in zip(edge.vertices, edge_of(tag).accepts, strict=True):
                declared = self.vertices.get(file_id)
                if declared is None:
                    self.refuse(edge.line, f"edge to vertex {file_id}, which is not declared")
                    break
                if VERTEX_TAGS[declared[0]] not in kinds:
                    self.refuse(edge.line, f"{tag} to vertex {file_id}, which is a {declared[0]}")
                    break
            else:
                if len(set(edge.vertices)) < len(edge.vertices):
                    self.refuse(edge.line, f"edge from vertex {edge.vertices[0]} to itself")
                elif edge.offset is None or self._is_at(tag, edge):
                    yield edge

    def _is_at(self, tag: str, edge: _Edge) -> bool:
        """Return whether the pose of an edge's sensor is known, and allows its measurement to be used."""
        offset = self.offsets.get(edge.offset or 0)
        if offset is None and edge.offset:  # some files leave out parameter 0, which is then the robot's frame itself
            self.refuse(edge.line, f"parameter {edge.offset}, which is not declared")
            return False
        if tag == "EDGE_SE3_PRIOR" and offset not in (None, se3.IDENTITY):
            self.refuse(edge.line, f"{tag} of a sensor that is not at the robot's origin")
            return False
        return True

    def _add(
        self, graph: Graph, edge_type: EdgeType, label: str, edges: list[_Edge], at: dict[int, int]
    ) -> dict[int, int]:
        """Add edges to the graph; returns the parameters of those that have one."""
        information = _symmetric(np.array([e.information for e in edges]), edge_type.residual_size)
        if edge_type in HALVED and not self.text.raw:
            information *= np.outer(HALVED[edge_type], HALVED[edge_type])
        good, kinds = list(range(len(edges))), edge_type.accepts
        lengths = edge_type.residual_size - (0 if kinds[-1][0] not in (SE2, SE3) else 1 if SE2 in kinds[-1] else 3)
        try:
            noise = Gaussian.from_information(information)
        except NoiseError:
            roots = [self._root(edge, information[k], lengths, len(kinds) == 1) for k, edge in enumerate(edges)]
            good = [k for k, root in enumerate(roots) if root is not None]
            if not good:
                return {}
            noise = Gaussian(np.stack([root for root in roots if root is not None]))
        edges = [edges[k] for k in good]
        measured = np.array([edge.measured for edge in edges])
        if edge_type is LANDMARK_POSITION_3D:
            offsets = [self.offsets.get(edge.offset or 0, se3.IDENTITY) for edge in edges]
            measured, noise = moved(measured, noise.sqrt_information, offsets)
        ids = graph.add_edges(edge_type, [[at[v] for v in edge.vertices] for edge in edges], measured, noise, label)
        seen_from = zip(ids.tolist(), edges, strict=True)
        return {edge_id: edge.offset for edge_id, edge in seen_from if edge.offset is not None}

    def _root(self, edge: _Edge, information: Array, lengths: int, is_prior: bool) -> Array | None:
        """The root of one information matrix, repaired where print has rounded it; None if the edge is left out.

        A prior may say nothing in some directions, as a sum of fixes does.
        """
        try:
            return Gaussian.from_information(information).sqrt_information
        except NoiseError as error:
            if is_prior:
                with suppress(NoiseError):
                    return Gaussian.from_semidefinite(information).sqrt_information
            weighted = by_traces(information, lengths)
            if weighted is None:
                self.refuse(edge.line, str(error).replace("information 0", "information", 1))
                return None
        self.repaired.append(edge.line)
        return Gaussian.from_information(weighted).sqrt_information


def read_g2o(
    path: Path | str,
    *,
    error_map: str = "relative",
    lenient: bool = False,
    raw: bool = False,
    dialect: str | None = None,
    follow: bool = True,
) -> G2oFile:
    """Read a g2o file, or a text of one of its dialects.

    Edges are labelled as the comments ``# CODE COUNT class LABEL`` of our own files say. In other files relative poses
    between one pose and the next (in order of id) are labelled ``odometry``, others ``closures``, sightings
    ``landmarks``, priors ``priors``.

    Parameters
    ----------
    error_map : ``relative`` (g2o's, ours) or ``seed`` (residual of the inverse, python-graphslam's)
    lenient : leave out bad lines and list them in ``skipped`` instead of refusing the file
    raw : take the information of rotations in space as belonging to the rotation vector, unscaled
    dialect : ``g2o``, ``toro``, ``gtsam``, ``isam`` (square roots of the information) or ``rows`` (EDGE2 with its
        information in rows of the upper triangle): refuse lines of the others, and guess at nothing; by default each
        line is known by its tag
    follow : the file may be a symbolic link

    Raises
    ------
    FormatError
        With file and line of the first fault.
    """
    path = Path(path)
    if error_map not in ERROR_MAPS:
        raise FormatError(f"error map {error_map!r}: choose {' or '.join(ERROR_MAPS)}")
    if dialect not in (None, *DIALECTS):
        raise FormatError(f"dialect {dialect!r}: choose {', '.join(DIALECTS)}")
    own_numbers = dialect in ("gtsam", "isam") or any(
        text.lstrip().startswith(("LANDMARK ", "LANDMARK\t")) for _, text in lines(path, follow=follow)
    )
    reader = _Reader(path.name, lenient, Text(dialect, raw, LANDMARK_IDS_FROM if own_numbers else 0))
    for number, text in lines(path, follow=follow):
        reader.read_line(number, text)
    if not reader.vertices:
        reader.declare_all()
    if not reader.vertices:
        raise FormatError(f"{path.name}: no vertex in it; is it a graph?")
    return reader.graph(ERROR_MAPS[error_map])


def by_traces(information: Array, lengths: int) -> Array | None:
    """Weights in place of an information matrix (m, m) that is not positive definite by the rounding of print alone.

    As SE-Sync does for all: one weight for its first ``lengths`` numbers and one for the rest, each the mean of that
    part of the diagonal. None where more than one eigenvalue is in doubt, one is too far below zero for rounding, or a
    weight is not positive.
    """
    if len(information) < 2 or not np.isfinite(information).all():
        return None
    diagonal = np.diag(information)
    if not (diagonal > 0.0).all():
        return None
    scale = np.sqrt(diagonal)
    least, second, *_ = np.linalg.eigvalsh(information / np.outer(scale, scale))
    if least < -_PRINTED or second < _PRINTED:
        return None
    weights = np.empty(len(diagonal))
    for block in (slice(0, lengths), slice(lengths, None)):
        weights[block] = diagonal[block].mean() if len(diagonal[block]) else 0.0
    return np.diag(weights)


def _quaternion_at(edge: EdgeType) -> int | None:
    """Return the index of a quaternion in the measurement of an edge, if there is one."""
    if edge in (RELATIVE_POSE_3D, POSE_PRIOR_3D):
        return 3
    if edge is ATTITUDE_PRIOR_3D:
        return 0
    return edge.measured_size - 4 if edge.tail == se3.IDENTITY else None


def _with_unit_quaternion(numbers: list[float], at: int | None) -> list[float]:
    """Normalise the quaternion (x, y, z, w) at an index, if the numbers reach so far."""
    if at is None or len(numbers) <= at:
        return numbers
    square = sum(q * q for q in numbers[at:])
    if square == 0.0:
        raise FormatError("the quaternion is zero")
    if abs(square - 1.0) <= _UNIT:
        return numbers
    return numbers[:at] + [q / square**0.5 for q in numbers[at:]]


def _by_label(tag: str, edges: Iterable[_Edge], follows: dict[int, int]) -> dict[str, list[_Edge]]:
    groups: dict[str, list[_Edge]] = {}
    for edge in edges:
        groups.setdefault(edge.label or _usual_label(tag, edge, follows), []).append(edge)
    return groups


def _usual_label(tag: str, edge: _Edge, follows: dict[int, int]) -> str:
    if tag in _RELATIVE:
        return "odometry" if follows.get(min(edge.vertices)) == max(edge.vertices) else "closures"
    return "priors" if len(edge_of(tag).accepts) == 1 else "landmarks"


def _symmetric(upper: Array, size: int) -> Array:
    full = np.zeros((len(upper), size, size))
    i, j = np.triu_indices(size)
    full[:, i, j] = upper
    full[:, j, i] = upper
    return full
