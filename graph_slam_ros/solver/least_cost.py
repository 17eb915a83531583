"""The least cost of a measurement over steps of its vertices, where it is too far from linear to be computed in one."""

import numpy as np
from scipy.optimize import leastsq

from graph_slam_ros.graph import GROUPS, Edge, Graph
from graph_slam_ros.typing import Array

_CONVERGED = 1e-6  # of costs and steps: where they change less, a search has ended
_MOST_STEPS = 60  # of a search: with extreme numbers it would creep for seconds; the least it has found is taken


def least_cost(graph: Graph, x: Array, edge: Edge, covariance: Array) -> float:
    """Return the minimum of ``|u|^2 + |R r(x [+] L u)|^2`` that is found from ``u = 0``.

    Parameters
    ----------
    x : stored numbers of all vertices
    covariance : (D, D) ``L L'`` of the vertices of the edge
    """
    variances, axes = np.linalg.eigh(covariance)
    sigmas = axes * np.sqrt(np.maximum(variances, 0.0))
    ends = [graph.vertex(vertex) for vertex in edge.vertices]
    at = np.cumsum([[0, *(end.kind.size for end in ends[:-1])]], axis=1)
    parts = np.cumsum([end.kind.dof for end in ends[:-1]])

    def linearized(step: Array) -> tuple[Array, Array]:
        steps = np.split(step, parts)
        moved = [end.kind.retract(x[end.stored][None], d[None])[0] for end, d in zip(ends, steps, strict=True)]
        return edge.type.linearize(np.concatenate(moved), at, edge.measured[None])

    def white(units: Array) -> Array:
        return np.concatenate((units, edge.sqrt_information @ linearized(sigmas @ units)[0][0]))

    def slope(units: Array) -> Array:
        step = sigmas @ units
        by_end = np.split(linearized(step)[1][0], parts, axis=1)
        for k, (end, d) in enumerate(zip(ends, np.split(step, parts), strict=True)):
            if end.kind in GROUPS:
                by_end[k] = by_end[k] @ GROUPS[end.kind].right_jacobian(tuple(d))
        return np.vstack((np.eye(len(units)), edge.sqrt_information @ np.hstack(by_end) @ sigmas))

    start, tolerances = np.zeros(len(sigmas)), (_CONVERGED, _CONVERGED, _CONVERGED)
    found = leastsq(white, start, (), slope, True, False, *tolerances, _MOST_STEPS)[2]["fvec"]
    return float(found @ found)
