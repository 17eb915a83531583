"""The what-if analysis: solve the graph of a run again, with other edges or another loss, and see what moves.

It uses the map of the run. No verdict changes, and the drive is not repeated.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from graph_slam_ros.analysis.influence import InfluenceModel
from graph_slam_ros.errors import GaugeError, GraphSlamError, SingularError
from graph_slam_ros.graph import EdgeType, Gaussian, Graph, Loss
from graph_slam_ros.runs.folder import RunError
from graph_slam_ros.runs.ledger_file import Entry, ledger_entries
from graph_slam_ros.runs.restore import of_all, restored
from graph_slam_ros.runs.tables import numbered
from graph_slam_ros.runs.whole_path import WholePath
from graph_slam_ros.solver import Report, Solver

MOST_STEPS = 200  # an edge that all else contradicts needs more than a run's own map does
_ACCEPTED = "believed"  # the class of what is let in: it has no loss


@dataclass(frozen=True, slots=True)
class MovedVertex:
    """A vertex that moves between two solutions of one run.

    Attributes
    ----------
    before, after : chi2, cost and classes of the accepted edges
    final : motion of the last keyframe [m, rad]
    most : the keyframe that moves farthest, and its motion [m]
    worse : edges that fit worse afterwards, with their chi2 before and after; the largest increase comes first
    """

    before: Report
    after: Report
    final: tuple[float, float]
    most: tuple[int, float]
    worse: list[tuple[int, float, float]]


@dataclass(frozen=True, slots=True)
class Influence:
    """The influence of an edge: the motion of the last keyframe without it [m].

    Attributes
    ----------
    first_order_m : by one Gauss-Newton step
    exact_m : by solving again; inf if a vertex is undetermined without the edge, NaN if the solver does not converge
    """

    edge: int
    first_order_m: float
    exact_m: float


class SavedGraph:
    """The graph of a run, and the verdicts on all its edges, rejected ones included.

    Parameters
    ----------
    losses : a line is added for each part of the run that could not be read

    Attributes
    ----------
    slam : the pipeline that holds the map
    keyframes, numbers, stamps_ns : vertices of the keyframes that are in the graph, in order of time, their numbers
        among all keyframes, and stamps
    vertices : of the keyframes that are in the graph, by number
    segments : numbers of the keyframes at which odometry begins
    entries, changes : their edges have lasting ids; ``entries`` are in the order of the rows of the graph
    edits : by hand, in order
    landmarks : vertex of each landmark that an accepted edge is about, by its name
    held : vertices of a frozen map

    Raises
    ------
    GraphSlamError
        There is no map, it cannot be read, or it cannot be solved.
    """

    def __init__(self, folder: Path, losses: list[str]) -> None:
        slam = restored(folder, losses)
        if not slam.is_solved:
            raise RunError(f"{folder}: its map cannot be solved: {slam.failing}")
        self.slam, self.folder, self.space, self.config = slam, folder, slam.space, slam.config
        self.graph, self.held = slam.graph.copy(), slam.solver.held
        self.restored = slam.solver
        self.graph.initial.values[:] = slam.solver.values
        self.entries = list(ledger_entries(slam, range(self.graph.vertex_count)))
        number, old = self.graph.edge_ids.of, slam.bounded.old if slam.bounded else ()
        self.changes = [replace(one, edge=number(one.edge)) for one in slam.ledger.history]
        self.edits = slam.edits
        self.ids, _ = numbered(slam)
        self.keyframes: list[int] = [*(one.vertex for one in old), *slam.keyframes.ids.tolist()]
        self._names = {mark.vertex: name for name, mark in slam.landmarks.items()}
        self.stamps_ns: list[int] = [*(one.stamp_ns for one in old), *slam.keyframes.stamps_ns.tolist()]
        self.segments = list(slam.segments)
        joined = {vertex for entry in self.entries if entry.is_in for vertex in entry.vertices}
        self.landmarks = {name: mark.vertex for name, mark in slam.landmarks.items() if mark.vertex in joined}
        self.numbers: list[int] = [*(one.number for one in old), *range(slam.first_keyframe, len(slam.keyframes))]
        self._numbers = dict(zip(self.keyframes, self.numbers, strict=True))
        self.vertices = dict(zip(self.numbers, self.keyframes, strict=True))

    @cached_property
    def solver(self) -> Solver:
        """The solution of the run: all its accepted edges."""
        return self.solve()

    @cached_property
    def influence_model(self) -> InfluenceModel:
        """The influence of each edge, to first order."""
        return InfluenceModel(self.graph, self.restored, self.keyframes[-1])

    def keyframe(self, vertex: int) -> int | None:
        """The number of the keyframe of a vertex; None if it is not a keyframe."""
        return self._numbers.get(vertex)

    def name(self, vertex: int) -> int:
        """The number by which a vertex is called: of its keyframe, or its own in the saved graph."""
        number = self._numbers.get(vertex)
        return self.ids[vertex] if number is None else number

    @cached_property
    def whole_path(self) -> WholePath:
        """All keyframes, those that were condensed included."""
        return WholePath.of(self.slam, self.folder)

    def type_of(self, entry: Entry) -> EdgeType:
        """The type of an edge."""
        return self.graph.edge(self._row(entry.edge)).type

    def landmark_of(self, vertex: int) -> str:
        """The name of the landmark of a vertex; empty if it is not a landmark."""
        return self._names.get(vertex, "")

    def landmarks_of(self, entry: Entry) -> list[str]:
        """The names of the landmarks that an edge is of."""
        return [name for name in map(self.landmark_of, entry.vertices) if name]

    def edge(self, edge: int) -> Entry:
        """The ledger entry of an edge. Raises GraphSlamError for an unknown id."""
        return self.entries[self._row(edge)]

    def _row(self, edge: int) -> int:
        ids = self.graph.edge_ids
        row = ids.find(edge) if edge >= 0 else None
        if row is not None and row < len(self.entries):
            return row
        if (most := ids.of(len(self.entries))) > edge >= 0:
            raise GraphSlamError(
                f"edge {edge} is not in the map any more, since visits are condensed: {of_all(self.folder)}"
            )
        raise GraphSlamError(f"no edge {edge}: their ids are below {most}")

    def solve(self, without: Iterable[int] = (), let_in: Sequence[int] = (), loss: Loss | None = None) -> Solver:
        """Solve the accepted edges without some, and with others at full weight, from the saved estimate.

        Raises
        ------
        GraphSlamError
            As ``problem``.
        GaugeError, SingularError
            What is left does not determine a vertex.
        """
        solver = self.problem(without, let_in, loss)
        solver.optimize()
        return solver

    def problem(self, without: Iterable[int] = (), let_in: Sequence[int] = (), loss: Loss | None = None) -> Solver:
        """The problem that a what-if solves, at the saved estimate.

        A landmark without edges is left out. A keyframe without edges is an error.

        Parameters
        ----------
        loss : robust loss of all edges that may be outliers, instead of the run's

        Raises
        ------
        GraphSlamError
            There is no such edge, or one is both taken out and let in.
        """
        gone, anew = {self._row(e) for e in without}, list(dict.fromkeys(map(self._row, let_in)))
        if gone & set(anew):
            edge = self.entries[min(gone & set(anew))].edge
            raise GraphSlamError(f"edge {edge}: cannot be taken out and let in at once")
        edges = [row for row, e in enumerate(self.entries) if e.is_in and row not in gone]
        graph, settings = self.graph, self.config.solver_settings()
        settings = replace(settings, max_iterations=max(settings.max_iterations, MOST_STEPS))
        if anew:
            graph = graph.copy()
            edges += [_accepted(graph, row, self.entries[row]) for row in anew]
            edges = [row for row in edges if row not in set(anew)]
        if loss is not None:
            settings = replace(settings, losses={label: [loss] for label in settings.losses})
        solver = Solver(graph, settings)
        vertices = np.unique([*self.keyframes, *(v for row in edges for v in self._ends(graph, row))])
        solver.add(vertices, edges)
        for vertex in np.intersect1d(vertices, self.held).tolist():
            solver.hold(vertex)
        return solver

    def _ends(self, graph: Graph, row: int) -> Sequence[int]:
        """The vertices of an edge of the run, or of one that is let in."""
        return self.entries[row].vertices if row < len(self.entries) else graph.edge(row).vertices

    def moved(self, solver: Solver) -> MovedVertex:
        """Compare a solution with that of the run."""
        a, b = self.solver.estimate(self.keyframes), solver.estimate(self.keyframes)
        distance = np.linalg.norm(b[:, : self.space.dimensions] - a[:, : self.space.dimensions], axis=1)
        turned = self.space.angle(self.space.group.between(tuple(a[-1]), tuple(b[-1])))
        inside = np.array([row for row, e in enumerate(self.entries) if e.is_in], dtype=np.int64)
        before, after = self.solver.chi2_of(inside)[0], solver.chi2_of(inside)[0]
        worse = [k for k in np.argsort(before - after, kind="stable").tolist() if after[k] > before[k]]
        return MovedVertex(
            self.solver.evaluate(),
            solver.evaluate(),
            (float(distance[-1]), float(turned)),
            (self.keyframes[int(distance.argmax())], float(distance.max())),
            [(self.entries[inside[k]].edge, float(before[k]), float(after[k])) for k in worse],
        )

    def influences(self, count: int) -> list[Influence]:
        """The judged edges without which the last keyframe would move most, ranked to first order."""
        judged = [row for row, e in enumerate(self.entries) if e.is_in and e.verdict]
        step = self.influence_model.without(judged).step
        first = np.linalg.norm(step[:, : self.space.dimensions], axis=1)
        out = []
        for k in np.argsort(-first, kind="stable")[:count].tolist():
            edge = self.entries[judged[k]].edge
            try:
                solver = self.problem([edge])
                exact_m = self.moved(solver).final[0] if solver.optimize().converged else np.nan
            except (GaugeError, SingularError):
                exact_m = np.inf
            out.append(Influence(edge, float(first[k]), exact_m))
        return sorted(out, key=lambda one: -np.nan_to_num(one.exact_m, nan=one.first_order_m))


def _accepted(graph: Graph, row: int, entry: Entry) -> int:
    """Add a rejected edge again, as one that is never rejected."""
    edge = graph.edge(row)
    return graph.add_edge(edge.type, entry.vertices, entry.measured, Gaussian(edge.sqrt_information), _ACCEPTED)
