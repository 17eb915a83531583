"""g2o text files: poses and point landmarks in the plane and in space, relative poses, priors, FIX.

Information matrices are taken as they are, but for one thing: g2o measures a rotation in space by the vector part of
its quaternion, which is half the rotation vector, so a rotation's information counts a quarter in our residual.
Unknown tags are kept, word for word, and written back. TORO's, iSAM's and GTSAM's texts are read as well
(``dialects``, and ``convert`` to write them), and files without vertex lines.
"""

import gzip
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import FormatError, NoiseError
from graph_slam_ros.formats.dialects import DIALECTS, LANDMARK_IDS_FROM, Text, in_g2o_words
from graph_slam_ros.formats.strict import expect, integer, is_gzipped, lines, numbers
from graph_slam_ros.graph import (
    INVERSE_RELATIVE_POSE,
    LANDMARK_POSITION,
    POSE_PRIOR,
    R2,
    R3,
    RELATIVE_POSE,
    RELATIVE_POSE_3D,
    SE2,
    SE3,
    TAG_POSITION,
    EdgeType,
    Gaussian,
    Graph,
    VertexKind,
)

Array = NDArray[np.float64]
Values: TypeAlias = Callable[[Sequence[int]], Array]

VERTEX_TAGS: dict[str, VertexKind] = {
    "VERTEX_SE2": SE2,
    "VERTEX_XY": R2,
    "VERTEX_SE3:QUAT": SE3,
    "VERTEX_TRACKXYZ": R3,
}
EDGE_TAGS: dict[str, EdgeType] = {
    "EDGE_SE2": RELATIVE_POSE,
    "EDGE_SE2_XY": LANDMARK_POSITION,
    "EDGE_PRIOR_SE2": POSE_PRIOR,
    "EDGE_SE3:QUAT": RELATIVE_POSE_3D,
    "EDGE_SE2_POSITION": TAG_POSITION,  # ours: of a landmark that is a pose, only the position was seen
}
_RELATIVE = ("EDGE_SE2", "EDGE_SE3:QUAT")
_HALVED = {RELATIVE_POSE_3D: np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])}  # of our residual, in g2o's
# Our comment, the label of the edges that follow it. Its code and their number come first since GTSAM looks for two
# integers behind every tag in the plane: where a line has none (a FIX line as well), it reads no edge after it.
_CLASS = re.compile(r"#\s+(?:\d+\s+\d+\s+)?class\s+(\S+)\s*", re.ASCII)
_UNIT = 1e-12  # a squared quaternion norm this near to 1 is left as it was written
ERROR_MAPS = {"relative": RELATIVE_POSE, "seed": INVERSE_RELATIVE_POSE}


@dataclass(slots=True)
class G2oFile:
    """A graph as read from, or to be written to, a g2o file.

    Attributes
    ----------
    ids : the file's id of each vertex of the graph
    fixed : vertices (ids of the graph) that FIX lines hold
    unknown : lines with tags that are not understood, in order
    skipped : in lenient reading, what was wrong with each line left out
    raw : whether the information of rotations in space was, and is to be written, unscaled
    has_values : whether the file gave initial values; without, all are at the origin
    """

    graph: Graph
    ids: list[int]
    fixed: list[int] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    raw: bool = False
    has_values: bool = True


@dataclass(slots=True)
class _Edge:
    line: int
    vertices: tuple[int, ...]
    measured: list[float]
    information: list[float]
    label: str


