"""Gauss-Newton and Levenberg-Marquardt on the normal equations, with losses minimised in stages."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError, SingularError
from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.graph.graph import EdgeTable
from graph_slam_ros.solver.linearization import Block, by_class, linearize, refuse_nonfinite, total
from graph_slam_ros.solver.normal import NormalEquations
from graph_slam_ros.solver.report import Iteration, Report

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TINY = 1e-12  # a cost of zero up to rounding has converged
_DAMPING_FIRST, _DAMPING_LEAST, _DAMPING_MOST, _DAMPING_FACTOR = 1e-4, 1e-12, 1e12, 10.0


@dataclass(frozen=True, slots=True)
class Settings:
    """How to solve.

    Attributes
    ----------
    method : ``gn`` (damped only after it fails to converge) or ``lm``
    max_iterations : of each stage
    step_tolerance : converged when no component of a step is larger [m, rad]
    cost_tolerance : converged when the cost changes by a smaller fraction
    losses : by label, the stages of its loss: each is minimised until converged, then the next; a label with fewer
        stages keeps its last
    """

    method: str = "gn"
    max_iterations: int = 50
    step_tolerance: float = 1e-6
    cost_tolerance: float = 1e-6
    losses: Mapping[str, Sequence[Loss]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.method not in ("gn", "lm"):
            raise GraphSlamError(f"method {self.method!r}: choose gn or lm")

    def stages(self) -> list[dict[str, Loss]]:
        """One loss per label for each stage."""
        count = max((len(stages) for stages in self.losses.values()), default=1)
        return [{name: s[min(k, len(s) - 1)] for name, s in self.losses.items()} for k in range(count)]


@dataclass(frozen=True, slots=True)
class Problem:
    """What is minimised: edges (rows of each table) over the free vertices of ``normal``."""

    graph: Graph
    rows: Mapping[EdgeTable, Index]
    normal: NormalEquations

    def linearize(self, x: Array, losses: Mapping[str, Loss]) -> list[Block]:
        """Whitened blocks of all edges at the stored values x."""
        return linearize(self.graph, x, self.rows, losses)

    def retract(self, x: Array, step: Array) -> Array:
        """``x [+] step`` over the free vertices."""
        out = x.copy()
        codes = self.graph.kind.values[self.normal.free]
        for code, kind in enumerate(self.graph.kinds):
            mine = codes == code
            at = self.graph.offset.values[self.normal.free[mine]][:, None] + np.arange(kind.size)
            out[at] = kind.retract(x[at], step[self.normal.first_dof[mine][:, None] + np.arange(kind.dof)])
        return out


@dataclass(frozen=True, slots=True)
class _Descent:
    """How one method went, from where it began."""

    x: Array
    iterations: list[Iteration]
    stop: str


def minimise(problem: Problem, x: Array, settings: Settings) -> tuple[Array, Report]:
    """Minimise stage after stage of the losses; returns the last finite iterate and the report.

    Gauss-Newton may rise on its way. It has failed when it ends above where it began, or not finite, or without
    converging, or met a singular system; then the stage is done again with damping. Damping hides what the edges
    leave open, so after it the undamped system is factored once.

    Raises
    ------
    SingularError
        The edges do not determine a vertex.
    GraphSlamError
        The cost is not finite where it starts.
    """
    stages = settings.stages()
    blocks = problem.linearize(x, stages[0])
    refuse_nonfinite(blocks)
    chi2_initial, cost_initial = total(blocks)
    iterations: list[Iteration] = []
    used, stop = settings.method, ""
    for losses in stages:
        descent = None
        if settings.method == "gn":
            descent = _gauss_newton(problem, x, losses, settings)
        if descent is None or descent.stop not in ("step", "cost"):
            descent = _levenberg_marquardt(problem, x, losses, settings)
            used = "lm"
        x, stop = descent.x, descent.stop
        iterations += descent.iterations
    blocks = problem.linearize(x, stages[-1])
    if used == "lm":
        problem.normal.assemble(blocks)
        problem.normal.factor()
    chi2, cost = total(blocks)
    classes = by_class(problem.graph, blocks)
    return x, Report(used, stop, chi2_initial, chi2, cost_initial, cost, tuple(iterations), classes)


def _gauss_newton(problem: Problem, x: Array, losses: Mapping[str, Loss], settings: Settings) -> _Descent:
    blocks = problem.linearize(x, losses)
    _, cost = total(blocks)
    cost_start = cost
    iterations: list[Iteration] = []
    for _ in range(settings.max_iterations):
        problem.normal.assemble(blocks)
        try:
            # what the edges leave open they leave open from the first step on
            lu = problem.normal.factor(check=not iterations)
            step = lu.solve(-problem.normal.gradient)
        except SingularError:
            return _Descent(x, iterations, "singular")
        x = problem.retract(x, step)
        blocks = problem.linearize(x, losses)
        previous, (chi2, cost) = cost, total(blocks)
        iterations.append(Iteration(chi2, cost, float(np.abs(step).max(initial=0.0)), 0.0))
        if not np.isfinite(cost):
            break
        stop = _converged(previous, iterations[-1], settings)
        if stop:
            risen = cost > cost_start * (1.0 + settings.cost_tolerance) + _TINY
            return _Descent(x, iterations, "diverged" if risen else stop)
    return _Descent(x, iterations, "max_iterations" if np.isfinite(cost) else "diverged")


def _levenberg_marquardt(problem: Problem, x: Array, losses: Mapping[str, Loss], settings: Settings) -> _Descent:
    """Marquardt 1963: the diagonal is enlarged until the cost falls."""
    blocks = problem.linearize(x, losses)
    _, cost = total(blocks)
    damping = _DAMPING_FIRST
    iterations: list[Iteration] = []
    while len(iterations) < settings.max_iterations:
        problem.normal.assemble(blocks)
        while True:
            step = problem.normal.factor(damping).solve(-problem.normal.gradient)
            trial = problem.retract(x, step)
            trial_blocks = problem.linearize(trial, losses)
            trial_chi2, trial_cost = total(trial_blocks)
            if trial_cost <= cost:
                break
            if damping >= _DAMPING_MOST or np.abs(step).max(initial=0.0) < settings.step_tolerance:
                return _Descent(x, iterations, "step" if damping < _DAMPING_MOST else "no_decrease")
            damping *= _DAMPING_FACTOR
        previous, x, blocks, cost = cost, trial, trial_blocks, trial_cost
        iterations.append(Iteration(trial_chi2, cost, float(np.abs(step).max(initial=0.0)), damping))
        stop = _converged(previous, iterations[-1], settings)
        if stop:
            return _Descent(x, iterations, stop)
        damping = max(damping / _DAMPING_FACTOR, _DAMPING_LEAST)
    return _Descent(x, iterations, "max_iterations")


def _converged(previous: float, last: Iteration, settings: Settings) -> str:
    """Which of the two rules of the literature holds, or an empty string."""
    if last.step <= settings.step_tolerance:
        return "step"
    if abs(previous - last.cost) <= settings.cost_tolerance * last.cost + _TINY:
        return "cost"
    return ""
