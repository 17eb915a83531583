"""TUM trajectories: ``stamp x y z qx qy qz qw``, seconds and metres."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.g2o_writer import write_text
from graph_slam_ros.formats.graph_file import G2oFile, Values
from graph_slam_ros.graph import SE2, SE3, Graph
from graph_slam_ros.lie import se3

NS = 1_000_000_000


def tum_text(stamps_ns: Sequence[int], poses: NDArray[np.float64]) -> str:
    """Poses in the plane (n, 3) or in space (n, 7) as TUM lines; stamps keep their nanoseconds."""
    rows = zip(stamps_ns, se3.in_space(poses).tolist(), strict=True)
    return "".join(f"{stamp // NS}.{stamp % NS:09d} {' '.join(map(repr, pose))}\n" for stamp, pose in rows)


def write_trajectory(path: Path, file: G2oFile, values: Values) -> None:
    """Write the poses of a graph, but not its landmarks, in order of id. The id is the stamp, in seconds.

    Raises
    ------
    FormatError
        The graph has no poses or poses of two kinds, or the file cannot be written.
    """
    kinds = [kind for kind in (SE2, SE3) if kind in file.graph.kinds]
    if len(kinds) != 1:
        raise FormatError(f"{path}: a trajectory needs poses of one kind, and this graph has {len(kinds)} kinds")
    landmarks, every = _only_seen(file.graph), file.graph.vertex_ids.since().tolist()
    poses = [vertex for vertex in every if file.graph.kind_of(vertex) is kinds[0] and vertex not in landmarks]
    poses.sort(key=lambda vertex: file.ids[vertex])
    write_text(path, tum_text([NS * file.ids[vertex] for vertex in poses], values(poses)))


def _only_seen(graph: Graph) -> set[int]:
    """Landmarks, also full poses: vertices at the far end of sightings, and in no other edge."""
    seen: set[int] = set()
    others: set[int] = set()
    for table in graph.tables.values():
        of_landmark = np.array([label == "landmarks" for label in graph.labels])[table.label.values]
        ends = table.vertices
        seen.update(ends[of_landmark, -1].tolist())
        others.update(ends[of_landmark, :-1].ravel().tolist(), ends[~of_landmark].ravel().tolist())
    return seen - others
