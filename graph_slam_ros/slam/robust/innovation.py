"""The innovation: the difference between a measurement and its prediction, normalised by both covariances."""

from collections.abc import Callable, Sequence

import numpy as np

from graph_slam_ros.graph import POINT_SEEN_FROM, SE2, SE3, Edge, Graph
from graph_slam_ros.graph.native import native_or_plain
from graph_slam_ros.graph.retraction import code_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.least_cost import least_cost
from graph_slam_ros.solver.linearization import linearized
from graph_slam_ros.typing import Array, Index

_ANGLES = {SE2: 1, SE3: 3}  # of a pose, its last coordinates
_MOST_STEPS = 60  # of a search: with extreme numbers it would creep for seconds; the least it has found is taken
_LINEAR_RAD2 = 0.1  # of a direction: beyond, a linear prediction is none


def innovation(graph: Graph, solver: Solver, edge: int) -> float:
    """The least that believing an edge would cost: its own residual and what must give way for it, squared, in sigmas.

    With Sigma the joint covariance of its vertices, the least over a step d of ``d' Sigma^-1 d`` and the edge's chi2 at
    the estimate moved by d: ``r' (Omega^-1 + J Sigma J')^-1 r`` where the residual is linear. Where so little is known
    of a direction that it is not, the least is searched for. The edge must not be part of the problem at present.

    Raises
    ------
    GaugeError, SingularError
        As for ``Solver.marginal``.
    """
    one = graph.edge(edge)
    joint, root = solver.joint_marginal(one.vertices), one.sqrt_information
    x = solver.values  # after the covariance, which integrates pending changes
    residual, jacobian = linearized(graph, x, one.type, one.vertices, one.measured)
    predicted = jacobian @ joint @ jacobian.T
    white = root @ residual
    if _spread(graph, x, one.vertices, joint, predicted) <= _LINEAR_RAD2:
        spread = root @ predicted @ root.T + np.eye(len(white))
        least = float(white @ np.linalg.lstsq(spread, white, rcond=None)[0])
        return least if np.isfinite(least) else np.inf
    return _least_cost(graph, x, one, joint)


def joint_innovations(graph: Graph, solver: Solver, edges: Sequence[int]) -> tuple[Array, Array, Index]:
    """The costs of several edges together, as parts from which each subset of them has its cost.

    Returns whitened residuals (n,), their covariance (n, n) with the edges' own noise, and the edge of each.
    With the rows of a subset, ``r' S^-1 r`` is its cost where residuals are linear. None of them may be part of the
    problem at present. Raises as ``innovation``.
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


def _least_cost(graph: Graph, x: Array, edge: Edge, joint: Array) -> float:
    """The minimum of ``|u|^2 + |R r|^2`` over steps ``d = L u`` of the vertices, with ``L L' = Sigma``, by search."""
    variances, axes = np.linalg.eigh(joint)
    sigmas = axes * np.sqrt(np.maximum(variances, 0.0))
    ends = [graph.vertex(v) for v in edge.vertices]
    kinds = [end.kind for end in ends]
    at = np.cumsum([0] + [kind.size for kind in kinds[:-1]])
    search, (linearize,) = native_or_plain(least_cost, [edge.type.linearize])
    return float(
        search(
            linearize,
            np.concatenate([x[end.stored] for end in ends]),
            at[None],
            edge.measured[None],
            edge.sqrt_information,
            sigmas,
            np.array([code_of(kind) for kind in kinds]),
            np.array([kind.dof for kind in kinds]),
            _MOST_STEPS * (len(sigmas) + 1),
        )
    )


def _spread(graph: Graph, x: Array, vertices: Sequence[int], joint: Array, predicted: Array) -> float:
    """Variance [rad^2] of the directions in which the vertices of an edge see one another."""
    kinds = [graph.kind_of(v) for v in vertices]
    pose = kinds[0]
    if pose not in _ANGLES:
        return 0.0
    sighting = POINT_SEEN_FROM[pose]
    if len(kinds) > 1 and kinds[1] in sighting.accepts[1]:
        dof = pose.dof + kinds[1].dof
        at, jacobian = linearized(graph, x, sighting, vertices[:2], np.zeros(kinds[1].dof))
        across = jacobian @ joint[:dof, :dof] @ jacobian.T
        return float(np.trace(across) / max(float(at @ at), 1e-12))
    of_poses = len(predicted) == pose.dof
    return float(np.diag(predicted)[-_ANGLES[pose] :].max()) if of_poses else 0.0
