"""The innovation: the difference between a measurement and its prediction, normalised by both covariances."""

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from graph_slam_ros.graph import POINT_SEEN_FROM, SE2, SE3, Graph
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.least_cost import least_cost
from graph_slam_ros.solver.linearization import linearized
from graph_slam_ros.typing import Array, Index

_ANGLES = {SE2: 1, SE3: 3}  # of a pose, its last coordinates
_REGULAR = 1e10  # times its own noise: an innovation's variance that leaves a solve enough digits
_LINEAR_RAD2 = 0.1  # of a direction: beyond, a linear prediction is none


def innovations(graph: Graph, solver: Solver, edges: Sequence[int]) -> list[float]:
    """The least that believing each edge would cost: its residual and what must give way for it, squared, in sigmas.

    With Sigma the joint covariance of its vertices, the least over a step d of ``d' Sigma^-1 d`` and the edge's chi2 at
    the estimate moved by d: ``r' (Omega^-1 + J Sigma J')^-1 r`` where the residual is linear. Where so little is known
    of a direction that it is not, the least is searched for. Infinite where it cannot be computed. The edges must not
    be part of the problem at present.

    Raises
    ------
    GaugeError, SingularError
        As for ``Solver.marginal``.
    """
    out = dict[int, float]()
    for table, rows in graph.by_table(np.array(edges, dtype=np.int64)).items():
        kinds = graph.kind_codes(table.at(rows).vertices)
        for some in [rows] if (kinds == kinds[0]).all() else np.split(rows, len(rows)):
            out |= zip(table.at(some).ids.tolist(), _least_costs(graph, solver, table, some), strict=True)
    return [out[edge] for edge in edges]


def _least_costs(graph: Graph, solver: Solver, table: EdgeTable, rows: Index) -> list[float]:
    """The least costs of rows of a table."""
    some = table.at(rows)
    ends, root = some.vertices, some.sqrt_information
    joint = solver.edge_marginals(ends, are_inside=False)
    x = solver.values  # after the covariance, which integrates pending changes
    residual, jacobian = table.type.linearize(x, graph.begins(ends), some.measured)
    predicted = jacobian @ joint @ jacobian.swapaxes(1, 2)
    white = (root @ residual[:, :, None])[:, :, 0]
    spread = root @ predicted @ root.swapaxes(1, 2) + np.eye(white.shape[1])
    is_linear = _spread(graph, x, ends, joint, predicted) <= _LINEAR_RAD2
    # lstsq where solve may lose all digits
    is_regular = is_linear & (np.trace(spread, axis1=1, axis2=2) < _REGULAR)
    out = np.full(len(rows), np.inf)
    of = white[is_regular]
    out[is_regular] = np.sum(of * np.linalg.solve(spread[is_regular], of[:, :, None])[:, :, 0], axis=1)
    for k in np.flatnonzero(~is_regular).tolist():
        with suppress(np.linalg.LinAlgError, ValueError):
            if is_linear[k]:
                out[k] = white[k] @ np.linalg.lstsq(spread[k], white[k], rcond=None)[0]
            else:
                out[k] = least_cost(graph, x, graph.edge(int(some.ids[k])), joint[k])
    return np.where(np.isfinite(out), out, np.inf).tolist()


def joint_innovations(graph: Graph, solver: Solver, edges: Sequence[int]) -> tuple[Array, Array, Index]:
    """The costs of several edges together, as parts from which each subset of them has its cost.

    Returns whitened residuals (n,), their covariance (n, n) with the edges' own noise, and the edge of each.
    With the rows of a subset, ``r' S^-1 r`` is its cost where residuals are linear. None of them may be part of the
    problem at present. Raises as ``innovations``.
    """
    ones = [graph.edge(edge) for edge in edges]
    vertices = list(dict.fromkeys(vertex for one in ones for vertex in one.vertices))
    joint, x = solver.joint_marginal(vertices), solver.values
    ends = np.cumsum([0] + [graph.kind_of(vertex).dof for vertex in vertices]).tolist()
    columns = {vertex: range(*ends[k : k + 2]) for k, vertex in enumerate(vertices)}
    residuals, rows, edge_of = list[Array](), list[Array](), list[int]()
    for edge, one in zip(edges, ones, strict=True):
        residual, jacobian = linearized(graph, x, one.type, one.vertices, one.measured)
        row = np.zeros((len(residual), ends[-1]))
        row[:, [c for vertex in one.vertices for c in columns[vertex]]] = one.sqrt_information @ jacobian
        residuals.append(one.sqrt_information @ residual)
        rows.append(row)
        edge_of += [edge] * len(residual)
    by_step = np.vstack(rows)
    return np.concatenate(residuals), by_step @ joint @ by_step.T + np.eye(len(edge_of)), np.array(edge_of)


def likely_together(
    graph: Graph, solver: Solver, edges: Sequence[int], most_cost: Callable[[Sequence[int]], float], least: int
) -> list[int]:
    """Return those of some edges of which each is likely given the others: none, or at least so many.

    The edge that costs most beyond what it may is left out, until there is none. Costs are by the joint covariance.

    Parameters
    ----------
    most_cost : what some edges may cost together
    """
    group = list(edges)
    if len(group) < least:
        return []
    try:
        white, covariance, edge_of = joint_innovations(graph, solver, group)
    except (np.linalg.LinAlgError, ValueError):
        return []

    def cost_of(some: Sequence[int]) -> float:
        rows = np.flatnonzero(np.isin(edge_of, some))
        return float(white[rows] @ np.linalg.solve(covariance[np.ix_(rows, rows)], white[rows]))

    while len(group) >= least:
        together = cost_of(group)
        without = {edge: cost_of([other for other in group if other != edge]) for edge in group}
        excess = {edge: together - without[edge] - most_cost([edge]) for edge in group}
        worst = max(group, key=excess.__getitem__)
        if excess[worst] <= 0.0:
            return group if together <= most_cost(group) else []
        group.remove(worst)
    return []


def _spread(graph: Graph, x: Array, ends: Index, joint: Array, predicted: Array) -> Array:
    """Variance (n,) [rad^2] of the directions in which the vertices (n, k) of edges see one another."""
    kinds, none = [graph.kind_of(v) for v in ends[0].tolist()], np.zeros(len(ends))
    pose = kinds[0]
    if pose not in _ANGLES:
        return none
    sighting = POINT_SEEN_FROM[pose]
    if len(kinds) > 1 and kinds[1] in sighting.accepts[1]:
        dof, size = pose.dof + kinds[1].dof, kinds[1].dof
        at, jacobian = sighting.linearize(x, graph.begins(ends[:, :2]), np.zeros((len(ends), size)))
        across = jacobian @ joint[:, :dof, :dof] @ jacobian.swapaxes(1, 2)
        return np.asarray(np.trace(across, axis1=1, axis2=2) / np.maximum(np.sum(at * at, axis=1), 1e-12))
    of_poses = predicted.shape[1] == pose.dof
    angles = np.diagonal(predicted, axis1=1, axis2=2)[:, -_ANGLES[pose] :]
    return np.asarray(angles.max(axis=1)) if of_poses else none
