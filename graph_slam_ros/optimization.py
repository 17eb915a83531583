"""Solve a whole graph in one call: initial values, gauge, solution."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from reprlib import repr as shortened

import numpy as np
from scipy.special import chdtri

from graph_slam_ros.errors import GaugeError, GraphSlamError, SingularError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import LANDMARK_POSITION, RELATIVE_POSE, RELATIVE_POSE_3D, EdgeType, Graph
from graph_slam_ros.progress import report
from graph_slam_ros.solver import Report, Settings, Solver, initial_values
from graph_slam_ros.solver.initialization import OnPose
from graph_slam_ros.typing import Array, Index

_FAR_ABOVE = 2.0  # times its degrees of freedom: chi2 of an optimum is about as large as these, or smaller
_UNLIKELY = 1e-3  # that one edge of a graph has so large a residual by chance
_ALIKE = 0.01  # squared, how much smaller these may be
_UNEVEN, _SEVERAL = 10.0, 10  # mean over median of what so many closures or more have as chi2: in an optimum 1 to 4
_NO_RESIDUAL = 1e-6  # chi2 for each number measured: less is rounding
_MOST_TIMES, _MOST_S, _QUIET_S = 5.0, 10.0, 2.0  # of the first solution, and seconds, that others may take together
_NUMBERS = re.compile(r"(?<=vertex )\d+|(?<=FIX )[\d ]*\d")  # of vertices in errors: to be the file's
_COVARIANCE = "is a covariance given as information? g2o has its inverse"
_W_FIRST = "does w come first in the quaternions of its {}? g2o has qx qy qz qw"
_DEGREES = "are the angles of its {} in degrees? g2o has radians"
_BACKWARDS = "do its {} lead from j to i? g2o has the pose of j as seen from i"
_MILLIMETRES = "are its {} in millimetres, and its vertices in metres? g2o has metres"
_FIXED = "FIX of {} contradicts the edges, which all fit without: are these wrong? correct or remove the FIX lines"
_MISTAKES: tuple[tuple[str, EdgeType, Callable[[Array, Index], tuple[Array, Index]]], ...] = (  # and what undoes each
    (_W_FIRST, RELATIVE_POSE_3D, lambda seen, ends: (seen[:, [0, 1, 2, 4, 5, 6, 3]], ends)),
    (_DEGREES, RELATIVE_POSE, lambda seen, ends: (seen * (1.0, 1.0, np.pi / 180.0), ends)),
    *((_BACKWARDS, edge, lambda seen, ends: (seen, ends[:, ::-1])) for edge in (RELATIVE_POSE, RELATIVE_POSE_3D)),
    (_MILLIMETRES, RELATIVE_POSE, lambda seen, ends: (seen * (1e-3, 1e-3, 1.0), ends)),
    (_MILLIMETRES, RELATIVE_POSE_3D, lambda seen, ends: (seen * (*[1e-3] * 3, *[1.0] * 4), ends)),
    (_MILLIMETRES, LANDMARK_POSITION, lambda seen, ends: (seen * 1e-3, ends)),
)
_SAME, _TRIAL_ITERATIONS = 1e-6, 30  # the first: part of the cost by which one optimum differs from start to start


@dataclass(frozen=True, slots=True)
class Attempt:
    """The chi2 from one start (``file``, ``tree``, ``chordal`` or ``online``); without it why that failed."""

    start: str
    chi2: float = float("nan")
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
    doubt, let_go : why this solution is probably wrong, and of how many edges a robust loss has let go
    attempts : all starts that were tried, in order; this solution is the one with the lowest cost
    """

    file: G2oFile
    solver: Solver
    report: Report
    start: str
    suspicion: str = ""
    attempts: tuple[Attempt, ...] = ()
    doubt: str = ""
    let_go: int = 0

    def __repr__(self) -> str:
        poses, points = len(self.poses), len(self.points)
        chi2, stop = self.report.chi2_final, "converged" if self.report.converged else self.report.stop
        cost = f"chi2 {chi2:.6g} of {self.solver.degrees_of_freedom} degrees of freedom"
        doubt = "".join(f"; {what}" for what in [self.doubt, *self.file.losses] if what)
        return f"Solution({poses} poses, {points} points, {cost}, {stop}, start: {self.start}{doubt})"

    def worst(self, count: int = 5) -> list[tuple[str, float]]:
        """Edges that fit worst, for the numbers that each has measured: in words, with ids of the file, and chi2."""
        edges = self.solver.edges
        chi2, numbers = self.solver.chi2_of(edges)
        order = np.argsort(-chi2 / numbers)[:count]
        return [(edge_text(self.file, int(edges[k])), float(chi2[k])) for k in order]

    @property
    def poses(self) -> Array:
        """Estimates of all poses in order of id, (n, 3) as x, y, theta, or (n, 7) as x, y, z and quaternion xyzw."""
        graph = self.file.graph
        return self.solver.estimate([v for v in graph.vertex_ids.since().tolist() if _is_pose(graph, v)])

    @property
    def points(self) -> Array:
        """Estimates of all point landmarks in order of id, (n, 2) or (n, 3)."""
        graph = self.file.graph
        return self.solver.estimate([v for v in graph.vertex_ids.since().tolist() if not _is_pose(graph, v)])


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
        file = G2oFile(source, list(range(source.vertex_ids.next)))
    else:
        file = source if isinstance(source, G2oFile) else read_g2o(source)
    settings, began = Settings() if settings is None else settings, time.perf_counter()
    if not isinstance(settings, Settings):
        raise GraphSlamError(f"settings are a {type(settings).__name__}, not Settings(method, ...)")
    first = _solved(file, settings, "file" if init == "auto" else init)
    return _judged(first, settings) if init != "auto" else _best_of(first, settings, time.perf_counter() - began)


