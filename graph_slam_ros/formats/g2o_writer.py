"""Writing g2o text files."""

import gzip
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from graph_slam_ros.edge_tags import OFFSET, VERTEX_TAGS, tag_of
from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.formats.graph_file import AT_OFFSET, HALVED, G2oFile, Values, moved
from graph_slam_ros.formats.strict import is_gzipped
from graph_slam_ros.graph import LANDMARK_POSITION_3D, POSE_PRIOR_3D, Graph
from graph_slam_ros.lie import se3


def write_g2o(path: Path | str, file: G2oFile | Graph, values: Values | None = None) -> None:
    """Write a graph; ``values(ids)`` gives the numbers of vertices of one kind, e.g. ``Solver.estimate``.

    Without, the initial values are written. The ids of a ``Graph`` of one's own are its vertices' numbers.
    17 significant digits: what is read back is what was written. The information of an edge is multiplied by its
    weight; one of weight 0 is out of the problem, and left out.
    """
    is_of_graph = isinstance(path, str | Path) and isinstance(file, G2oFile | Graph)
    if not is_of_graph or not (values is None or callable(values)):
        raise FormatError(
            "write_g2o(PATH, GRAPH, VALUES): PATH first, then a Graph or solution.file, then solver.estimate"
        )
    whole = file if isinstance(file, G2oFile) else G2oFile(file, list(range(file.vertex_ids.next)))
    values = values or (lambda ids: np.array([whole.graph.vertex(vertex).initial for vertex in ids]))
    write_text(path, "\n".join(graph_lines(whole, values)) + "\n")


def write_text(path: Path | str, text: str) -> None:
    """Write a file completely or not at all, gzipped if its suffix says so. Raises FormatError."""
    path, content = Path(path), text.encode()
    try:
        write_whole(path, gzip.compress(content, mtime=0) if is_gzipped(path) else content)
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None


def graph_lines(file: G2oFile, values: Values) -> list[str]:
    """The lines of a g2o file."""
    out = _vertex_lines(file, values)
    edges = sorted(_edge_lines(file), key=lambda edge: edge[:2])
    # A label's code and the number of its edges come first since GTSAM looks for two integers behind every tag in the
    # plane: where a line has none (a FIX line as well), it reads no edge after it.
    for label, group in itertools.groupby(edges, key=lambda edge: edge[0]):
        members = [text for _, _, text in group]
        out += [f"# {label} {len(members)} class {file.graph.labels[label]}", *members]
    return _offset_lines(file) + out + [f"FIX {file.ids[vertex]}" for vertex in file.fixed] + file.unknown


def _offset_lines(file: G2oFile) -> list[str]:
    """The parameters. Number 0, the robot's own frame, is added if edges name it."""
    named = any(edge in file.graph.tables for edge in (LANDMARK_POSITION_3D, POSE_PRIOR_3D))
    offsets = ({0: se3.IDENTITY} if named else {}) | file.offsets
    return [f"{OFFSET} {number} {_text(offset)}" for number, offset in sorted(offsets.items())]


def _vertex_lines(file: G2oFile, values: Values) -> list[str]:
    graph = file.graph
    tag_of_kind = {kind: tag for tag, kind in VERTEX_TAGS.items()}
    rows: list[tuple[int, str]] = []
    every = [vertex for vertex in graph.vertex_ids.since().tolist() if vertex not in file.absent]
    for kind in graph.kinds:
        members = [vertex for vertex in every if graph.kind_of(vertex) is kind]
        if kind not in tag_of_kind:
            raise FormatError(f"g2o has no tag for a vertex {kind.name}")
        for vertex, value in zip(members, values(members).tolist(), strict=True):
            rows.append((vertex, f"{tag_of_kind[kind]} {file.ids[vertex]} {_text(value)}"))
    return [row for _, row in sorted(rows)]


def _edge_lines(file: G2oFile) -> Iterator[tuple[int, int, str]]:
    """Code of the label, id and line of each edge in the problem."""
    for edge_type, table in file.graph.tables.items():
        tag, head = tag_of(edge_type), edge_type.measured_size - len(edge_type.tail)
        root, measured = table.sqrt_information.values, table.measured.values
        ids, labels, ends = (of.tolist() for of in (table.ids, table.label.values, table.vertices))
        numbers = [file.seen_from.get(edge, 0) for edge in ids]
        if edge_type is LANDMARK_POSITION_3D:
            back = [se3.inverse(file.offsets.get(number, se3.IDENTITY)) for number in numbers]
            measured, noise = moved(measured, root, back)
            root = noise.sqrt_information
        upper = np.triu_indices(edge_type.residual_size)
        full = np.swapaxes(root, 1, 2) @ root * np.reshape(table.weight.values, (-1, 1, 1))
        if edge_type in HALVED and not file.raw:
            full /= np.outer(HALVED[edge_type], HALVED[edge_type])
        information = full[:, upper[0], upper[1]]
        for row in np.flatnonzero(table.weight.values != 0.0).tolist():
            words = [tag, *(str(file.ids[v]) for v in ends[row])]
            words += [str(numbers[row])] * (tag in AT_OFFSET)
            seen = measured[row].tolist()
            seen = seen[:head] if tuple(seen[head:]) == edge_type.tail else seen
            words.append(_text([*seen, *information[row].tolist()]))
            yield labels[row], ids[row], " ".join(words)


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(n)) for n in numbers)
