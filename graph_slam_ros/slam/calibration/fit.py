"""The trial fit: all unknowns of a graph and the parameters together, by bordered least squares on a copy.

The parameters are no vertices: with H of the graph's own unknowns and B of these with the parameters, their information
is the Schur complement ``C - B' H^-1 B``, dense and small. So the solver, its kernels and a graph in which nothing is
admitted stay as they are. A value is taken over by correcting what edges have measured.

The rows of the parameters' columns less what the other unknowns explain of them, ``P - J H^-1 B``, give the rest: the
information of any part of the drive, and scores whose sums by landmark and by stretches of time are the sandwich
covariance (White, "Maximum likelihood estimation of misspecified models", 1982): errors that are alike count once.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import VertexKind
from graph_slam_ros.slam.calibration.parameters import Parameter
from graph_slam_ros.slam.calibration.rows import Linearization, Rows, TrialProblem
from graph_slam_ros.slam.noise.scale import LEAST_WEIGHT
from graph_slam_ros.typing import Array, Index

_ITERATIONS, _CAUTIOUS = 12, 2  # of all, and of the first with the first stage of the losses
_STILL = 0.02  # of a sigma of each parameter
_STRIDE_M, _STRIDE_RAD, _STRIDE = 1.0, 0.3, 0.2  # the largest step of a pose, an angle, a parameter
_BLOCK_S = 30.0  # errors within are taken for alike


@dataclass(frozen=True)
class TrialFit:
    """The outcome of a trial fit of some parameters.

    Attributes
    ----------
    parameters : (p,)
    values : (p,) corrections; 0 is what is configured
    priors : (p,) their sigmas, around 0
    rest : (r, p) how the whitened residuals change with each parameter if all else follows
    residual, landmark, stamp_ns : (r,) of each row, as of ``Rows``
    lost : part of the sightings that have less than a tenth of their weight
    sensitivity : (unknowns, p) steps of all unknowns with each parameter
    shift : (unknowns,) steps from the estimate that the fit began at to its own
    column : (vertices,) first row of each vertex in ``sensitivity`` and ``shift``, or -1
    evidence : logarithm of the likelihood of all measurements, whatever unknowns and parameters are, but for a constant
    doubted : parameters that something else explains as well: value, sigma, and what
    since_ns : when odometry was in doubt first, if all parameters are what is configured until then; else 0
    """

    parameters: tuple[Parameter, ...]
    values: Array
    priors: Array
    rest: Array
    residual: Array
    landmark: Index
    stamp_ns: Index
    lost: float
    sensitivity: Array
    shift: Array
    column: Index
    evidence: float
    doubted: Mapping[Parameter, tuple[float, float, str]] = field(default_factory=dict)
    since_ns: int = 0

    def without(self, left_out: Collection[Parameter]) -> "TrialFit":
        """The fit in which some parameters are what is configured, to first order, and its evidence."""
        gone = np.array([one in left_out for one in self.parameters])
        if not gone.any():
            return self
        between, own = self.covariance[:, gone], self.covariance[np.ix_(gone, gone)]
        at_zero = np.linalg.solve(own, self.values[gone])
        step, kept = -between @ at_zero, tuple(one for one in self.parameters if one not in left_out)
        spread = np.linalg.slogdet(own)[1] - 2.0 * np.sum(np.log(self.priors[gone]))
        return TrialFit(
            kept,
            (self.values + step)[~gone],
            self.priors[~gone],
            self.rest[:, ~gone],
            self.residual + self.rest @ step,
            self.landmark,
            self.stamp_ns,
            self.lost,
            self.sensitivity[:, ~gone],
            self.shift + self.sensitivity @ step,
            self.column,
            self.evidence - 0.5 * float(self.values[gone] @ at_zero + spread),
            since_ns=self.since_ns,
        )

    @cached_property
    def covariance(self) -> Array:
        """The covariance (p, p) by curvature."""
        return np.asarray(np.linalg.inv(self._information(self.rest)))

    @cached_property
    def robust_covariance(self) -> Array:
        """The covariance (p, p) where errors by one landmark, or within half a minute, are taken for alike.

        Scores are grouped by one or the other, whichever has more scatter relative to them.
        """
        scores = self.rest * self.residual[:, None]
        block = ((self.stamp_ns - self.stamp_ns.min()) * 1e-9 // _BLOCK_S).astype(np.int64)
        by_landmark = np.where(self.landmark >= 0, self.landmark, int(self.landmark.max()) + 1 + block)
        both = [_scatter(scores, clusters) for clusters in (block, by_landmark)]
        scale = np.maximum(np.linalg.norm(scores, axis=0), np.finfo(float).tiny ** 0.5)
        meat = max(both, key=lambda one: float(np.sum(np.diag(one) / scale**2)))
        return np.asarray(self.covariance @ meat @ self.covariance)

    @cached_property
    def halves(self) -> tuple[Array, Array]:
        """Each parameter's estimates (p,) from the halves of the drive that tell as much of it."""
        if self.since_ns:
            return np.zeros(len(self.values)), self.values
        order = np.argsort(self.stamp_ns, kind="stable")
        out = np.zeros((2, len(self.values)))
        for k in range(len(self.values)):
            known = np.cumsum(self.rest[order, k] ** 2)
            cut = int(np.searchsorted(known, 0.5 * known[-1])) + 1
            for half, some in enumerate((order[:cut], order[cut:])):
                rest = self.rest[some]
                pull = rest.T @ self.residual[some] + self.priors**-2.0 * self.values
                out[half, k] = (self.values - np.linalg.solve(self._information(rest), pull))[k]
        return out[0], out[1]

    def _information(self, rest: Array) -> Array:
        return np.asarray(rest.T @ rest + np.diag(self.priors**-2.0))

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

    @cached_property
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


