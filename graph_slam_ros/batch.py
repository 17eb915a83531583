"""A whole graph solved in one call: where it starts, what holds it, and what came out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import Graph
from graph_slam_ros.solver import Report, Settings, Solver, initial_values

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Solution:
    """A solved graph.

    Attributes
    ----------
    file : the graph, and what a file says of it: ``write_g2o(path, solution.file, solution.solver.estimate)``
    solver : has the estimates and marginals of all vertices, by their ids in the graph
    report : how it went, and why it stopped
    start : where the initial values were from: ``file``, ``tree``, ``chordal`` or ``online``
    """

    file: G2oFile
    solver: Solver
    report: Report
    start: str

    @property
    def poses(self) -> Array:
        """Estimates of all poses in order of id: (n, 3) as x, y, theta, or (n, 7) as x, y, z and quaternion xyzw."""
        return self.solver.estimate(_vertices(self.file.graph, poses=True))

    @property
    def points(self) -> Array:
        """Estimates of all point landmarks in order of id, (n, 2) or (n, 3)."""
        return self.solver.estimate(_vertices(self.file.graph, poses=False))


def optimize(source: Graph | G2oFile | Path | str, settings: Settings | None = None, *, init: str = "file") -> Solution:
    """Solve a whole graph: of a file, as read from one, or made by hand.

    What FIX lines name is held; where there are none, and priors do not fix both position and heading, the first pose
    is.

    Parameters
    ----------
    init : where to start: ``file`` (initial values as they are; the tree where a file has none), ``tree`` (poses
        composed along a spanning tree), ``chordal``, or ``online`` (pose after pose, in order of id). Without
        poses it is always the first

    Raises
    ------
    FormatError
        The file cannot be read.
    GaugeError, SingularError
        The edges leave a vertex open.
    """
    if isinstance(source, Graph):
        file = G2oFile(source, list(range(source.vertex_count)))
    else:
        file = source if isinstance(source, G2oFile) else read_g2o(source)
    solver, start = started(file, init)
    take_whole(solver, file)
    return Solution(file, solver, solver.optimize(settings), start)


def started(file: G2oFile, init: str) -> tuple[Solver, str]:
    """A solver with initial values, and where they are from: edges alone leave nothing but their tree."""
    root, start = _root(file), init if file.has_values or init != "file" else "tree"
    if root is None or not _is_pose(file.graph, root):
        start = "file"
    solver = Solver(file.graph)
    in_time = sorted(range(file.graph.vertex_count), key=lambda vertex: file.ids[vertex])
    solver.start_at(initial_values(file.graph, start, root or 0, in_time))
    return solver, start


def take_whole(solver: Solver, file: G2oFile) -> None:
    """Give a solver all of a graph, and hold what FIX lines name; the first pose where nothing else fixes it."""
    graph = file.graph
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    for vertex in file.fixed:
        solver.hold(vertex)
    root = _root(file)
    if root is not None and not solver.is_fixed():
        solver.hold(root)


def _root(file: G2oFile) -> int | None:
    """The first pose of a FIX line, or that of the least id; where there are no poses, a landmark."""
    if not file.graph.vertex_count:
        return None
    of_no_pose = [not _is_pose(file.graph, v) for v in range(file.graph.vertex_count)]
    fixed = [v for v in file.fixed if not of_no_pose[v]]
    return fixed[0] if fixed else min(range(file.graph.vertex_count), key=lambda v: (of_no_pose[v], file.ids[v]))


def _is_pose(graph: Graph, vertex: int) -> bool:
    return graph.kind_of(vertex).name.startswith("SE")


def _vertices(graph: Graph, *, poses: bool) -> list[int]:
    return [v for v in range(graph.vertex_count) if _is_pose(graph, v) is poses]
