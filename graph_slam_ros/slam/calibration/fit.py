"""The trial fit: all unknowns of a graph and the parameters together, by bordered least squares on a copy.

The parameters are no vertices: with H of the graph's own unknowns and B of these with the parameters, their information
is the Schur complement ``C - B' H^-1 B``, dense and small. So the solver, its kernels and a graph in which nothing is
admitted stay as they are. A value is taken over by correcting what edges have measured.

The rows of the parameters' columns less what the other unknowns explain of them, ``P - J H^-1 B``, give the rest: the
information of any part of the drive, and scores whose sums by landmark and by stretches of time are the sandwich
covariance (White, "Maximum likelihood estimation of misspecified models", 1982): errors that are alike count once.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import VertexKind
from graph_slam_ros.slam.calibration.parameters import Parameter
from graph_slam_ros.slam.calibration.rows import Linearization, Rows, TrialProblem
from graph_slam_ros.typing import Array, Index

_ITERATIONS, _CAUTIOUS = 12, 2  # of all, and of the first with the first stage of the losses
_STILL = 0.02  # of a sigma of each parameter
_STRIDE_M, _STRIDE_RAD, _STRIDE = 1.0, 0.3, 0.2  # the largest step of a pose, an angle, a parameter
_BLOCK_S = 30.0  # errors within are taken for alike
_LOST = 0.1  # of its weight: a sighting with less is not believed


@dataclass(frozen=True, slots=True)
class TrialFit:
    """The outcome of a trial fit of some parameters.

    Attributes
    ----------
    parameters : (p,)
    values : (p,) corrections; 0 is what is configured
    priors : (p,) their sigmas, around 0
    covariance : (p, p) by curvature
    robust_covariance : (p, p) where errors by one landmark, or within half a minute, are taken for alike
    first, second : estimates (p,) from the halves of the drive that tell as much of each parameter
    lost : part of the sightings that have less than a tenth of their weight
    path : stored numbers of all vertices
    sensitivity : (unknowns, p) steps of all unknowns with each parameter
    shift : (unknowns,) steps from the estimate that the fit began at to ``path``
    column : (vertices,) first row of each vertex in ``sensitivity`` and ``shift``, or -1
    evidence : logarithm of the likelihood of all measurements, whatever unknowns and parameters are, but for a constant
    slips : whether odometry counts for less where slips were found
    doubted : parameters that something else explains as well: value, sigma, and what
    """

    parameters: tuple[Parameter, ...]
    values: Array
    priors: Array
    covariance: Array
    robust_covariance: Array
    first: Array
    second: Array
    lost: float
    path: Array
    sensitivity: Array
    shift: Array
    column: Index
    evidence: float
    slips: bool = True
    doubted: Mapping[Parameter, tuple[float, float, str]] = field(default_factory=dict)

    def adds(self, vertex: int, dof: int) -> Array:
        """The covariance (dof, dof) that wrong parameters add to a vertex whose marginal takes them for known.

        The error is how far the fit moves the vertex. A vertex that the fit did not have gets none.
        """
        at = int(self.column[vertex]) if vertex < len(self.column) else -1
        if at < 0:
            return np.zeros((dof, dof))
        steps, bias = self.sensitivity[at : at + dof], self.shift[at : at + dof]
        spread = steps @ (self.correlation * np.outer(self.sigmas, self.sigmas)) @ steps.T
        return np.asarray(spread + np.outer(bias, bias))

    @property
    def sigmas(self) -> Array:
        """Standard deviations (p,): the larger one of curvature's and of the sandwich's."""
        plain, robust = np.diag(self.covariance), np.diag(self.robust_covariance)
        return np.asarray(np.sqrt(np.maximum(np.maximum(plain, robust), 0.0)))

    @property
    def correlation(self) -> Array:
        """Correlations (p, p) by curvature."""
        sigmas = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        return np.asarray(self.covariance / np.outer(sigmas, sigmas))

    def value(self, parameter: Parameter) -> float:
        """The correction of one parameter; 0 where it was not fitted."""
        return float(self.values[self.parameters.index(parameter)]) if parameter in self.parameters else 0.0

    def sigma(self, parameter: Parameter) -> float:
        """The sigma of one parameter of the fit."""
        return float(self.sigmas[self.parameters.index(parameter)])

    def worst_correlation(self, k: int) -> tuple[float, Parameter | None]:
        """The largest correlation of a parameter with another one, and that one."""
        row = np.abs(self.correlation[k])
        row[k] = 0.0
        other = int(row.argmax())
        return float(row[other]), self.parameters[other] if row[other] > 0.0 else None


def likelier_fit(
    problem: TrialProblem, priors: Mapping[Parameter, float], log_odds: float, start: TrialFit | None = None
) -> TrialFit:
    """Fit parameters with the slips that were found and, if there are any, without: what is wrong passes for slips.

    Returns the fit of more evidence (MacKay, "Bayesian interpolation", 1992); each slip has these odds beforehand.
    """
    if not problem.slips:
        return fit(problem, priors, start)
    without = fit(problem.without_slips(), priors, start)
    found = fit(problem, priors, start)
    return replace(without, slips=False) if without.evidence > found.evidence + log_odds * len(problem.slips) else found


def fit(problem: TrialProblem, priors: Mapping[Parameter, float], start: TrialFit | None = None) -> TrialFit:
    """Fit parameters, with sigmas of their priors, and all unknowns, from the estimate or the outcome of another fit.

    The problem stays as it is. Raises SingularError if the edges do not determine the estimate.
    """
    return _Fit(problem, priors).run(start)


class _Fit:
    def __init__(self, problem: TrialProblem, priors: Mapping[Parameter, float]) -> None:
        self._p = replace(problem, graph=problem.graph.copy())
        self._parameters, self._priors = tuple(priors), np.array(list(priors.values()))
        self._free = np.setdiff1d(problem.vertices, problem.held)
        self._linear = Linearization(self._p, self._parameters, self._free)

    def run(self, start: TrialFit | None) -> TrialFit:
        """Iterate until the parameters converge."""
        x, theta, cautious = self._p.values.copy(), np.zeros(len(self._parameters)), _CAUTIOUS
        if start is not None:
            x, theta, cautious = start.path.copy(), np.array([start.value(one) for one in self._parameters]), 0
        stages = self._p.settings.stages()
        for k in range(_ITERATIONS):
            rows = self._linear.rows(x, theta, stages[0 if k < cautious else -1])
            factor, border = _factor(rows)
            information = self._information(rows.columns - rows.jacobian @ border)
            pull = rows.jacobian.T @ rows.residual
            gradient = rows.columns.T @ rows.residual - border.T @ pull + theta / self._priors**2
            step = -np.linalg.solve(information, gradient)
            move = -factor.solve(pull) - border @ step
            part = self._stride(move, step)
            x, theta = self._moved(x, part * move), theta + part * step
            sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
            if k >= cautious and part == 1.0 and (np.abs(step) < _STILL * sigmas).all():
                break
        return self._outcome(x, theta, self._linear.rows(x, theta, stages[-1]))

    def _information(self, rest: Array) -> Array:
        """Return the information of the parameters with all else marginalised, priors included."""
        return np.asarray(rest.T @ rest + np.diag(self._priors**-2.0))

    def _stride(self, move: Array, step: Array) -> float:
        """The fraction of a step within the range of the linearisation."""
        lengths, largest = self._p.space.dimensions, float(np.abs(step).max(initial=0.0)) / _STRIDE
        for kind, _, rows in self._unknowns():
            steps = move[rows]
            turned = steps[:, lengths:] if kind is self._p.space.pose else steps[:, :0]
            largest = max(largest, float(np.abs(turned).max(initial=0.0)) / _STRIDE_RAD)
            largest = max(largest, float(np.abs(steps[:, :lengths]).max(initial=0.0)) / _STRIDE_M)
        return min(1.0, 1.0 / largest) if largest > 0.0 else 1.0

    def _moved(self, x: Array, move: Array) -> Array:
        out = x.copy()
        for kind, at, rows in self._unknowns():
            out[at] = kind.retract(x[at], move[rows])
        return out

    def _unknowns(self) -> Iterator[tuple[VertexKind, Index, Index]]:
        """Each kind, and of its unknowns the stored numbers (n, size) and the rows of their steps (n, dof)."""
        graph, column = self._p.graph, self._linear.column
        for code, kind in enumerate(graph.kinds):
            vertices = self._free[graph.kind_codes(self._free) == code]
            at = graph.begins(vertices)[:, None] + np.arange(kind.size)
            yield kind, at, column[vertices][:, None] + np.arange(kind.dof)

    # -- what it says ----------------------------------------------------------------------------------------------

    def _outcome(self, x: Array, theta: Array, rows: Rows) -> TrialFit:
        factor, border = _factor(rows)
        rest = rows.columns - rows.jacobian @ border
        information = self._information(rest)
        covariance = np.asarray(np.linalg.inv(information))
        scores = rest * rows.residual[:, None]
        sightings, shift = rows.landmark >= 0, np.zeros(self._linear.unknowns)
        for kind, at, own in self._unknowns():
            shift[own] = kind.local(self._p.values[at], x[at])
        curvature = float(np.log(np.abs(factor.U.diagonal())).sum() + np.linalg.slogdet(information)[1])
        return TrialFit(
            self._parameters,
            theta,
            self._priors,
            covariance,
            np.asarray(covariance @ self._meat(scores, rows) @ covariance),
            *self._halves(rest, scores, theta, rows.stamp_ns),
            float(np.mean(rows.weight[sightings] < _LOST)) if sightings.any() else 0.0,
            x,
            -border,
            shift,
            self._linear.column,
            -0.5 * (float(np.sum(rows.cost) + np.sum((theta / self._priors) ** 2)) + curvature),
        )

    def _meat(self, scores: Array, rows: Rows) -> Array:
        """The scatter of scores, grouped by landmark or by half a minute, whichever is larger relative to them."""
        block = ((rows.stamp_ns - self._p.stamps_ns.min()) * 1e-9 // _BLOCK_S).astype(np.int64)
        block -= block.min()
        by_landmark = np.where(rows.landmark >= 0, rows.landmark, int(rows.landmark.max()) + 1 + block)
        both = [_scatter(scores, clusters) for clusters in (block, by_landmark)]
        scale = np.maximum(np.linalg.norm(scores, axis=0), np.finfo(float).tiny ** 0.5)
        return max(both, key=lambda meat: float(np.sum(np.diag(meat) / scale**2)))

    def _halves(self, rest: Array, scores: Array, theta: Array, stamps_ns: Index) -> tuple[Array, Array]:
        """Each parameter's estimates from two halves of the drive, split at half of its information."""
        order = np.argsort(stamps_ns, kind="stable")
        out = np.zeros((2, len(theta)))
        for k in range(len(theta)):
            known = np.cumsum(rest[order, k] ** 2)
            cut = int(np.searchsorted(known, 0.5 * known[-1])) + 1
            for half, some in enumerate((order[:cut], order[cut:])):
                pull = scores[some].sum(axis=0) + self._priors**-2.0 * theta
                out[half, k] = (theta - np.linalg.solve(self._information(rest[some]), pull))[k]
        return out[0], out[1]


def _factor(rows: Rows) -> tuple[SuperLU, Array]:
    """H in factors, and ``H^-1 B``."""
    h = (rows.jacobian.T @ rows.jacobian).tocsc()
    lost = h.diagonal() == 0.0
    if lost.any():  # an unknown that has lost all its edges stays
        h += sparse.diags(lost.astype(float), format="csc")
    h.eliminate_zeros()
    try:
        factor = splu(h, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise SingularError(f"trial fit: {error}") from None
    return factor, factor.solve(np.asarray(rows.jacobian.T @ rows.columns))


def _scatter(scores: Array, clusters: Index) -> Array:
    _, at = np.unique(clusters, return_inverse=True)
    sums = np.zeros((int(at.max()) + 1, scores.shape[1]))
    np.add.at(sums, at, scores)
    count = len(sums)
    return np.asarray(sums.T @ sums * (count / max(count - 1, 1)))