def _solved(file: G2oFile, settings: Settings, init: str, on_pose: OnPose = lambda *_: None) -> Solution:
    try:
        solver, start = started(file, init, on_pose)
        add_graph(solver, file)
        done = solver.optimize(settings)
    except GraphSlamError as error:
        why = _NUMBERS.sub(lambda n: " ".join(str(file.ids[int(k)]) for k in n[0].split()), str(error))
        lacks = file.losses or ["it has no edges"] * (not file.graph.edge_count)
        if lacks and isinstance(error, GaugeError | SingularError):  # the cause, not its consequence
            why = f"{'; '.join(lacks)}: without them {why.partition(': ')[0]}"
        error.args = (why,)
        raise
    return Solution(file, solver, done, start, attempts=(Attempt(start, done.chi2_final),))


def _best_of(first: Solution, settings: Settings, first_s: float) -> Solution:
    """The first where nothing is suspicious about it, else the best of it and of other starts, in a limited time."""
    best, attempts, suspicion = first, list(first.attempts), suspicion_of(first, settings)
    root = _root(first.file)
    others = ("chordal", "online") if suspicion and root is not None and _is_pose(first.file.graph, root) else ()
    most_s, began = max(_MOST_TIMES * first_s, _MOST_S), time.perf_counter()

    def on_pose(pose: int, count: int) -> None:
        elapsed_s = time.perf_counter() - began
        if elapsed_s > most_s:
            raise GraphSlamError(f"stopped after {most_s:.0f} s, at pose {pose} of {count}")
        if elapsed_s > _QUIET_S:
            report(f"another start, the drive, pose after pose: {pose} of {count}")

    for start in others:
        left_s = most_s - (time.perf_counter() - began)
        most = int(0.5 * left_s * (1 + len(first.report.iterations)) / first_s)  # damped ones may follow
        limited = replace(settings, max_iterations=max(1, min(most, settings.max_iterations)))
        try:
            other = _solved(first.file, limited, start, on_pose)
        except (GraphSlamError, np.linalg.LinAlgError) as error:
            attempts.append(Attempt(start, failure=str(error)))
            continue
        attempts += other.attempts
        if other.report.cost_final < best.report.cost_final * (1.0 - _SAME):
            best = other
        if not suspicion_of(best, settings):  # a good one is found
            break
    judged = _judged(replace(best, suspicion=suspicion, attempts=tuple(attempts)), settings)
    is_open = judged.doubt and not judged.doubt.endswith(_COVARIANCE)
    return _explained(judged, settings, began + most_s) if is_open else judged


