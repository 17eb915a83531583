"""The what-if analysis: the graph of a saved run, solved again with other edges or another loss; what moves.

All is from ``graph.g2o`` and ``ledger.csv``: nothing is decided again, the drive is not repeated.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from graph_slam_ros.errors import FormatError, GaugeError, GraphSlamError, SingularError
from graph_slam_ros.formats.g2o import read_g2o
from graph_slam_ros.formats.graph_file import EDGE_TAGS, G2oFile
from graph_slam_ros.graph import Gaussian, Graph, Loss
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.runs import GRAPH, run_config
from graph_slam_ros.runs.ledger_file import LEDGER, Entry, read_ledger
from graph_slam_ros.solver import Report, Solver
from graph_slam_ros.solver.linearization import linearized
from graph_slam_ros.typing import Array

_ACCEPTED = "believed"  # the class of what is let in: it has no loss


@dataclass(frozen=True, slots=True)
class MovedVertex:
    """A vertex that moves between two solutions of one run.

    Attributes
    ----------
    before, after : chi2, cost and classes of all that is in
    final : how far the last keyframe moves, in metres and in radians
    most : the keyframe that moves farthest, and how far, in metres
    worse : edges that fit worse after, with their chi2 before and after; the one that has lost most first
    """

    before: Report
    after: Report
    final: tuple[float, float]
    most: tuple[int, float]
    worse: list[tuple[int, float, float]]


@dataclass(frozen=True, slots=True)
class Influence:
    """The influence of an edge: metres the last keyframe moves without it, to first order and solved again.

    The latter is inf where a vertex is undetermined without the edge.
    """

    edge: int
    first_order_m: float
    exact_m: float


class SavedGraph:
    """The graph of a run: vertices as ``graph.g2o`` numbers them, edges as ``ledger.csv`` does, those that are out too.

    Raises
    ------
    FormatError
        A file is missing, or is not what it should be.
    """

    def __init__(self, folder: Path) -> None:
        config = run_config(folder)
        self.space, self._settings = config.space, config.solver_settings()
        self.entries = read_ledger(folder)
        self.graph, self._held = _graph(folder, self.entries)
        ends = (k for e in self.entries if e.label in ("anchor", "odometry") for k in e.vertices[-1:])
        self.keyframes = list(dict.fromkeys(ends))  # an anchor that gave way has another after it
        for vertex in self.keyframes:
            if self.graph.kind_of(vertex) is not self.space.pose:
                kind, wanted = self.graph.kind_of(vertex).name, self.space.pose.name
                raise FormatError(f"{folder / GRAPH}: vertex {vertex} is {kind}, where {LEDGER} has a pose, {wanted}")
        if not self.keyframes:
            raise GraphSlamError(f"{folder}: no keyframe in it, so there is nothing to solve")
        self._numbers = {vertex: k for k, vertex in enumerate(self.keyframes)}
        self._was = self.solve()

    def keyframe(self, vertex: int) -> int | None:
        """The number of the keyframe that a vertex is, if it is one."""
        return self._numbers.get(vertex)

    def edge(self, edge: int) -> Entry:
        """One of them. Raises GraphSlamError."""
        if not 0 <= edge < len(self.entries):
            raise GraphSlamError(f"no edge {edge}: their ids are below {len(self.entries)}")
        return self.entries[edge]

    def solve(self, without: Iterable[int] = (), let_in: Sequence[int] = (), loss: Loss | None = None) -> Solver:
        """Solve what is in, but for some edges, and with others, which then count fully; from the saved estimate.

        A landmark that is left without edges is left out; a keyframe is not.

        Parameters
        ----------
        loss : of everything that may be wrong, instead of the run's

        Raises
        ------
        GraphSlamError
            There is no such edge, or one is both taken out and let in.
        GaugeError, SingularError
            What is left does not determine a vertex.
        """
        gone, let_in = {self.edge(e).edge for e in without}, list(dict.fromkeys(let_in))
        if gone & set(let_in):
            raise GraphSlamError(f"edge {min(gone & set(let_in))}: cannot be taken out and let in at once")
        edges = [e.edge for e in self.entries if e.is_in and e.edge not in gone]
        graph, settings = self.graph, self._settings
        if let_in:
            graph = graph.copy()
            edges += [_add(graph, self.edge(e), _ACCEPTED) for e in let_in]
            edges = [e for e in edges if e not in set(let_in)]
        if loss is not None:
            settings = replace(settings, losses={label: [loss] for label in settings.losses})
        solver = Solver(graph, settings)
        vertices = np.unique([*self.keyframes, *(v for e in edges for v in _ends(graph, e))])
        solver.add(vertices, edges)
        for vertex in np.intersect1d(vertices, self._held).tolist():
            solver.hold(vertex)
        solver.optimize()
        return solver

    def moved(self, solver: Solver) -> MovedVertex:
        """Compare a solution with that of the run."""
        a, b = self._was.estimate(self.keyframes), solver.estimate(self.keyframes)
        distance = np.linalg.norm(b[:, : self.space.dimensions] - a[:, : self.space.dimensions], axis=1)
        turned = self.space.angle(self.space.group.between(tuple(a[-1]), tuple(b[-1])))
        inside = np.array([e.edge for e in self.entries if e.is_in], dtype=np.int64)
        before, after = self._was.chi2_of(inside)[0], solver.chi2_of(inside)[0]
        worse = [k for k in np.argsort(before - after, kind="stable").tolist() if after[k] > before[k]]
        return MovedVertex(
            self._was.evaluate(),
            solver.evaluate(),
            (float(distance[-1]), float(turned)),
            (self.keyframes[int(distance.argmax())], float(distance.max())),
            [(int(inside[k]), float(before[k]), float(after[k])) for k in worse],
        )

    def influences(self, count: int) -> list[Influence]:
        """The judged edges whose absence would move the last keyframe most, of all of them to first order."""
        judged = [e for e in self.entries if e.is_in and e.verdict]
        first = np.array([np.linalg.norm(self.first_order(e.edge)[: self.space.dimensions]) for e in judged])
        out = []
        for k in np.argsort(-first, kind="stable")[:count].tolist():
            edge = judged[k].edge
            try:
                exact_m = self.moved(self.solve([edge])).final[0]
            except (GaugeError, SingularError):
                exact_m = np.inf
            out.append(Influence(edge, float(first[k]), exact_m))
        return sorted(out, key=lambda one: -one.exact_m)

    def first_order(self, edge: int) -> Array:
        """The step (dof,) of the last keyframe, in its tangent space, that taking an edge out would cause.

        With A and r its whitened Jacobian and residual at the optimum and Sigma the joint covariance of its vertices, a
        Gauss-Newton step without it is ``Sigma A' (I - A Sigma A')^-1 r``, by the matrix inversion lemma.
        """
        solver, graph, last = self._was, self.graph, self.keyframes[-1]
        one = graph.edge(edge)
        ends, root = one.vertices, one.sqrt_information
        residual, jacobian = linearized(graph, solver.values, one.type, ends, one.measured)
        loss = solver.settings.stages()[-1].get(one.label, Loss())
        white = root @ residual
        share = weight_and_cost(loss.kind, loss.scale, float(white @ white))[0] ** 0.5
        white, a = share * white, share * root @ jacobian
        among = [*ends, *([] if last in ends else [last])]
        joint = solver.joint_marginal(among)
        first = np.cumsum([0, *(graph.kind_of(v).dof for v in among)])
        of_last = slice(first[k := among.index(last)], first[k + 1])
        of_ends = slice(0, int(first[len(ends)]))
        left = np.eye(len(white)) - a @ joint[of_ends, of_ends] @ a.T
        step: Array = joint[of_last, of_ends] @ a.T @ np.linalg.lstsq(left, white, rcond=1e-9)[0]
        return step


def _graph(folder: Path, entries: Sequence[Entry]) -> tuple[Graph, list[int]]:
    """The graph, and the vertices that are held: those of a map that was frozen."""
    file, out = read_g2o(folder / GRAPH, follow=False), Graph()
    if sorted(file.ids) != list(range(len(file.ids))):
        raise FormatError(f"{folder / GRAPH}: vertices are not numbered one after another from 0: is it of a run?")
    at, initial = file.graph.offset.values.tolist(), file.graph.initial.values
    for vertex in np.argsort(file.ids).tolist():
        kind = file.graph.kind_of(vertex)
        out.add_vertex(kind, initial[at[vertex] : at[vertex] + kind.size])
    for entry in entries:
        try:
            _add(out, entry, entry.label)
        except GraphSlamError as error:
            message = f"edge {entry.edge}: {error} (or {GRAPH} is not of the same run)"
            raise FormatError(f"{folder / LEDGER}: {message}") from None
    _check_same_run(folder, file, entries)
    return out, [file.ids[vertex] for vertex in file.fixed]


def _check_same_run(folder: Path, file: G2oFile, entries: Iterable[Entry]) -> None:
    """The graph has the edges that are in, and none that the ledger does not know."""
    edges: Counter[tuple[str, ...]] = Counter()
    tags = {edge: tag for tag, edge in EDGE_TAGS.items()}
    for table in file.graph.tables.values():
        edges.update((tags[table.type], *(str(file.ids[v]) for v in ends)) for ends in table.vertices.values.tolist())
    known = [((e.tag, *map(str, e.vertices)), e.is_in) for e in entries]
    strange = edges - Counter(edge for edge, _ in known) or Counter(edge for edge, is_in in known if is_in) - edges
    if strange:
        edge = " ".join(min(strange))
        raise FormatError(f"{folder}: {GRAPH} and {LEDGER} are not of one run, or not whole: {edge} is in one alone")


def _add(graph: Graph, entry: Entry, label: str) -> int:
    noise = Gaussian.from_information(entry.information_matrix)
    return graph.add_edge(EDGE_TAGS[entry.tag], entry.vertices, entry.measured, noise, label)


def _ends(graph: Graph, edge: int) -> list[int]:
    table, row = graph.row(edge)
    ends: list[int] = table.vertices.values[row].tolist()
    return ends