def fit(problem: TrialProblem, priors: Mapping[Parameter, float], log_odds: float) -> TrialFit:
    """Fit parameters, with sigmas of their priors, and all unknowns, from the estimate. The problem stays as it is.

    Where slips were found it is done with them, without, and without of what was measured since the first: what is
    wrong, or became so, passes for slips. Returned is the fit of more evidence (MacKay, "Bayesian interpolation",
    1992); each slip has these odds beforehand. Raises SingularError if the edges do not determine the estimate.
    """
    found = _Fit(problem, priors).run()
    if not problem.slips:
        return found
    stated, first = problem.without_slips(), min(own for slip in problem.slips for own, _ in slip)
    begin = np.searchsorted(problem.keyframes, problem.graph.edge(first).vertices[0])
    moved = replace(_Fit(replace(stated, first_edge=first), priors).run(), since_ns=int(problem.stamps_ns[begin]))
    best = max(_Fit(stated, priors).run(), moved, key=lambda one: one.evidence)
    return best if best.evidence > found.evidence + log_odds * len(problem.slips) else found


class _Fit:
    def __init__(self, problem: TrialProblem, priors: Mapping[Parameter, float]) -> None:
        self._p = replace(problem, graph=problem.graph.copy())
        self._parameters, self._priors = tuple(priors), np.array(list(priors.values()))
        self._free = np.setdiff1d(problem.vertices, problem.held)
        self._linear = Linearization(self._p, self._parameters, self._free)

    def run(self) -> TrialFit:
        """Iterate until the parameters converge."""
        x, theta, stages = self._p.values.copy(), np.zeros(len(self._parameters)), self._p.settings.stages()
        for k in range(_ITERATIONS):
            rows = self._linear.rows(x, theta, stages[0 if k < _CAUTIOUS else -1])
            factor, border = _factor(rows)
            information = self._information(rows.columns - rows.jacobian @ border)
            pull = rows.jacobian.T @ rows.residual
            gradient = rows.columns.T @ rows.residual - border.T @ pull + theta / self._priors**2
            step = -np.linalg.solve(information, gradient)
            move = -factor.solve(pull) - border @ step
            part = self._stride(move, step)
            x, theta = self._moved(x, part * move), theta + part * step
            sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
            if k >= _CAUTIOUS and part == 1.0 and (np.abs(step) < _STILL * sigmas).all():
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
        rest, sightings = rows.columns - rows.jacobian @ border, rows.landmark >= 0
        shift = np.zeros(self._linear.unknowns)
        for kind, at, own in self._unknowns():
            shift[own] = kind.local(self._p.values[at], x[at])
        curvature = float(np.log(np.abs(factor.U.diagonal())).sum() + np.linalg.slogdet(self._information(rest))[1])
        return TrialFit(
            self._parameters,
            theta,
            self._priors,
            rest,
            rows.residual,
            rows.landmark,
            rows.stamp_ns,
            float(np.mean(rows.weight[sightings] < LEAST_WEIGHT)) if sightings.any() else 0.0,
            -border,
            shift,
            self._linear.column,
            -0.5 * (float(np.sum(rows.cost) + np.sum((theta / self._priors) ** 2)) + curvature),
        )


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