def _explained(solution: Solution, settings: Settings, until: float) -> Solution:
    """The solution, with the mistake in its file if there is one without which all edges fit: that is tried."""
    limited = replace(settings, max_iterations=_TRIAL_ITERATIONS)
    for mistake, file in _without_mistakes(solution.file):
        if time.perf_counter() > until:
            break
        with suppress(GraphSlamError, np.linalg.LinAlgError):
            tried = _judged(_solved(file, limited, "chordal"), limited)
            if not tried.doubt:
                return replace(solution, doubt=f"{solution.doubt}: {mistake}") if mistake else solution
    return solution


def _without_mistakes(file: G2oFile) -> Iterator[tuple[str, G2oFile]]:
    """Mistakes that may be in a file, of all edges or of a class, and the file without each."""
    labels = file.graph.labels
    yield "", file  # as it is: it may only lack iterations
    if len(file.fixed) > 1 or (file.fixed and "priors" in labels):
        yield _FIXED.format(shortened([file.ids[v] for v in file.fixed])[1:-1]), replace(file, fixed=[])
    for mistake, edge, undo in _MISTAKES:
        for label in [*labels, "edges"] if edge in file.graph.tables else []:
            graph = file.graph.copy()
            table = graph.tables[edge]
            rows = np.flatnonzero(graph.has_label(table.ids, labels if label == "edges" else [label]))
            seen, ends = table.measured.values[rows], table.vertex_rows.values[rows]
            if len(rows) and _is_likely(mistake, file, seen, ends):
                undone = undo(seen, ends)
                table.measured.values[rows], table.vertex_rows.values[rows] = undone
                yield mistake.format(label), replace(file, graph=graph)


def _is_likely(mistake: str, file: G2oFile, seen: Array, ends: Index) -> bool:
    """Degrees are likely above a whole turn, millimetres of ways 1000 times as long as in the file's values."""
    if mistake == _DEGREES:
        return bool(np.abs(seen[:, 2]).max() > 2.0 * np.pi)
    if mistake != _MILLIMETRES:
        return True
    axes = np.arange(3 if seen.shape[1] == 7 else 2)
    at = file.graph.initial.values[file.graph.offset.values[ends][:, :, None] + axes]
    length, longer = (float(np.median(np.linalg.norm(way, axis=1))) for way in (at[:, 1] - at[:, 0], seen[:, axes]))
    return length > 0.0 and 300.0 < longer / length < 3000.0


def suspicion_of(solution: Solution, settings: Settings) -> str:
    """Return why a result may be a local minimum, in some words; empty where nothing speaks for it."""
    solver, graph, edges = solution.solver, solution.file.graph, solution.solver.edges
    closures = edges[graph.has_label(edges, ("closures",))]
    chi2, numbers = solver.chi2_of(closures)
    each = chi2 / numbers
    is_uneven = len(each) >= _SEVERAL and each.mean() > max(_UNEVEN * float(np.median(each)), _NO_RESIDUAL)
    doubt = _judged(solution, settings).doubt or "a few closures have nearly all of the residuals" * bool(is_uneven)
    return "" if doubt.endswith(_COVARIANCE) else doubt


