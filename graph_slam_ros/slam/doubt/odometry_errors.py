"""The errors of a stretch of odometry, as observed by all other measurements, and their likelihood for a given noise.

With Q the covariance of the stretch's edges and C that of their errors given everything, the directions of
``Q^-1/2 C Q^-T/2`` with eigenvalue l have been observed by all else with variance ``l / (1 - l)``, in units of Q. Where
l is near 1 only odometry observes the direction. Such directions are left out, because rounding would decide there. The
observations of the others are Gaussian under each hypothesis on the noise, which is as residuals so far show it.
"""

from collections.abc import Sequence

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.slam.doubt.evidence import UNKNOWN, covariance_of
from graph_slam_ros.slam.levels import SINGULAR
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import linearized
from graph_slam_ros.typing import Array

_OBSERVED = 0.95  # largest eigenvalue of a direction that other measurements observe


class OdometryErrors:
    """The errors of a chain of n odometry edges, of d numbers each.

    Raises
    ------
    GaugeError, SingularError, LinAlgError
        As for ``Solver.joint_marginal``, and where rounding leaves nothing of a covariance.
    """

    def __init__(self, graph: Graph, solver: Solver, edges: Sequence[int]) -> None:
        links = [graph.edge(edge) for edge in edges]
        joint, x = solver.joint_marginal([links[0].vertices[0], *(one.vertices[1] for one in links)]), solver.values
        dof = len(joint) // (len(links) + 1)
        size = len(links) * dof
        residual, white, jacobian = np.zeros(size), np.zeros((size, size)), np.zeros((size, size + dof))
        for k, one in enumerate(links):
            rows = slice(k * dof, (k + 1) * dof)
            residual[rows], of_both = linearized(graph, x, one.type, one.vertices, one.measured)
            jacobian[rows, k * dof : (k + 2) * dof] = of_both
            white[rows, rows] = one.sqrt_information
        whitened = white @ jacobian
        eigenvalues, directions = np.linalg.eigh(whitened @ joint @ whitened.T)
        observed = eigenvalues < _OBSERVED
        left = np.maximum(eigenvalues[observed], SINGULAR)
        self._axes = directions[:, observed].T @ white  # from errors of the edges to what is observed
        self._errors, self._variances = self._axes @ residual / (1.0 - left), left / (1.0 - left)
        self._dof = dof

    def log_ratio(self, added: Array) -> float:
        """Return the logarithm of the likelihood ratio with covariances (n, d, d) that are added to the noise."""
        dof, extra = self._dof, np.zeros((len(self._errors), len(self._errors)))
        for k, one in enumerate(added):
            axes = self._axes[:, k * dof : (k + 1) * dof]
            extra += axes @ one @ axes.T
        return self._log_likelihood(extra) - self._log_likelihood(0.0 * extra)

    def _log_likelihood(self, extra: Array) -> float:
        root = np.linalg.cholesky(np.diag(1.0 + self._variances) + extra)
        white = np.linalg.solve(root, self._errors / UNKNOWN)
        return float(-np.log(np.diag(root)).sum() - 0.5 * white @ white)


def between(graph: Graph, edges: Sequence[int], others: Sequence[int]) -> Array:
    """The covariances (n, d, d) by which the noise of edges is larger than that of others."""
    return np.stack(
        [covariance_of(graph.edge(a)) - covariance_of(graph.edge(b)) for a, b in zip(edges, others, strict=True)]
    )