class _Reader:
    """State of one reading: what each line declared, before it becomes arrays."""

    def __init__(self, name: str, lenient: bool, text: Text) -> None:
        self.name, self.lenient, self.text = name, lenient, text
        self.vertices: dict[int, tuple[str, list[float]]] = {}
        self.edges: dict[str, list[_Edge]] = {tag: [] for tag in EDGE_TAGS}
        self.fixed: list[tuple[int, int]] = []
        self.unknown: list[str] = []
        self.skipped: list[str] = []
        self.has_values = True
        self.label = ""

    def refuse(self, line: int, why: str) -> None:
        message = f"{self.name}:{line}: {why}"
        if not self.lenient:
            raise FormatError(message)
        self.skipped.append(message)

    def take(self, line: int, text: str) -> None:
        words = text.split()
        if not words or words[0].startswith("#"):
            labelled = _CLASS.fullmatch(text.strip())
            self.label = labelled[1] if labelled else self.label
            return
        try:
            words = in_g2o_words(words, self.text)
            tag = words[0]
            if tag in VERTEX_TAGS:
                self._vertex(tag, words)
            elif tag in EDGE_TAGS:
                self.edges[tag].append(self._edge(line, tag, words))
            elif tag == "FIX":
                if len(words) < 2:
                    raise FormatError("FIX names no vertex")
                self.fixed += [(line, integer(word)) for word in words[1:]]
            else:
                self.unknown.append(text.strip())
        except FormatError as error:
            self.refuse(line, str(error))

    def _vertex(self, tag: str, words: list[str]) -> None:
        kind = VERTEX_TAGS[tag]
        expect(words, 1 + kind.size)
        vertex, value = integer(words[1]), _with_unit_quaternion(numbers(words[2:]), kind.size)
        if vertex in self.vertices and self.vertices[vertex] != (tag, value):
            raise FormatError(f"vertex {vertex} was declared before, with other values")
        self.vertices[vertex] = (tag, value)

    def _edge(self, line: int, tag: str, words: list[str]) -> _Edge:
        edge = EDGE_TAGS[tag]
        slots, m = len(edge.accepts), edge.residual_size
        expect(words, slots + edge.measured_size + m * (m + 1) // 2)
        vertices = tuple(integer(word) for word in words[1 : 1 + slots])
        values = numbers(words[1 + slots :])
        measured = _with_unit_quaternion(values[: edge.measured_size], edge.measured_size)
        return _Edge(line, vertices, measured, values[edge.measured_size :], self.label)

    def declare_all(self) -> None:
        """A file of edges alone: its vertices are those the edges name, in order of id and without values."""
        self.has_values = False
        kinds: dict[int, str] = {}
        tags = {kind: tag for tag, kind in VERTEX_TAGS.items()}
        for tag, edges in self.edges.items():
            for edge in edges:
                for vertex, accepted in zip(edge.vertices, EDGE_TAGS[tag].accepts, strict=True):
                    kinds.setdefault(vertex, tags[accepted[0]])
        nowhere = {"VERTEX_SE3:QUAT": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]}
        for vertex in sorted(kinds):
            tag = kinds[vertex]
            self.vertices[vertex] = (tag, nowhere.get(tag, [0.0] * VERTEX_TAGS[tag].size))

    def graph(self, relative_pose: EdgeType) -> G2oFile:
        graph = Graph()
        at: dict[int, int] = {}
        for file_id, (tag, value) in self.vertices.items():
            at[file_id] = graph.add_vertex(VERTEX_TAGS[tag], value)
        poses = sorted(file_id for file_id, (tag, _) in self.vertices.items() if VERTEX_TAGS[tag] in (SE2, SE3))
        follows = dict(itertools.pairwise(poses))
        for tag, edges in self.edges.items():
            edge_type = relative_pose if tag == "EDGE_SE2" else EDGE_TAGS[tag]
            for label, members in _by_label(tag, self._known(tag, edges), follows).items():
                self._add(graph, edge_type, label, members, at)
        fixed = []
        for line, file_id in self.fixed:
            if file_id in at:
                fixed.append(at[file_id])
            else:
                self.refuse(line, f"FIX names vertex {file_id}, which is not declared")
        return G2oFile(graph, list(at), fixed, self.unknown, self.skipped, self.text.raw, self.has_values)

    def _known(self, tag: str, edges: Sequence[_Edge]) -> Iterator[_Edge]:
        """Edges whose vertices exist and are of the right kind, and whose information is positive definite."""
        for edge in edges:
            for file_id, kinds in zip(edge.vertices, EDGE_TAGS[tag].accepts, strict=True):
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
                    continue
                yield edge

    def _add(self, graph: Graph, edge_type: EdgeType, label: str, edges: list[_Edge], at: dict[int, int]) -> None:
        information = _symmetric(np.array([e.information for e in edges]), edge_type.residual_size)
        if edge_type in _HALVED and not self.text.raw:
            information *= np.outer(_HALVED[edge_type], _HALVED[edge_type])
        good = list(range(len(edges)))
        try:
            noise = Gaussian.from_information(information)
        except NoiseError:
            good = []
            for k, edge in enumerate(edges):
                try:
                    Gaussian.from_information(information[k])
                    good.append(k)
                except NoiseError as error:
                    self.refuse(edge.line, str(error).replace("information 0", "information", 1))
            if not good:
                return
            noise = Gaussian.from_information(information[good])
        graph.add_edges(
            edge_type,
            [[at[v] for v in edges[k].vertices] for k in good],
            [edges[k].measured for k in good],
            noise,
            label,
        )