def _judged(solution: Solution, settings: Settings) -> Solution:
    """The solution with its doubt. What a loss lets go of does not count if it is the smaller part of what has one."""
    solver, graph, doubt = solution.solver, solution.file.graph, ""
    freedom, edges = solver.degrees_of_freedom, solver.edges
    chi2, numbers = solver.chi2_of(edges)
    unlikely = (chi2 > chdtri(numbers, _UNLIKELY / max(len(edges), 1))) & (freedom > 0)
    has_loss = graph.has_label(edges, [label for label in graph.labels if settings.last_loss(label, "").kind])
    gone, far = int((unlikely & has_loss).sum()), np.flatnonzero(unlikely & ~has_loss)
    freedom, kept = freedom - int(numbers[unlikely & has_loss].sum()), float(chi2[~(unlikely & has_loss)].sum())
    some = [np.square(graph.edge(edge).sqrt_information).sum(axis=0).mean() for edge in edges[:1000].tolist()]
    stated = float(np.median(some)) if some else 0.0  # in a covariance, about as large as squared residuals
    if not solution.report.converged:
        doubt = f"it did not converge ({solution.report.stop})"
    elif 2 * gone > has_loss.sum():
        doubt = f"the loss lets go of {gone} of {has_loss.sum()} edges"
    elif freedom > 0 and kept > max(_FAR_ABOVE * freedom, chdtri(freedom, _UNLIKELY)):
        doubt = f"chi2 {kept:.6g} is far above its {freedom} degrees of freedom"
    elif freedom > 0 and _ALIKE * stated**2 < kept / freedom < 1e-3:
        doubt = f"chi2 {solution.report.chi2_final:.6g} is far below its {freedom} degrees of freedom: {_COVARIANCE}"
    elif len(far):
        worst = far[np.argmax(chi2[far] / numbers[far])]
        what = f"{len(far)} residuals are far outside" if len(far) > 1 else "a residual is far outside"
        doubt = f"{what} of their noise, e.g. {edge_text(solution.file, int(edges[worst]))} with chi2 {chi2[worst]:.4g}"
    return replace(solution, doubt=doubt, let_go=gone)


def edge_text(file: G2oFile, edge: int) -> str:
    """An edge by its class and its vertices' ids in the file."""
    return " ".join([file.graph.label_of(edge), *(str(file.ids[vertex]) for vertex in file.graph.edge(edge).vertices)])


def started(file: G2oFile, init: str, on_pose: OnPose = lambda *_: None) -> tuple[Solver, str]:
    """A solver with initial values, and where they are from: edges alone leave nothing but their tree."""
    root, start = _root(file), init if file.has_values or init != "file" else "tree"
    if root is None or not _is_pose(file.graph, root):
        start = "file"
    solver = Solver(file.graph)
    in_time = sorted(file.graph.vertex_ids.since().tolist(), key=lambda vertex: file.ids[vertex])
    solver.start_at(initial_values(file.graph, start, root or 0, in_time, on_pose))
    for vertex in file.fixed if file.has_values else ():
        solver.place(vertex, file.graph.initial.values[file.graph.vertex(vertex).stored])
    return solver, start


def add_graph(solver: Solver, file: G2oFile) -> None:
    """Give a solver all of a graph, and hold what FIX lines name; the first pose where nothing else fixes it."""
    graph = file.graph
    solver.add(graph.vertex_ids.since(), graph.edge_ids.since())
    for vertex in file.fixed:
        solver.hold(vertex)
    root = _root(file)
    if root is not None and not solver.is_fixed():
        solver.hold(root)


def _root(file: G2oFile) -> int | None:
    """The first pose of a FIX line, or that of the least id; where there are no poses, a landmark."""
    held = [v for v in file.fixed if _is_pose(file.graph, v)]
    order = sorted(file.graph.vertex_ids.since().tolist(), key=lambda v: (not _is_pose(file.graph, v), file.ids[v]))
    return next(iter([*held, *order]), None)


def _is_pose(graph: Graph, vertex: int) -> bool:
    return graph.kind_of(vertex).name.startswith("SE")
