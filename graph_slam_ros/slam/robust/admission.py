"""Admission: the solve after edges were accepted by their innovation, although they do not fit the present estimate.

The innovation predicts what accepting an edge costs. Where odometry is rough and closures are exact, an edge is
millions off before the solve, and fits after it. A robust loss lets go of such a residual at the first step. So an edge
that is expected to fit has its full weight until the solve has converged, and is judged then.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.slam.robust.gating import OutlierGate
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.typing import Array

_UPDATES = 6  # until what was let in fits, before everything is solved for it


class Admission:
    """Solves for edges that were accepted, and rejects those that still do not fit."""

    def __init__(self, graph: Graph, solver: Solver, decisions: OutlierGate) -> None:
        self._graph, self._solver, self._decisions = graph, solver, decisions

    def make_fit(self, admitted: Sequence[int], keyframe: int, *, by_innovation: bool = False) -> None:
        """Solve until edges that were accepted despite a bad fit do fit. Those that still do not are rejected.

        Their loss lets go of large residuals. They have their full weight only if they are expected to fit, or while
        the accuracy of odometry is unknown: it would bend the map for false edges that are barely possible.

        Parameters
        ----------
        by_innovation : whether the statistic of each is its innovation; where that is within its threshold, the edge
            is expected to fit
        """
        solver, decisions = self._solver, self._decisions
        before = solver.values
        for _ in range(_UPDATES):
            solver.update()
            if not decisions.unfit(admitted):
                break
        if self._rose_since(before):  # an update's steps may overshoot where much turns; everything at once does not
            solver.start_at(before)
        elif not decisions.unfit(admitted):
            return
        if by_innovation and decisions.is_calibrated:
            admitted = self._pull(admitted, keyframe)
            if not decisions.unfit(admitted):
                return
        pulling = [] if decisions.is_calibrated else [Loss()]
        losses = {key: [*pulling, stages[-1]] for key, stages in solver.settings.losses.items()}
        solver.optimize(replace(solver.settings, losses=losses))
        if decisions.refuse_unfit(admitted, keyframe):
            solver.update()

    def _pull(self, admitted: Sequence[int], keyframe: int) -> list[int]:
        """Solve with the full weight of edges that are expected to fit. Returns the others, which have none meanwhile.

        If the cost is higher than without them, the prediction was wrong: they are rejected, and the estimate stays.
        """
        solver, ledger = self._solver, self._decisions.ledger
        unfit = np.array(self._decisions.unfit(admitted), dtype=np.int64)
        is_expected = ledger.statistic.values[unfit] <= ledger.threshold.values[unfit]
        expected, others = unfit[is_expected].tolist(), unfit[~is_expected].tolist()
        if not expected:
            return list(admitted)
        for edge in others:
            solver.set_weight(edge, 0.0)
        before, without = solver.values, self._truncated_cost()
        solver.optimize(self._without_loss(expected))
        if self._truncated_cost() > without:
            solver.start_at(before)
        for edge in others:
            solver.set_weight(edge, 1.0)
        if self._decisions.refuse_unfit(expected, keyframe) or others:
            solver.update()
        return [edge for edge in admitted if edge not in expected]

    def _without_loss(self, edges: Sequence[int]) -> Settings:
        """Settings by which classes of edges have no loss until everything has converged, then their last one."""
        labels, losses = {self._graph.label_of(edge) for edge in edges}, {}
        for key, stages in self._solver.settings.losses.items():
            label = key[0] if isinstance(key, tuple) else key
            losses[key] = [*([Loss()] if label in labels else []), stages[-1]]
        return replace(self._solver.settings, losses=losses)

    def _truncated_cost(self) -> float:
        """Chi2 of all edges that have a weight; of a candidate at most its threshold."""
        ledger, edges = self._decisions.ledger, self._solver.edges
        chi2, _ = self._solver.chi2_of(edges)
        limit = np.where(np.isin(edges, ledger.inside), ledger.threshold.values[edges], np.inf)
        return float(np.minimum(chi2, limit).sum())

    def _rose_since(self, before: Array) -> bool:
        return self._solver.evaluate().cost_final > self._solver.evaluate(at=before).cost_final
