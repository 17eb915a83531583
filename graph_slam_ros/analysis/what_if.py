"""The what-if analysis: solve the graph of a run again, with other edges or another loss, and see what moves.

It uses the map of the run. No verdict changes, and the drive is not repeated.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GaugeError, GraphSlamError, SingularError
from graph_slam_ros.graph import Gaussian, Graph, Loss
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.runs.condensed_map import WholePath
from graph_slam_ros.runs.folder import RunError
from graph_slam_ros.runs.ledger_file import Entry, ledger_entries
from graph_slam_ros.runs.restore import of_all, restored
from graph_slam_ros.runs.tables import numbered
from graph_slam_ros.solver import Report, Solver
from graph_slam_ros.solver.linearization import Block, Losses, linearize
from graph_slam_ros.typing import Array, Index

_POSITION = {"SE2": 2, "R2": 2, "SE3": 3, "R3": 3}  # first numbers of a step that are metres in map
_SAME, _STEP = 1e-3, 1e-4  # of the cost, below which a loss does nothing; of s, for its second derivative
_FLATTEST = 0.05  # curvature along a residual: a loss that redescends has a negative one
_FAR = 300.0  # growth of the cost by an edge that is let in, above which other edges lose their weight to it
MOST_STEPS = 200  # an edge that all else contradicts needs more than a run's own map does
_ACCEPTED = "believed"  # the class of what is let in: it has no loss
_LEAST = 1e-9  # eigenvalue of I - A Sigma A': below it nothing else determines that direction


@dataclass(frozen=True, slots=True)
class Influences:
    """The influence of each of n edges, to first order; NaN where it is not known, or was not asked for.

    Attributes
    ----------
    step : (n, dof) step of the last keyframe, in its tangent space [m, rad]
    end : (n,) which of its vertices moves farthest: 0 is the first
    end_m : (n,) how far [m]
    cost : (n,) change of the cost of all: negative without an edge
    is_alone : (n,) whether nothing else determines one of its vertices, so that it cannot be left out
    """

    step: Array
    end: Index
    end_m: Array
    cost: Array
    is_alone: NDArray[np.bool_]

    @property
    def last_m(self) -> Array:
        """(n,) How far the last keyframe moves [m]."""
        positions = (self.step.shape[1] + 1) // 2  # two of three numbers in the plane, three of six in space
        return np.asarray(np.linalg.norm(self.step[:, :positions], axis=1))


class InfluenceModel:
    """The solved problem to second order, in which the influence of each edge is one step.

    With A and r its whitened Jacobian and residual at the optimum and Sigma the joint covariance of its vertices, the
    Gauss-Newton step without an edge is ``Sigma A' (I - A Sigma A')^-1 r``, by the matrix inversion lemma. The step
    with one that is let in is ``-Sigma A' (I + A Sigma A')^-1 r``. The cost changes by ``r' (I -+ A Sigma A')^-1 r``.

    A loss bends the cost of an edge along its residual, less than the weight that a solver gives it: with ``rho(s)`` of
    ``s = r'r`` the second derivative there is ``rho' + 2 rho'' s``. Without that, steps are a fifth too short or more.

    Parameters
    ----------
    solver : at its optimum
    last : the vertex of the last keyframe
    """

    def __init__(self, graph: Graph, solver: Solver, last: int) -> None:
        self._graph, self._values, self._last = graph, solver.values, last
        self._losses = {key: stages[-1] for key, stages in solver.settings.losses.items()}
        self._curved = graph.copy()
        edges, self._edges = solver.edges, graph.edge_ids.since()
        self._along = np.ones(graph.edge_ids.next)  # of each edge, square root of the curvature along the residual
        self._cost = np.zeros(graph.edge_ids.next)
        for block in linearize(graph, self._values, graph.by_table(edges), Losses(graph, self._losses)):
            self._cost[block.table.at(block.rows).ids] = block.cost
            self._bend(block)
        self._solver = Solver(self._curved, replace(solver.settings, losses={}, relinearize_passes=0))  # at the optimum
        self._solver.add(solver.vertices, edges)
        self._solver.start_at(self._values)
        for vertex in solver.held.tolist():
            self._solver.hold(vertex)

    def _bend(self, block: Block) -> None:
        """Give edges the curvature of their loss, where it is another than their weight."""
        some = np.flatnonzero(block.cost < (1.0 - _SAME) * block.chi2)
        if not len(some):
            return
        rows = block.table.at(block.rows)
        losses = [self._loss(*codes) for codes in zip(rows.label[some], rows.source[some], strict=True)]
        of = [(loss.kind, loss.scale, s) for loss, s in zip(losses, block.chi2[some].tolist(), strict=True)]
        slope, ahead, behind = (
            np.array([weight_and_cost(kind, scale, s * factor)[0] for kind, scale, s in of])
            for factor in (1.0, 1.0 + _STEP, 1.0 - _STEP)
        )
        along = np.sqrt(np.maximum(1.0 + (ahead - behind) / (_STEP * slope), _FLATTEST))
        unit = block.residual[some] / np.linalg.norm(block.residual[some], axis=1, keepdims=True)
        roots = self._curved.tables[block.table.type].sqrt_information.values
        root = roots[block.rows[some]]
        across = unit[:, :, None] * (unit[:, None, :] @ root)
        roots[block.rows[some]] = np.sqrt(slope)[:, None, None] * (root - (1.0 - along)[:, None, None] * across)
        self._along[rows.ids[some]] = along

    def _loss(self, label_code: int, source_code: int) -> Loss:
        label = self._graph.labels[label_code]
        return self._losses.get((label, self._graph.sources[source_code])) or self._losses[label]

    def of(self, inside: Sequence[int], outside: Sequence[int] = ()) -> Influences:
        """The influence of edges that are in: what changes without each; and of some that are out: with each of them.

        It has a row for each edge of the graph, in order.

        An edge is let in without a loss. Steps are NaN where one step says nothing: it is so far off that others would
        lose their weight.
        """
        count, dof = len(self._edges), self._graph.kind_of(self._last).dof
        unknown, none = np.full((dof + 2, count), np.nan), np.zeros(count, dtype=np.int64)
        found = Influences(unknown[2:].T, none, unknown[0], unknown[1], none > 0)
        if len(inside):
            self._leave_out(found, np.array(inside))
        if len(outside):
            self._let_in(found, np.array(outside))
        return found

    def _leave_out(self, found: Influences, edges: Index) -> None:
        with_last = self._solver.covariances_with(self._last)
        for block in linearize(self._curved, self._values, self._curved.by_table(edges), Losses(self._curved, {})):
            rows = block.table.at(block.rows)
            block.residual[:] /= self._along[rows.ids, None] ** 2
            joint = self._solver.edge_marginals(rows.vertices)
            of_last = np.array([np.concatenate([with_last[v] for v in ends]).T for ends in rows.vertices.tolist()])
            at = np.searchsorted(self._edges, rows.ids)
            _fill(found, at, block, joint, of_last, -1.0)
            found.cost[at] += np.sum(block.residual**2, axis=1) - self._cost[rows.ids]

    def _let_in(self, found: Influences, edges: Index) -> None:
        graph = self._graph.copy()
        graph.set_weights(edges, 1.0)
        for block in linearize(graph, self._values, graph.by_table(edges), Losses(graph, {})):
            rows = block.table.at(block.rows)
            at = np.searchsorted(self._edges, rows.ids)
            for k, ends in enumerate(rows.vertices):  # they may be far apart in the tree
                try:
                    among, of_last = self._joint(ends)
                except GraphSlamError:  # one of them is not in the problem: the edge would be its only one
                    continue
                part = replace(block, residual=block.residual[k : k + 1], jacobian=block.jacobian[k : k + 1])
                _fill(found, at[k : k + 1], part, among[None], of_last[None], 1.0)
        far = np.isin(self._edges, edges) & (found.cost > _FAR)
        found.step[far], found.end_m[far] = np.nan, np.nan

    def _joint(self, ends: Index) -> tuple[Array, Array]:
        """Covariances (D, D) of some vertices, and (d, D) of the last keyframe with them."""
        vertices, last = ends.tolist(), self._last
        joint = self._solver.joint_marginal([*vertices, *([] if last in vertices else [last])])
        dofs = [self._graph.kind_of(vertex).dof for vertex in vertices]
        first = sum(dofs[: vertices.index(last)] if last in vertices else dofs)
        return joint[: sum(dofs), : sum(dofs)], joint[first : first + self._graph.kind_of(last).dof, : sum(dofs)]


def _fill(found: Influences, at: Index, block: Block, among: Array, of_last: Array, sign: float) -> None:
    """Compute the influence of edges of one type; ``sign`` is 1 for edges that are let in, else -1.

    Parameters
    ----------
    among : (n, D, D) covariances of their vertices; of_last : (n, d, D) of the last keyframe with them
    """
    a, r = block.jacobian, block.residual
    inner = np.eye(r.shape[1]) + sign * (a @ among @ a.transpose(0, 2, 1))
    values, vectors = np.linalg.eigh(inner)
    inverse = np.where(values > _LEAST, 1.0 / np.maximum(values, _LEAST), 0.0)
    solved = (vectors @ (inverse[:, :, None] * (vectors.transpose(0, 2, 1) @ r[:, :, None])))[:, :, 0]
    pull = -sign * (a.transpose(0, 2, 1) @ solved[:, :, None])  # the change of the gradient
    found.step[at] = (of_last @ pull)[:, :, 0]
    moved, start, lengths = (among @ pull)[:, :, 0], 0, []
    for kind, *_ in block.table.type.accepts:
        lengths.append(np.linalg.norm(moved[:, start : start + _POSITION.get(kind.name, 0)], axis=1))
        start += kind.dof
    far = np.stack(lengths, axis=1)
    found.end[at], found.end_m[at] = far.argmax(axis=1), far.max(axis=1)
    found.is_alone[at] = values[:, 0] <= _LEAST
    found.cost[at] = sign * np.einsum("ni,ni->n", r, solved)


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

    Raises GraphSlamError: there is no map, it cannot be read, or it cannot be solved.

    Parameters
    ----------
    losses : a line is added for each part of the run that could not be read

    Attributes
    ----------
    view : the map, as a pipeline holds it
    solver : the solution of the run: all its accepted edges
    keyframes, numbers, stamps_ns : vertices of the keyframes that are in the graph, in order of time, their numbers
        among all keyframes, and stamps
    vertices : of the keyframes that are in the graph, by number
    segments : numbers of the keyframes at which odometry begins
    entries : in order of their edges; changes : of verdicts
    edits : by hand, in order
    landmarks : vertex of each landmark that an accepted edge is about, by its name
    held : vertices of a frozen map
    """

    def __init__(self, folder: Path, losses: list[str]) -> None:
        self.view = view = restored(folder, losses).view
        if not view.is_solved:
            raise RunError(f"{folder}: its map cannot be solved: {view.failing}")
        self.folder, self.space, self.config = folder, view.space, view.config
        self.graph, self.solver, self.held = view.graph.copy(), view.solver, view.solver.held
        self.graph.initial.values[:] = view.solver.values
        self.entries = list(ledger_entries(view, range(self.graph.vertex_ids.next)))
        self._entries, old = {one.edge: one for one in self.entries}, view.bounded.old if view.bounded else {}
        self.changes = list(view.ledger.history)
        self.edits = view.edits
        self.ids, _ = numbered(view)
        self.keyframes: list[int] = [*(one.vertex for one in old.values()), *view.keyframes.ids.tolist()]
        self._names = {mark.vertex: name for name, mark in view.landmarks.items()}
        self.stamps_ns: list[int] = [*(one.stamp_ns for one in old.values()), *view.keyframes.stamps_ns.tolist()]
        self.segments = list(view.segments)
        joined = {vertex for entry in self.entries if entry.is_in for vertex in entry.vertices}
        self.landmarks = {name: mark.vertex for name, mark in view.landmarks.items() if mark.vertex in joined}
        self.numbers: list[int] = [*old, *range(view.keyframes.first, len(view.keyframes))]
        self._numbers = dict(zip(self.keyframes, self.numbers, strict=True))
        self.vertices = dict(zip(self.numbers, self.keyframes, strict=True))

    @cached_property
    def influence_model(self) -> InfluenceModel:
        """The influence of each edge, to first order."""
        return InfluenceModel(self.graph, self.solver, self.keyframes[-1])

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
        return WholePath.of(self.view, self.folder)

    def landmark_of(self, vertex: int) -> str:
        """The name of the landmark of a vertex; empty if it is not a landmark."""
        return self._names.get(vertex, "")

    def landmarks_of(self, entry: Entry) -> list[str]:
        """The names of the landmarks that an edge is of."""
        return [name for name in map(self.landmark_of, entry.vertices) if name]

    def edge(self, edge: int) -> Entry:
        """The ledger entry of an edge. Raises GraphSlamError for an unknown id."""
        if (entry := self._entries.get(edge)) is not None:
            return entry
        if (most := self.view.ledger.ids.next) > edge >= 0:
            why = f"since visits are condensed: {of_all(self.folder)}"
            raise GraphSlamError(f"edge {edge} is not in the map any more, {why}")
        raise GraphSlamError(f"no edge {edge}: their ids are below {most}")

    def solve(self, without: Iterable[int] = (), let_in: Sequence[int] = (), loss: Loss | None = None) -> Solver:
        """Solve the accepted edges without some, and with others at full weight, from the saved estimate.

        Raises GraphSlamError as ``problem``; GaugeError, SingularError: what is left does not determine a vertex.
        """
        solver = self.problem(without, let_in, loss)
        solver.optimize()
        return solver

    def problem(self, without: Iterable[int] = (), let_in: Sequence[int] = (), loss: Loss | None = None) -> Solver:
        """The problem that a what-if solves, at the saved estimate.

        Raises GraphSlamError: there is no such edge, or one is both taken out and let in.

        A landmark without edges is left out. A keyframe without edges is an error.

        Parameters
        ----------
        loss : robust loss of all edges that may be outliers, instead of the run's
        """
        gone, anew = {self.edge(e).edge for e in without}, dict.fromkeys(self.edge(e).edge for e in let_in)
        if both := gone & set(anew):
            raise GraphSlamError(f"edge {min(both)}: cannot be taken out and let in at once")
        edges = [e.edge for e in self.entries if e.is_in and e.edge not in gone]
        graph, settings = self.graph, self.config.solver_settings()
        settings = replace(settings, max_iterations=max(settings.max_iterations, MOST_STEPS))
        if anew:
            graph = graph.copy()
            edges += [_accepted(graph, self._entries[edge]) for edge in anew]
            edges = [edge for edge in edges if edge not in anew]
        if loss is not None:
            settings = replace(settings, losses={label: [loss] for label in settings.losses})
        solver = Solver(graph, settings)
        vertices = np.unique([*self.keyframes, *(v for edge in edges for v in graph.ends_of(edge))])
        solver.add(vertices, edges)
        for vertex in np.intersect1d(vertices, self.held).tolist():
            solver.hold(vertex)
        return solver

    def moved(self, solver: Solver) -> MovedVertex:
        """Compare a solution with that of the run."""
        a, b = self.solver.estimate(self.keyframes), solver.estimate(self.keyframes)
        distance = np.linalg.norm(b[:, : self.space.dimensions] - a[:, : self.space.dimensions], axis=1)
        turned = self.space.angle(self.space.group.between(tuple(a[-1]), tuple(b[-1])))
        inside = np.array([e.edge for e in self.entries if e.is_in], dtype=np.int64)
        before, after = self.solver.chi2_of(inside)[0], solver.chi2_of(inside)[0]
        worse = [k for k in np.argsort(before - after, kind="stable").tolist() if after[k] > before[k]]
        return MovedVertex(
            self.solver.evaluate(),
            solver.evaluate(),
            (float(distance[-1]), float(turned)),
            (self.keyframes[int(distance.argmax())], float(distance.max())),
            [(int(inside[k]), float(before[k]), float(after[k])) for k in worse],
        )

    def influences(self, count: int) -> list[Influence]:
        """The judged edges without which the last keyframe would move most, ranked to first order."""
        judged = [row for row, e in enumerate(self.entries) if e.is_in and e.verdict]
        first = self.influence_model.of([self.entries[row].edge for row in judged]).last_m[judged]
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


def _accepted(graph: Graph, entry: Entry) -> int:
    """Add a rejected edge again, as one that is never rejected."""
    edge = graph.edge(entry.edge)
    return graph.add_edge(edge.type, entry.vertices, entry.measured, Gaussian(edge.sqrt_information), _ACCEPTED)
