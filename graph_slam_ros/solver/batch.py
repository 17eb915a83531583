"""Batch optimisation on the clique tree: Gauss-Newton, Levenberg-Marquardt, dogleg, with losses in stages."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from graph_slam_ros.errors import SingularError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver.clique_tree import storage as its
from graph_slam_ros.solver.clique_tree.incremental import mark
from graph_slam_ros.solver.clique_tree.numeric import accept_steps, eliminate, step_by
from graph_slam_ros.solver.clique_tree.storage import NOTHING, Tree
from graph_slam_ros.solver.clique_tree.substitution import forget, step_all
from graph_slam_ros.solver.gauge import undetermined
from graph_slam_ros.solver.linearization import (
    CHUNK,
    ClassCost,
    Losses,
    blocks_of,
    costs,
    linearize,
    refuse_nonfinite,
    store,
)
from graph_slam_ros.solver.settings import Settings
from graph_slam_ros.typing import Array, Index


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step: chi2 and cost after it, its largest component [m or rad], and the damping used (0: Gauss-Newton)."""

    chi2: float
    cost: float
    step: float
    damping: float


class Change(NamedTuple):
    """Result of ``Solver.update``: what one increment cost, counted once more in each pass that linearises anew.

    Attributes
    ----------
    eliminated : vertices that were eliminated again, the new ones included
    linearized : edges that were linearised, the new ones included
    moved : vertices whose step was computed again; others may follow when they are read
    """

    eliminated: int = 0
    linearized: int = 0
    moved: int = 0


@dataclass(frozen=True, slots=True)
class Report:
    """Result of ``Solver.optimize``.

    ``chi2`` is the sum of r' Omega r without any loss; ``cost`` is what was minimised, losses applied.

    Attributes
    ----------
    stop : ``step`` (largest step below its tolerance), ``cost`` (relative decrease below its tolerance),
        ``max_iterations``, ``no_decrease`` (damping found no lower cost), ``diverged``, or ``nothing_to_do``
    method : the method that gave the result; ``lm`` also where Gauss-Newton failed and was replaced
    classes : by label
    """

    method: str
    stop: str
    chi2_initial: float
    chi2_final: float
    cost_initial: float
    cost_final: float
    iterations: tuple[Iteration, ...]
    classes: dict[str, ClassCost]

    @property
    def converged(self) -> bool:
        """Return whether one of the two convergence rules ended it."""
        return self.stop in ("step", "cost", "nothing_to_do")


_TINY = 1e-12  # a cost of zero up to rounding has converged
_ON_THE_WAY = 1e-4  # where another stage follows, what the cost still changes by is of no interest
_CRAWLS = 10  # steps of Gauss-Newton after which it is tried whether longer ones lead further down
_DAMPING_FIRST, _DAMPING_LEAST, _DAMPING_MOST, _DAMPING_FACTOR = 1e-4, 1e-12, 1e12, 10.0
_RADIUS_FIRST, _RADIUS_LEAST = 1.0, 1e-12


