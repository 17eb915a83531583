"""The errors of a stretch of odometry, as observed by all other measurements, and their likelihood for a given noise.

With Q the covariance of the stretch's edges and C that of their errors given everything, the directions of
``Q^-1/2 C Q^-T/2`` with eigenvalue l have been observed by all else with variance ``l / (1 - l)``, in units of Q. Where
l is near 1 only odometry observes the direction. Such directions are left out, because rounding would decide there. The
observations of the others are Gaussian under each hypothesis on the noise. Their likelihoods are compared: the
fixed-lag form of a generalized likelihood ratio test (Willsky and Jones, "A generalized likelihood ratio approach to
the detection and estimation of jumps in linear systems", 1976).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import linearized
from graph_slam_ros.typing import Array

_OBSERVED = 0.95  # largest eigenvalue of a direction that other measurements observe
_LEAST = 1e-6


@dataclass(frozen=True)
class OdometryErrors:
    """Errors of n edges of odometry, of d numbers each, in the directions (k) that all else observes.

    Attributes
    ----------
    axes : (k, n d) from errors of the edges to these directions, in units of their noise
    errors : (k,) what is observed
    variances : (k,) of the observation
    covariance : (n d, n d) of the edges' noise as the solver has it
    noise_factor : all noise may be so many times larger
    """

    axes: Array
    errors: Array
    variances: Array
    covariance: Array
    noise_factor: float

    def log_ratio(self, variances: Array) -> float:
        """Return the logarithm of the likelihood ratio of the errors with variances (n d,) that are added."""
        extra = (self.axes * variances) @ self.axes.T / self.noise_factor**2
        return self._log_likelihood(extra) - self._log_likelihood_as_stated

    def log_ratio_of(self, covariance: Array) -> float:
        """Return the logarithm of the likelihood ratio with another covariance (n d, n d) of the noise."""
        extra = self.axes @ (covariance - self.covariance) @ self.axes.T
        return self._log_likelihood(extra) - self._log_likelihood_as_stated

    @cached_property
    def _log_likelihood_as_stated(self) -> float:
        return self._log_likelihood(np.zeros((len(self.errors), len(self.errors))))

    def _log_likelihood(self, extra: Array) -> float:
        spread = np.diag(1.0 + self.variances) + extra
        root = np.linalg.cholesky(spread)
        white = np.linalg.solve(root, self.errors / self.noise_factor)
        return float(-np.log(np.diag(root)).sum() - 0.5 * white @ white)


def odometry_errors(graph: Graph, solver: Solver, edges: Sequence[int], noise_factor: float) -> OdometryErrors:
    """Return the errors of a chain of odometry edges, as observed by all other measurements.

    Raises
    ------
    GaugeError, SingularError, LinAlgError
        As for ``Solver.joint_marginal``, and where rounding leaves nothing of a covariance.
    """
    links = [graph.edge(edge) for edge in edges]
    poses = [links[0].vertices[0], *(one.vertices[1] for one in links)]
    joint, x = solver.joint_marginal(poses), solver.values
    dof = len(joint) // len(poses)
    residual = np.zeros(len(links) * dof)
    white, jacobian = np.zeros((len(residual), len(residual))), np.zeros((len(residual), len(joint)))
    covariance = np.zeros_like(white)
    for k, one in enumerate(links):
        rows = slice(k * dof, (k + 1) * dof)
        residual[rows], of_both = linearized(graph, x, one.type, one.vertices, one.measured)
        jacobian[rows, k * dof : (k + 2) * dof] = of_both
        white[rows, rows] = one.sqrt_information
        covariance[rows, rows] = np.linalg.inv(one.sqrt_information.T @ one.sqrt_information)
    whitened = white @ jacobian
    eigenvalues, directions = np.linalg.eigh(whitened @ joint @ whitened.T)
    observed = eigenvalues < _OBSERVED
    left = np.maximum(eigenvalues[observed], _LEAST)
    axes = directions[:, observed].T @ white
    return OdometryErrors(axes, axes @ residual / (1.0 - left), left / (1.0 - left), covariance, noise_factor)
