"""Reading g2o text files: poses and point landmarks in the plane and in space, relative poses, sightings, priors, FIX.

Information matrices are taken as they are, but for one thing: g2o measures a rotation in space by the vector part of
its quaternion, which is half the rotation vector, so a rotation's information counts a quarter in our residual.
A sighting in space is measured in a sensor's frame, and names the parameter that says where that is on the robot; in
the graph it is in the robot's. Unknown tags are kept, word for word, and written back. TORO's, iSAM's and GTSAM's texts
are read as well (``dialects``), and files without vertex lines.
"""

import itertools
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from graph_slam_ros import edge_tags
from graph_slam_ros import graph as graphs
from graph_slam_ros.errors import FormatError, NoiseError
from graph_slam_ros.formats.dialects import DIALECTS, LANDMARK_IDS_FROM, Text, in_g2o_words, may_be_roots, symmetric
from graph_slam_ros.formats.graph_file import AT_OFFSET, HALVED, NO_EDGES, G2oFile, moved, tags_of
from graph_slam_ros.formats.strict import expect, foreign, integer, lines, numbers
from graph_slam_ros.graph import SE2, SE3, EdgeType, Gaussian, Graph, VertexKind
from graph_slam_ros.lie import se3
from graph_slam_ros.typing import Array

_RELATIVE = ("EDGE_SE2", "EDGE_SE3:QUAT")
_CLASS = re.compile(r"#\s+(?:\d+\s+\d+\s+)?class\s+(\S+)\s*", re.ASCII)  # our comment, the label of what follows it
_COMMENTS = ("%", "//", ";")  # begin lines of other programs' comments
_UNIT = 1e-12  # a squared quaternion norm this near to 1 is left as it was written
ERROR_MAPS = {"relative": graphs.RELATIVE_POSE, "seed": graphs.INVERSE_RELATIVE_POSE}


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
        self.vertices: dict[int, tuple[VertexKind, list[float]]] = {}
        self.edges: dict[str, list[_Edge]] = {tag: [] for tag in edge_tags.EDGE_TAGS}
        self.fixed: list[tuple[int, int]] = []
        self.offsets: dict[int, se3.Pose] = {}
        self.unknown, self.skipped, self.switched = list[str](), list[str](), list[str]()
        self.repaired, self.bare = list[int](), list[int]()  # lines whose information is not definite, or not there
        self.has_values, self.label, self.assumed = True, "", 0  # the first line that may have been meant otherwise

    def refuse(self, line: int, why: str) -> None:
        message = f"{self.name}:{line}: {why}"
        if not self.lenient:
            raise FormatError(message)
        self.skipped.append(message)

    @cached_property
    def plugin_tags(self) -> frozenset[str]:
        """Tags of plugins, looked up at the first tag that is not built in."""
        return edge_tags.plugin_tags()

    def read_line(self, line: int, text: str) -> None:
        words = text.partition("#")[0].split()
        if not words or words[0].startswith(_COMMENTS):
            labelled = _CLASS.fullmatch(text.strip())
            self.label = labelled[1] if labelled else self.label
            return
        try:
            self.assumed = self.assumed or line * may_be_roots(words, self.text)
            self.switched += words[:1] if words[0] in edge_tags.SWITCHED else ()
            words = in_g2o_words(words, self.text)
            tag = words[0]
            if tag in edge_tags.VERTEX_TAGS:
                self._vertex(edge_tags.VERTEX_TAGS[tag], words)
            elif tag == edge_tags.OFFSET:
                self._offset(words)
            elif tag == "FIX":
                if len(words) < 2:
                    raise FormatError("FIX names no vertex")
                self.fixed += [(line, integer(word)) for word in words[1:]]
            elif edge_tags.built_in(tag) or tag in self.plugin_tags:
                self.edges.setdefault(tag, []).append(self._edge(line, tag, words))
            else:
                self.unknown.append(text.strip())
        except (FormatError, NoiseError) as error:
            tag = text.split()[0]
            said = f"{tag}, read as {words[0]}," if tag != words[0] else tag
            self.refuse(line, str(error).replace(words[0], said, 1))

    def _vertex(self, kind: VertexKind, words: list[str]) -> None:
        expect(words, 1 + kind.size)
        vertex, value = integer(words[1]), _with_unit_quaternion(numbers(words[2:]), 3 if kind is SE3 else None)
        if self.vertices.setdefault(vertex, (kind, value)) != (kind, value):
            raise FormatError(f"vertex {vertex} was declared before, with other values")

    def _offset(self, words: list[str]) -> None:
        expect(words, 1 + SE3.size)
        x, y, z, *q = _with_unit_quaternion(numbers(words[2:]), 3)
        number, pose = integer(words[1]), (x, y, z, q[0], q[1], q[2], q[3])
        if self.offsets.setdefault(number, pose) != pose:
            raise FormatError(f"parameter {number} was declared before, with other values: give each its own number")

    def _edge(self, line: int, tag: str, words: list[str]) -> _Edge:
        edge = edge_tags.edge_of(tag)
        m, from_offset = edge.residual_size, tag in AT_OFFSET
        sizes = edge.measured_size, edge.measured_size - len(edge.tail)  # the last may be left out
        head, upper = len(edge.accepts) + from_offset, np.triu_indices(m)
        given, counts = len(words) - 1 - head, (len(upper[0]), m * m, 0)  # upper triangle, whole matrix, none
        count = next((count for count in counts if given - count in sizes), counts[0])
        size = given - count if given - count in sizes else edge.measured_size
        expect(words, head + size + count)
        self.bare += [line] * (not count)
        vertices = tuple(integer(word) for word in words[1 : 1 + len(edge.accepts)])
        values = numbers(words[1 + head :])
        measured = _with_unit_quaternion(values[:size], _quaternion_at(edge))
        measured += edge.tail[size - edge.measured_size + len(edge.tail) :]
        offset = integer(words[head]) if from_offset else None
        sigmas = HALVED[edge] if edge in HALVED and not self.text.raw else np.ones(m)
        information = values[size:] or np.diag(sigmas**-2.0)[upper].tolist()
        if count > len(upper[0]):
            whole = np.reshape(information, (m, m))
            if not np.allclose(whole, whole.T):
                raise FormatError(f"its information has {count} numbers, and is not symmetric")
            information = whole[upper].tolist()
        return _Edge(line, vertices, measured, information, self.label, offset)

    def declare_all(self) -> None:
        """Declare the vertices of a file of edges alone: those that edges name, in order of id, without values."""
        self.has_values = False
        kinds: dict[int, VertexKind] = {}
        for tag, edges in self.edges.items():
            for edge in edges:
                for vertex, accepted in zip(edge.vertices, edge_tags.edge_of(tag).accepts, strict=True):
                    kinds.setdefault(vertex, accepted[0])
        for vertex, kind in sorted(kinds.items(), key=lambda item: item[0]):
            self.vertices[vertex] = (kind, [0.0] * (kind.size - 1) + [float(kind is SE3)])

    def graph(self, relative_pose: EdgeType) -> G2oFile:
        graph = Graph()
        at: dict[int, int] = {}
        for kind, run in itertools.groupby(self.vertices.items(), key=lambda item: item[1][0]):
            values = {file_id: value for file_id, (_, value) in run}
            at.update(zip(values, graph.add_vertices(kind, list(values.values())).tolist(), strict=True))
        poses = sorted(file_id for file_id, (kind, _) in self.vertices.items() if kind in (SE2, SE3))
        follows = {one: next_ for one, next_ in itertools.pairwise(poses) if one >> 56 == next_ >> 56}  # of one robot
        for (tag, kind), other in edge_tags.OF_POSES.items():
            of_poses = [e for e in self.edges[tag] if self._kind(e.vertices[0]) is kind]
            self.edges[tag] = [e for e in self.edges[tag] if self._kind(e.vertices[0]) is not kind]
            tail = edge_tags.EDGE_TAGS[other].tail
            self.edges[other] += [replace(e, measured=[*e.measured, *tail]) for e in of_poses]
        seen_from: dict[int, int] = {}
        for tag, edges in self.edges.items():
            edge_type = relative_pose if tag == "EDGE_SE2" else edge_tags.edge_of(tag)
            groups: dict[str, list[_Edge]] = {}
            for edge in self._known(tag, edges):
                groups.setdefault(edge.label or _usual_label(tag, edge, follows), []).append(edge)
            for label, members in groups.items():
                seen_from |= self._add(graph, edge_type, label, members, at)
        fixed = []
        for line, file_id in self.fixed:
            if file_id in at:
                fixed.append(at[file_id])
            else:
                self.refuse(line, f"FIX names vertex {file_id}, which is not declared")
        own, notes = (graph, list(at), fixed, self.offsets, seen_from, self.unknown), list(self._notes())
        return G2oFile(*own, self.skipped, self.text.raw, self.has_values, notes)

    def _kind(self, file_id: int) -> VertexKind | None:
        return self.vertices[file_id][0] if file_id in self.vertices else None

    def _notes(self) -> Iterator[str]:
        every = sum(len(edges) for edges in self.edges.values())
        if self.repaired:
            yield (
                f"{self.name}:{self.repaired[0]}: {len(self.repaired)} of {every} information matrices are not positive"
                " definite as printed: weights from the traces of position and rotation are used instead"
            )
        if self.bare:
            bare = f"{len(self.bare)} of {every} edges have no information: the identity is used"
            bare = f"{self.name}:{self.bare[0]}: {bare}"
            if len(self.bare) == every:
                yield f"{bare}, so all of them weigh the same, a metre as much as a radian"
            else:
                self.skipped.append(f"{bare}, whatever the others have: was the line cut off?")
        for tag in tags_of(self.switched):
            yield f"{tag} are read as if they had no switch: --loss cauchy lets go of false ones"
        if kept := tags_of(line for line in self.unknown if line.startswith(NO_EDGES)):
            yield f"kept as they are, and not used: {', '.join(kept)}"
        if self.assumed:
            toro = "EDGE3 is read as TORO's information (--from toro says that it is)"
            yield f"{self.name}:{self.assumed}: {toro}; iSAM writes its square root: --from isam"

    def _known(self, tag: str, edges: Sequence[_Edge]) -> Iterator[_Edge]:
        for edge in edges:
            if fault := self._fault(tag, edge):
                self.refuse(edge.line, f"{fault} (--lenient leaves it out)")
            else:
                yield edge

    def _fault(self, tag: str, edge: _Edge) -> str:
        """Return why an edge cannot be used, by its vertices and the place of its sensor; empty where it can."""
        for file_id, kinds in zip(edge.vertices, edge_tags.edge_of(tag).accepts, strict=True):
            if (kind := self._kind(file_id)) is None:
                return f"edge to vertex {file_id}, which is not declared"
            if kind not in kinds:
                other = next(tag for tag, of in edge_tags.VERTEX_TAGS.items() if of is kind)
                return f"{tag} to vertex {file_id}, which is a {other}"
        if len(set(edge.vertices)) < len(edge.vertices):
            return f"edge from vertex {edge.vertices[0]} to itself"
        number = edge.offset or 0  # some files leave out parameter 0, which is then the robot's frame itself
        if number and number not in self.offsets:
            others = {e.offset or 0 for at in AT_OFFSET for e in self.edges[at]} - {0, number, *self.offsets}
            too = f" (nor are {', '.join(map(str, sorted(others)[:3]))}{' ...' * (len(others) > 3)})" if others else ""
            mend = f"a line {edge_tags.OFFSET} {number} 0 0 0 0 0 0 1 puts its sensor at the robot's origin"
            return f"parameter {number}, which is not declared{too}: {mend}"
        if tag == "EDGE_SE3_PRIOR" and self.offsets.get(number, se3.IDENTITY) != se3.IDENTITY:
            return f"{tag} of a sensor that is not at the robot's origin"
        return ""

    def _add(
        self, graph: Graph, edge_type: EdgeType, label: str, edges: list[_Edge], at: dict[int, int]
    ) -> dict[int, int]:
        """Add edges to the graph; returns the parameters of those that have one."""
        information = symmetric([e.information for e in edges])
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
        if edge_type is graphs.LANDMARK_POSITION_3D:
            offsets = [self.offsets.get(edge.offset or 0, se3.IDENTITY) for edge in edges]
            measured, noise = moved(measured, noise.sqrt_information, offsets)
        ids = graph.add_edges(edge_type, [[at[v] for v in edge.vertices] for edge in edges], measured, noise, label)
        seen_from = zip(ids.tolist(), edges, strict=True)
        return {edge_id: edge.offset for edge_id, edge in seen_from if edge.offset is not None}

    def _root(self, edge: _Edge, information: Array, lengths: int, is_prior: bool) -> Array | None:
        """The root of one information matrix, repaired where print has rounded it; None if the edge is left out."""
        try:
            return Gaussian.from_information(information).sqrt_information
        except NoiseError as error:
            if is_prior:  # as a sum of fixes, it may say nothing in some directions
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
        seen = ", ".join(tags_of(reader.unknown)[:8])
        what = foreign(path) or ("; is it a graph?" if not seen else f" of a kind that is known: there are {seen}")
        raise FormatError(f"{path.name}: no vertex in it{what}")
    return reader.graph(ERROR_MAPS[error_map])


def by_traces(information: Array, lengths: int) -> Array | None:
    """Weights in place of an information matrix (m, m) that is not positive definite, as print may leave it.

    As SE-Sync does for all: one weight for its first ``lengths`` numbers and one for the rest, each the mean of that
    part of the diagonal. None where a number of the diagonal is not positive.
    """
    diagonal = np.diag(information).copy()
    if not np.isfinite(information).all() or not (diagonal > 0.0).all():
        return None
    for block in filter(len, (diagonal[:lengths], diagonal[lengths:])):
        block[:] = block.mean()
    return np.diag(diagonal)


def _quaternion_at(edge: EdgeType) -> int | None:
    if edge in (graphs.RELATIVE_POSE_3D, graphs.POSE_PRIOR_3D):
        return 3
    if edge is graphs.ATTITUDE_PRIOR_3D:
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


def _usual_label(tag: str, edge: _Edge, follows: dict[int, int]) -> str:
    if tag in _RELATIVE:
        return "odometry" if follows.get(min(edge.vertices)) == max(edge.vertices) else "closures"
    return "priors" if len(edge_tags.edge_of(tag).accepts) == 1 else "landmarks"