class BatchProblem:
    """The batch problem: the edges of a clique tree, minimised over its unknowns from the present estimate.

    Attributes
    ----------
    chi2, cost : of what was last linearised
    """

    def __init__(self, graph: Graph, tree: Tree, rows: Mapping[EdgeTable, Index], unknowns: Index) -> None:
        self.graph, self.tree, self.rows, self.unknowns = graph, tree, rows, unknowns
        self._cliques = mark(tree, unknowns)
        self._size = len(graph.initial)
        self.chi2 = self.cost = 0.0
        accept_steps(tree, unknowns)

    def linearize(self, losses: Losses, *, refuse: bool = False) -> None:
        """Put the blocks of all edges at the linearisation points into the tree; costs not finite may be refused."""
        self.chi2 = self.cost = 0.0
        self.tree.diagonal[:] = 0.0
        for b in linearize(self.graph, self.tree.value, self.rows, losses):
            if refuse:
                refuse_nonfinite(b)
            store(self.tree, b.rows, b.table.edge_row.values, b.residual, b.jacobian)
            self.chi2 += float(b.chi2.sum())
            self.cost += float(b.cost.sum())

    def solve(self, damping: float = 0.0) -> float:
        """Find the step of all unknowns, if the edges determine it; returns its largest component."""
        vertex = eliminate(self.tree, self._cliques, damping)
        if vertex != NOTHING:
            raise undetermined(self.graph, vertex)
        step_all(self.tree, self._cliques)
        return float(np.abs(self.tree.step).max(initial=0.0))

    def gradient(self) -> Array:
        """J'r over the unknowns, numbered as ``step``."""
        out = np.zeros(len(self.tree.step) + 1)  # the last is for held vertices
        for at, blocks in self._blocks():
            np.add.at(out, at, blocks[:, :, -1])
        return out[:-1]

    def curvature(self, d: Array) -> float:
        """``d' J'J d`` for a direction over the unknowns, numbered as ``step``."""
        whole = np.append(d, 0.0)
        return sum(float(np.einsum("ni,nij,nj", whole[at], b[:, :, :-1], whole[at])) for at, b in self._blocks())

    def _blocks(self) -> Iterator[tuple[Index, Array]]:
        """Yield where the rows (n, D) of edges are in ``step``, at its end if held, and their blocks (n, D, D + 1)."""
        vertex = self.tree.vertex
        for table, of_table in self.rows.items():
            for first in range(0, len(of_table), CHUNK):
                rows = of_table[first : first + CHUNK]
                ends = np.repeat(table.vertex_rows.values[rows], table.type.dofs, axis=1)
                within = np.concatenate([np.arange(dof) for dof in table.type.dofs])
                at = np.where(vertex[ends, its.FREE] == 1, vertex[ends, its.STEP] + within, len(self.tree.step))
                yield at, blocks_of(self.tree, table, rows)

    def move(self) -> None:
        """Accept the step: the estimate becomes the linearisation point."""
        accept_steps(self.tree, self.unknowns)

    def here(self) -> Array:
        """Return the linearisation points, for ``back_to``."""
        return self.tree.value[: self._size].copy()

    def back_to(self, here: Array) -> None:
        """Restore linearisation points, without a step. The linearisation is not restored."""
        self.tree.value[: self._size] = self.tree.estimate[: self._size] = here
        forget(self.tree)

    def saved(self) -> tuple[Array, Array, Array, float, float]:
        """Return linearisation points and the linearisation there, for ``restore``."""
        return self.here(), self.tree.blocks.copy(), self.tree.diagonal.copy(), self.chi2, self.cost

    def restore(self, saved: tuple[Array, Array, Array, float, float]) -> None:
        """Restore what ``saved`` returned."""
        here, self.tree.blocks[:], self.tree.diagonal[:], self.chi2, self.cost = saved
        self.back_to(here)


def minimise(problem: BatchProblem, settings: Settings) -> Report:
    """Minimise stage after stage of the losses, the last until converged; the tree is left at the last finite iterate.

    Gauss-Newton may rise on its way. It has failed when it ends above where it began, or not finite, or without
    converging, or met a singular system; then the stage is done again with damping. Damping hides what the edges
    leave open, so after it the undamped system is factored once. A SingularError where the edges do not determine a
    vertex; a GraphSlamError where the cost is not finite at the start.
    """
    stages = [Losses(problem.graph, by_label) for by_label in settings.stages()]
    problem.linearize(stages[0], refuse=True)
    chi2_initial, cost_initial = problem.chi2, problem.cost
    iterations: list[Iteration] = []
    used, stop = settings.method, ""
    on_the_way = replace(settings, cost_tolerance=max(settings.cost_tolerance, _ON_THE_WAY))
    for losses in stages:
        begin = problem.here()
        if losses is not stages[0]:
            problem.linearize(losses)
        until = settings if losses is stages[-1] else on_the_way
        fresh: list[Iteration] = []
        stop = _DESCENTS[settings.method](problem, losses, until, fresh)
        if settings.method == "gn" and stop not in ("step", "cost"):
            problem.back_to(begin)
            problem.linearize(losses)
            fresh, used = [], "lm"
            stop = _levenberg_marquardt(problem, losses, until, fresh)
        iterations += fresh
    if used != "gn":
        problem.solve()
        problem.back_to(problem.here())
    chi2, cost, classes = costs(problem.graph, problem.tree.value, problem.rows, stages[-1])
    return Report(used, stop, chi2_initial, chi2, cost_initial, cost, tuple(iterations), classes)


def _gauss_newton(problem: BatchProblem, losses: Losses, settings: Settings, iterations: list[Iteration]) -> str:
    """Gauss-Newton; where it needs many steps, with longer ones as long as they lead down.

    It takes the weight that a loss gives an edge as constant. Where weights follow the steps, these all point the same
    way and are too short (Salakhutdinov and Roweis 2003): each that leads down is followed by one twice as much longer.
    """
    start, stretch = problem.cost, 1.0
    for k in range(settings.max_iterations):
        try:
            step = problem.solve()
        except SingularError:
            return "singular"
        previous = problem.cost
        stretch *= 2.0 if k >= _CRAWLS else 1.0
        if stretch == 1.0 or not _leads_down(problem, losses, stretch):
            stretch = 1.0
            problem.move()
            problem.linearize(losses)
        iterations.append(Iteration(problem.chi2, problem.cost, stretch * step, 0.0))
        if not np.isfinite(problem.cost):
            return "diverged"
        stop = _converged(previous, iterations[-1], settings)
        if stop:
            risen = problem.cost > start * (1.0 + settings.cost_tolerance) + _TINY
            return "diverged" if risen else stop
    return "max_iterations"


