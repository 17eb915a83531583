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
    start : where the initial values were from: ``file``, ``tree`` or ``chordal``
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

    What FIX lines name is held; where there are none and no priors either, the first pose is.

    Parameters
    ----------
    init : where to start: ``file`` (initial values as they are; the tree where a file has none), ``tree`` (poses
        composed along a spanning tree), ``chordal``, or ``online`` (pose after pose, in order of id)

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
    start = init if file.has_values or init != "file" else "tree"
    solver = Solver(file.graph)
    in_time = sorted(range(file.graph.vertex_count), key=lambda vertex: file.ids[vertex])
    solver.start_at(initial_values(file.graph, start, _root(file), in_time))
    return solver, start


def take_whole(solver: Solver, file: G2oFile) -> None:
    """Give a solver all of a graph, and hold what FIX lines name; the first pose where nothing else fixes it."""
    graph = file.graph
    solver.add(range(graph.vertex_count), range(graph.edge_count))
    has_prior = any(len(edge.accepts) == 1 for edge in graph.tables)
    for vertex in file.fixed if file.fixed or has_prior else [_root(file)]:
        solver.hold(vertex)


def _root(file: G2oFile) -> int:
    """The first pose of a FIX line, or that of the least id."""
    of_no_pose = [not _is_pose(file.graph, v) for v in range(file.graph.vertex_count)]
    fixed = [v for v in file.fixed if not of_no_pose[v]]
    return fixed[0] if fixed else min(range(file.graph.vertex_count), key=lambda v: (of_no_pose[v], file.ids[v]))


def _is_pose(graph: Graph, vertex: int) -> bool:
    return graph.kind_of(vertex).name.startswith("SE")


def _vertices(graph: Graph, *, poses: bool) -> list[int]:
    return [v for v in range(graph.vertex_count) if _is_pose(graph, v) is poses]
