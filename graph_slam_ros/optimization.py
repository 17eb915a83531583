"""Solve a whole graph in one call: initial values, gauge, solution."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import Graph
from graph_slam_ros.solver import Report, Settings, Solver, initial_values
from graph_slam_ros.typing import Array

_FAR_ABOVE = 2.0  # times its degrees of freedom: chi2 of an optimum is about as large as these, or smaller
_UNLIKELY = 1e-3  # that one edge of a graph has so large a residual by chance
_UNEVEN, _SEVERAL = 10.0, 10  # mean over median of what so many closures or more have as chi2: in an optimum 1 to 4
_NO_RESIDUAL = 1e-6  # chi2 for each number measured: less is rounding
_SAME = 1e-6  # part of the cost by which one optimum differs from start to start


@dataclass(frozen=True, slots=True)
class Attempt:
    """The result of one start.

    Attributes
    ----------
    start : ``file``, ``tree``, ``chordal`` or ``online``
    chi2, cost : of the result; NaN if there is none
    failure : the reason if there is no result; else empty
    """

    start: str
    chi2: float = float("nan")
    cost: float = float("nan")
    failure: str = ""


@dataclass(frozen=True, slots=True)
class Solution:
    """A solved graph.

    Attributes
    ----------
    file : the graph with the ids of its file, for ``write_g2o(path, solution.file, solution.solver.estimate)``
    solver : the solver; it has estimates and marginals of all vertices, by their ids in the graph
    report : iterations, chi2, and why the solve stopped
    start : origin of the initial values: ``file``, ``tree``, ``chordal`` or ``online``
    suspicion : why the first result may be a local minimum, so that other starts were tried; empty if it is good
    attempts : all starts that were tried, in order; this solution is the one with the lowest cost
    """

    file: G2oFile
    solver: Solver
    report: Report
    start: str
    suspicion: str = ""
    attempts: tuple[Attempt, ...] = ()

    def __repr__(self) -> str:
        poses, points = len(self.poses), len(self.points)
        chi2, stop = self.report.chi2_final, "converged" if self.report.converged else self.report.stop
        return f"Solution({poses} poses, {points} points, chi2 {chi2:.6g}, {stop}, start: {self.start})"

    @property
    def poses(self) -> Array:
        """Estimates of all poses in order of id: (n, 3) as x, y, theta, or (n, 7) as x, y, z and quaternion xyzw."""
        return self.solver.estimate(_vertices(self.file.graph, poses=True))

    @property
    def points(self) -> Array:
        """Estimates of all point landmarks in order of id, (n, 2) or (n, 3)."""
        return self.solver.estimate(_vertices(self.file.graph, poses=False))


def optimize(source: Graph | G2oFile | Path | str, settings: Settings | None = None, *, init: str = "auto") -> Solution:
    """Solve a whole graph: that of a file, or one that was built by a program.

    Vertices in FIX lines are held. If there are none, and priors do not fix both position and heading, the first pose
    is held.

    Parameters
    ----------
    source : a graph, the path of a g2o file, or the result of ``read_g2o``
    settings : settings of the solver
    init : initial values. ``file``: those of the file (``tree`` if it has none). ``tree``: poses composed along a
        spanning tree. ``chordal``: the chordal relaxation. ``online``: pose by pose, in order of id. A graph without
        poses always starts from ``file``. ``auto``: from ``file``, and if the result is suspicious also from
        ``chordal`` and then ``online``; the solution with the lowest cost is returned

    Raises
    ------
    FormatError
        The file cannot be read.
    GaugeError, SingularError
        The edges do not determine a vertex.
    """
    if isinstance(source, Graph):
        file = G2oFile(source, list(range(source.vertex_count)))
    else:
        file = source if isinstance(source, G2oFile) else read_g2o(source)
    if init != "auto":
        return _solved(file, settings, init)
    return _best_of(_solved(file, settings, "file"), settings)


def _solved(file: G2oFile, settings: Settings | None, init: str) -> Solution:
    solver, start = started(file, init)
    add_graph(solver, file)
    report = solver.optimize(settings)
    return Solution(file, solver, report, start, attempts=(Attempt(start, report.chi2_final, report.cost_final),))


def _best_of(first: Solution, settings: Settings | None) -> Solution:
    """The first where nothing is suspicious about it, else the best of it and of other starts."""
    best, attempts, suspicion = first, list(first.attempts), suspicion_of(first)
    root = _root(first.file)
    if not suspicion or root is None or not _is_pose(first.file.graph, root):
        return replace(first, suspicion=suspicion)
    for start in ("chordal", "online"):
        try:
            other = _solved(first.file, settings, start)
        except (GraphSlamError, np.linalg.LinAlgError) as error:
            attempts.append(Attempt(start, failure=str(error)))
            continue
        attempts += other.attempts
        if other.report.cost_final < best.report.cost_final * (1.0 - _SAME):
            best = other
        if not suspicion_of(best):  # a good one is found
            break
    return replace(best, suspicion=suspicion, attempts=tuple(attempts))


def suspicion_of(solution: Solution) -> str:
    """Return why a result may be a local minimum, in some words; empty where nothing speaks for it."""
    solver, report, graph = solution.solver, solution.report, solution.file.graph
    if not report.converged:
        return f"it did not converge ({report.stop})"
    freedom, edges = solver.degrees_of_freedom, solver.edges
    if freedom > 0 and report.chi2_final > max(_FAR_ABOVE * freedom, chdtri(freedom, _UNLIKELY)):
        return f"chi2 {report.chi2_final:.6g} is far above its {freedom} degrees of freedom"
    chi2, numbers = solver.chi2_of(edges)
    unlikely = chi2 > chdtri(numbers, _UNLIKELY / max(len(edges), 1))
    far = np.flatnonzero(unlikely & (freedom > 0))
    if len(far):
        worst = int(np.argmax(chi2 / numbers))
        what = f"{len(far)} residuals are far outside" if len(far) > 1 else "a residual is far outside"
        return f"{what} of their noise, e.g. edge {int(edges[worst])} with chi2 {chi2[worst]:.4g}"
    closures = graph.has_label(edges, ("closures",))
    each = chi2[closures] / numbers[closures]
    if len(each) >= _SEVERAL and each.mean() > max(_UNEVEN * float(np.median(each)), _NO_RESIDUAL):
        return "a few closures have nearly all of the residuals"
    return ""


def started(file: G2oFile, init: str) -> tuple[Solver, str]:
    """A solver with initial values, and where they are from: edges alone leave nothing but their tree."""
    root, start = _root(file), init if file.has_values or init != "file" else "tree"
    if root is None or not _is_pose(file.graph, root):
        start = "file"
    solver = Solver(file.graph)
    in_time = sorted(range(file.graph.vertex_count), key=lambda vertex: file.ids[vertex])
    solver.start_at(initial_values(file.graph, start, root or 0, in_time))
    return solver, start


def add_graph(solver: Solver, file: G2oFile) -> None:
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
