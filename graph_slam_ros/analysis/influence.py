"""The influence of edges to first order: what moves without an edge that is in, or with one that is out.

With A and r its whitened Jacobian and residual at the optimum and Sigma the joint covariance of its vertices, the
Gauss-Newton step without an edge is ``Sigma A' (I - A Sigma A')^-1 r``, by the matrix inversion lemma. The step with
one that is let in is ``-Sigma A' (I + A Sigma A')^-1 r``. The cost changes by ``r' (I -+ A Sigma A')^-1 r``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import Block, Losses, linearize, rows_of
from graph_slam_ros.typing import Array, Index

_POSITION = {"SE2": 2, "R2": 2, "SE3": 3, "R3": 3}  # first numbers of a step that are metres in map
_SAME, _STEP = 1e-3, 1e-4  # of the cost, below which a loss does nothing; of s, for its second derivative
_FLATTEST = 0.05  # curvature along a residual: a loss that redescends has a negative one
_FAR = 300.0  # growth of the cost by an edge that is let in, above which other edges lose their weight to it
_LEAST = 1e-9  # eigenvalue of I - A Sigma A': below it nothing else determines that direction


@dataclass(frozen=True, slots=True)
class Influences:
    """The influence of some edges, to first order.

    Attributes
    ----------
    edges : (n,) ids
    step : (n, dof) step of the last keyframe, in its tangent space [m, rad]; NaN where it is not known
    end : (n,) which of its vertices moves farthest: 0 is the first
    end_m : (n,) how far [m]
    cost : (n,) change of the cost of all: negative without an edge
    is_alone : (n,) whether nothing else determines one of its vertices, so that it cannot be left out
    """

    edges: Index
    step: Array
    end: Index
    end_m: Array
    cost: Array
    is_alone: NDArray[np.bool_]


class InfluenceModel:
    """The solved problem to second order, in which the influence of each edge is one step.

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
        edges = solver.edges
        self._along = np.ones(graph.edge_count)  # square root of the curvature along the residual
        self._cost = np.zeros(graph.edge_count)
        for block in linearize(graph, self._values, rows_of(graph, edges), Losses(graph, self._losses)):
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

    def without(self, edges: Sequence[int]) -> Influences:
        """The influence of edges of the problem: what changes without each of them."""
        found, place = self._empty(edges)
        known = self._solver.cross_covariances()
        plain = Losses(self._curved, {})
        for block in linearize(self._curved, self._values, rows_of(self._curved, found.edges), plain):
            rows = block.table.at(block.rows)
            block.residual[:] /= self._along[rows.ids, None] ** 2
            ends = rows.vertices
            joint, of_last = self._solver.edge_marginals(ends), known.with_vertex(self._last, ends)
            _fill(found, place[rows.ids], block, joint, of_last, -1.0)
            found.cost[place[rows.ids]] += np.sum(block.residual**2, axis=1) - self._cost[rows.ids]
        return found

    def with_them(self, edges: Sequence[int]) -> Influences:
        """The influence of edges that are out: what changes with each of them, let in without a loss.

        Steps are NaN where one step says nothing: the edge is so far off that others would lose their weight.
        """
        found, place = self._empty(edges)
        graph = self._graph.copy()
        graph.set_weights(found.edges, 1.0)
        for block in linearize(graph, self._values, rows_of(graph, found.edges), Losses(graph, {})):
            rows = block.table.at(block.rows)
            for k, ends in enumerate(rows.vertices):  # they may be far apart in the tree
                try:
                    among, of_last = self._joint(ends)
                except GraphSlamError:  # one of them is not in the problem: the edge would be its only one
                    continue
                part = replace(block, residual=block.residual[k : k + 1], jacobian=block.jacobian[k : k + 1])
                _fill(found, place[rows.ids[k : k + 1]], part, among[None], of_last[None], 1.0)
        found.step[found.cost > _FAR], found.end_m[found.cost > _FAR] = np.nan, np.nan
        return found

    def _empty(self, edges: Sequence[int]) -> tuple[Influences, Index]:
        """Influences to be filled in, and the place of each edge of the graph in them."""
        ids = np.asarray(edges, dtype=np.int64)
        place = np.zeros(self._graph.edge_count, dtype=np.int64)
        place[ids] = np.arange(len(ids))
        unknown = np.full(len(ids), np.nan)
        step = np.full((len(ids), self._graph.kind_of(self._last).dof), np.nan)
        none, false = np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
        return Influences(ids, step, none, unknown.copy(), unknown.copy(), false), place

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
