"""Writing graphs in other formats: g2o, TORO, GTSAM, and the poses alone as a TUM trajectory."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graph_slam_ros.edge_tags import VERTEX_TAGS, tag_of
from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.dialects import LANDMARK_IDS_FROM, Text, from_g2o_words
from graph_slam_ros.formats.g2o_writer import graph_lines, weightless, write_text
from graph_slam_ros.formats.graph_file import G2oFile, Values
from graph_slam_ros.formats.strict import ending
from graph_slam_ros.formats.tum import NS, tum_text
from graph_slam_ros.graph import R2, SE2, SE3, Graph, VertexKind

ENDINGS = {".g2o": "g2o", ".toro": "toro", ".graph": "toro", ".gtsam": "gtsam", ".tum": "tum"}
NAMES = {"g2o": "g2o", "toro": "TORO", "gtsam": "GTSAM's text", "tum": "TUM"}


@dataclass(frozen=True, slots=True)
class Written:
    """The result of writing: the number of vertices and edges, and a line for what the format cannot represent."""

    vertices: int
    edges: int
    lost: list[str]


def format_of(path: Path) -> str:
    """The format by the suffix of the name. Raises FormatError."""
    try:
        return ENDINGS[ending(path)]
    except KeyError:
        raise FormatError(f"{path}: its ending is none of {', '.join(ENDINGS)}; --to names the format") from None


def write_graph(path: Path, file: G2oFile, values: Values | None, target: str) -> Written:
    """Write a graph in a format of ``ENDINGS``; without values, its edges alone.

    In TUM a vertex's id is its stamp, in seconds, since a graph has no stamps; edges and landmarks are no part of a
    trajectory, and not counted as lost. The labels of edges are in g2o alone, as comments; in the others a reader gives
    the usual ones. Edges of weight 0 are out of the problem: they are left out, and counted.

    Raises
    ------
    FormatError
        The format is not written, or can say nothing of the graph, or the file cannot be written.
    """
    if target not in NAMES:
        raise FormatError(f"format {target!r} is not written: choose {', '.join(NAMES)}")
    if target == "tum":
        return _write_trajectory(path, file, values)
    lines, missing = graph_lines(file, values), Counter[str]()
    if target != "g2o":
        lines, missing = _translated(lines, Text(target, file.raw, _landmarks_from(file, target)))
    left_out = weightless(file.graph)
    edges = file.graph.edge_count - left_out - sum(missing[tag] for tag in set(map(tag_of, file.graph.tables)))
    if file.graph.edge_count and not edges:
        raise FormatError(f"{path}: {NAMES[target]} can say no edge of this graph")
    write_text(path, "\n".join(lines) + "\n")
    lost = [f"{left_out} edges of weight 0"] if left_out else []
    if missing:
        lost.append(f"{', '.join(f'{n} {tag}' for tag, n in missing.items())}: {NAMES[target]} has no such line")
    return Written(file.graph.vertex_count - sum(n for tag, n in missing.items() if tag in VERTEX_TAGS), edges, lost)


def _translated(lines: list[str], text: Text) -> tuple[list[str], Counter[str]]:
    """The lines in another format, and the number of lines of each tag that it cannot represent."""
    out: list[str] = []
    missing: Counter[str] = Counter()
    for line in lines:
        words = line.split()
        if words[0] == "#":  # there are readers that give up at a comment, and say nothing
            continue
        try:
            translated = from_g2o_words(words, text)
        except FormatError as error:
            raise FormatError(f"{' '.join(words[:3])}: {error}") from None
        if translated is None:
            missing[words[0]] += 1
        else:
            out.append(" ".join(translated))
    return out, missing


def _landmarks_from(file: G2oFile, target: str) -> int:
    """Landmarks that were read from GTSAM's text get their original numbers back."""
    points = [file.ids[vertex] for vertex in _of_kind(file.graph, R2)]
    return LANDMARK_IDS_FROM if target == "gtsam" and points and min(points) >= LANDMARK_IDS_FROM else 0


def _write_trajectory(path: Path, file: G2oFile, values: Values | None) -> Written:
    """Poses in order of id."""
    kinds = [kind for kind in (SE2, SE3) if kind in file.graph.kinds]
    if values is None or len(kinds) != 1:
        raise FormatError(f"{path}: a trajectory needs poses of one kind, and this graph has {len(kinds)} kinds")
    landmarks = _only_seen(file.graph)
    poses = [vertex for vertex in _of_kind(file.graph, kinds[0]) if vertex not in landmarks]
    poses.sort(key=lambda vertex: file.ids[vertex])
    write_text(path, tum_text([NS * file.ids[vertex] for vertex in poses], values(poses)))
    return Written(len(poses), 0, [])


def _of_kind(graph: Graph, kind: VertexKind) -> list[int]:
    members: list[int] = np.flatnonzero([graph.kinds[code] is kind for code in graph.kind.values]).tolist()
    return members


def _only_seen(graph: Graph) -> set[int]:
    """Landmarks, also full poses: vertices at the far end of sightings, and in no other edge."""
    seen: set[int] = set()
    others: set[int] = set()
    for table in graph.tables.values():
        of_landmark = np.array([label == "landmarks" for label in graph.labels])[table.label.values]
        ends = table.vertices.values
        seen.update(ends[of_landmark, -1].tolist())
        others.update(ends[of_landmark, :-1].ravel().tolist(), ends[~of_landmark].ravel().tolist())
    return seen - others