def _leads_down(problem: BatchProblem, losses: Losses, stretch: float) -> bool:
    """Move by so many times the present step if the cost falls; else leave all as it is."""
    step, before = problem.tree.step.copy(), problem.saved()
    step_by(problem.tree, problem.unknowns, stretch * step)
    problem.move()
    problem.linearize(losses)
    if problem.cost < before[-1]:
        return True
    problem.restore(before)
    step_by(problem.tree, problem.unknowns, step)
    return False


def _levenberg_marquardt(problem: BatchProblem, losses: Losses, settings: Settings, iterations: list[Iteration]) -> str:
    """Enlarge the diagonal of H until the cost falls (Marquardt 1963)."""
    damping = _DAMPING_FIRST
    while len(iterations) < settings.max_iterations:
        previous, before = problem.cost, problem.saved()
        while True:
            step = problem.solve(damping)
            problem.move()
            problem.linearize(losses)
            if problem.cost <= previous:
                break
            problem.restore(before)
            if damping >= _DAMPING_MOST or step < settings.step_tolerance:
                return "step" if damping < _DAMPING_MOST else "no_decrease"
            damping *= _DAMPING_FACTOR
        iterations.append(Iteration(problem.chi2, problem.cost, step, damping))
        stop = _converged(previous, iterations[-1], settings)
        if stop:
            return stop
        damping = max(damping / _DAMPING_FACTOR, _DAMPING_LEAST)
    return "max_iterations"


def _dogleg(problem: BatchProblem, losses: Losses, settings: Settings, iterations: list[Iteration]) -> str:
    """Step from the minimum along the gradient towards the Gauss-Newton step, in a trust radius (Powell 1970)."""
    radius = _RADIUS_FIRST
    while len(iterations) < settings.max_iterations:
        slope = problem.gradient()
        largest = max(float(np.abs(slope).max(initial=0.0)), _TINY)
        along = slope / largest  # its square need not fit a double
        steepest = -along * (largest * (along @ along) / max(problem.curvature(along), _TINY))
        try:
            problem.solve()
            newton = problem.tree.step.copy()
        except SingularError:  # as where it starts: another point may tell more
            newton = steepest
        previous, before = problem.cost, problem.saved()
        while True:
            step = _within(radius, newton, steepest)
            length = float(np.abs(step).max(initial=0.0))
            promised = -2.0 * slope @ step - problem.curvature(step)
            step_by(problem.tree, problem.unknowns, step)
            problem.move()
            problem.linearize(losses)
            kept = (previous - problem.cost) / promised if promised > 0.0 else 0.0
            if problem.cost <= previous:
                break
            problem.restore(before)
            if length < settings.step_tolerance or radius < _RADIUS_LEAST:
                return "step"
            radius = 0.25 * min(radius, float(np.linalg.norm(step)))
        if kept > 0.75:
            radius = max(radius, 3.0 * float(np.linalg.norm(step)))
        elif kept < 0.25:
            radius *= 0.5
        iterations.append(Iteration(problem.chi2, problem.cost, length, 0.0))
        stop = _converged(previous, iterations[-1], settings)
        if stop:
            return stop
    return "max_iterations"


def _within(radius: float, newton: Array, steepest: Array) -> Array:
    """The point of the dogleg at a distance of at most the radius."""
    if np.linalg.norm(newton) <= radius:
        return newton
    length = float(np.linalg.norm(steepest))
    if length >= radius:
        return steepest * (radius / length)
    leg = newton - steepest
    a, b, c = float(leg @ leg), float(steepest @ leg), length**2 - radius**2
    return steepest + leg * ((-b + np.sqrt(b * b - a * c)) / a)


def _converged(previous: float, last: Iteration, settings: Settings) -> str:
    """The name of the convergence rule that holds, ``step`` or ``cost``, or an empty string."""
    if last.step <= settings.step_tolerance:
        return "step"
    if abs(previous - last.cost) <= settings.cost_tolerance * last.cost + _TINY:
        return "cost"
    return ""


_DESCENTS = {"gn": _gauss_newton, "lm": _levenberg_marquardt, "dogleg": _dogleg}