def read_g2o(
    path: Path | str,
    *,
    error_map: str = "relative",
    lenient: bool = False,
    raw: bool = False,
    dialect: str | None = None,
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
    dialect : ``g2o``, ``toro`` or ``gtsam``: refuse lines of the others, and guess at nothing; by default each line is
        known by its tag

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
    numbered = list(lines(path))
    own_numbers = dialect == "gtsam" or any(text.split(None, 1)[:1] == ["LANDMARK"] for _, text in numbered)
    reader = _Reader(path.name, lenient, Text(dialect, raw, LANDMARK_IDS_FROM if own_numbers else 0))
    for number, text in numbered:
        reader.take(number, text)
    if not reader.vertices:
        reader.declare_all()
    if not reader.vertices:
        raise FormatError(f"{path.name}: no vertex in it; is it a graph?")
    return reader.graph(ERROR_MAPS[error_map])


def write_g2o(path: Path | str, file: G2oFile, values: Values) -> int:
    """Write a graph; ``values(ids)`` gives the numbers of vertices of one kind, e.g. ``Solver.estimate``.

    17 significant digits: what is read back is what was written. The information of an edge is multiplied by its
    weight; one of weight 0 is out of the problem, and left out. Returns how many were.
    """
    write_text(path, "\n".join(graph_lines(file, values)) + "\n")
    return weightless(file.graph)


def weightless(graph: Graph) -> int:
    """How many edges are of weight 0."""
    return sum(int((table.weight.values == 0.0).sum()) for table in graph.tables.values())


def write_text(path: Path | str, text: str) -> None:
    """Write a file, gzipped where its name ends so. Raises FormatError."""
    content = text.encode()
    try:
        Path(path).write_bytes(gzip.compress(content, mtime=0) if is_gzipped(Path(path)) else content)
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None


def graph_lines(file: G2oFile, values: Values | None) -> list[str]:
    """The lines of a g2o file; without values, those of the edges alone."""
    out = [] if values is None else _vertex_lines(file, values)
    edges = sorted(_edge_lines(file), key=lambda edge: edge[:2])
    for label, group in itertools.groupby(edges, key=lambda edge: edge[0]):
        members = [text for _, _, text in group]
        out += [f"# {label} {len(members)} class {file.graph.labels[label]}", *members]
    return out + [f"FIX {file.ids[vertex]}" for vertex in file.fixed] + file.unknown


def _vertex_lines(file: G2oFile, values: Values) -> list[str]:
    graph = file.graph
    tag_of_kind = {kind: tag for tag, kind in VERTEX_TAGS.items()}
    rows: list[tuple[int, str]] = []
    for code, kind in enumerate(graph.kinds):
        members = np.flatnonzero(graph.kind.values == code).tolist()
        if kind not in tag_of_kind:
            raise FormatError(f"g2o has no tag for a vertex {kind.name}")
        for vertex, value in zip(members, values(members).tolist(), strict=True):
            rows.append((vertex, f"{tag_of_kind[kind]} {file.ids[vertex]} {_text(value)}"))
    return [row for _, row in sorted(rows)]


def _edge_lines(file: G2oFile) -> Iterator[tuple[int, int, str]]:
    """Code of the label, id and line of each edge in the problem."""
    tag_of_edge = {edge: tag for tag, edge in EDGE_TAGS.items()} | {INVERSE_RELATIVE_POSE: "EDGE_SE2"}
    for edge_type, table in file.graph.tables.items():
        if edge_type not in tag_of_edge:
            raise FormatError(f"g2o has no tag for an edge {edge_type.name}")
        root = table.sqrt_information.values
        upper = np.triu_indices(edge_type.residual_size)
        full = np.swapaxes(root, 1, 2) @ root * table.weight.values[:, None, None]
        if edge_type in _HALVED and not file.raw:
            full /= np.outer(_HALVED[edge_type], _HALVED[edge_type])
        information = full[:, upper[0], upper[1]]
        for row in np.flatnonzero(table.weight.values != 0.0).tolist():
            ends = " ".join(str(file.ids[v]) for v in table.vertices.values[row].tolist())
            numbers = _text([*table.measured.values[row].tolist(), *information[row].tolist()])
            label, edge = int(table.label.values[row]), int(table.id.values[row])
            yield label, edge, f"{tag_of_edge[edge_type]} {ends} {numbers}"


def _with_unit_quaternion(numbers: list[float], size: int) -> list[float]:
    """The last four of a pose in space, (x, y, z, w), brought to unit length."""
    if size != SE3.size:
        return numbers
    square = sum(q * q for q in numbers[3:])
    if square == 0.0:
        raise FormatError("the quaternion is zero")
    if abs(square - 1.0) <= _UNIT:
        return numbers
    return numbers[:3] + [q / square**0.5 for q in numbers[3:]]


def _by_label(tag: str, edges: Iterable[_Edge], follows: dict[int, int]) -> dict[str, list[_Edge]]:
    groups: dict[str, list[_Edge]] = {}
    for edge in edges:
        groups.setdefault(edge.label or _usual_label(tag, edge, follows), []).append(edge)
    return groups


def _usual_label(tag: str, edge: _Edge, follows: dict[int, int]) -> str:
    if tag in _RELATIVE:
        return "odometry" if follows.get(min(edge.vertices)) == max(edge.vertices) else "closures"
    return "priors" if tag == "EDGE_PRIOR_SE2" else "landmarks"


def _symmetric(upper: Array, size: int) -> Array:
    full = np.zeros((len(upper), size, size))
    i, j = np.triu_indices(size)
    full[:, i, j] = upper
    full[:, j, i] = upper
    return full


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(n)) for n in numbers)
