"""Outlier rejection: closures, sightings and fixes are candidates, odometry is not.

A candidate that is too unlikely given all earlier measurements is held back: its innovation is compared with the joint
covariance of its vertices and its own (Neira and Tardos, "Data association in stochastic mapping using the joint
compatibility test", 2001, eq. 2). One that fits badly loses weight, then is removed; all are judged again and again.

The innovation predicts what accepting an edge costs. Where odometry is rough and closures are exact, an edge is
millions off before the solve, and fits after it. A robust loss lets go of such a residual at the first step. So an edge
that is expected to fit has its full weight until the solve has converged, and is judged then.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.pipeline import RobustConfig
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.slam.levels import ENOUGH, GROWN, TYPICAL
from graph_slam_ros.slam.robust.innovation import innovations, likely_together
from graph_slam_ros.slam.robust.landmark_support import is_determined, is_needed, landmark_of
from graph_slam_ros.slam.robust.ledger import FINAL, OUTSIDE, Ledger, Reason, Verdict
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.typing import Array, Index

CANDIDATES = ("landmarks", "fixes", "closures", "initialpose")
_READMISSIONS = 50  # edges that are out and are tried again after everything was solved
_RETESTS = 10  # of them at once, and at each review: ten innovations cost less than an update
_OUT_BELOW = 0.01  # of its weight: what counts for less moves nothing, and is removed
_UPDATES = 6  # until what was let in fits, before everything is solved for it
_REVIEWED_AT_ONCE = 1000  # accepted edges that one review looks at, besides as many of the newest
_SLACK = 10.0  # times the residuals that are typical of a class its gate may be, where they are small
_TIGHTEST = 1.0 / _SLACK  # part of a gate that is left
_REDUNDANT = 0.05  # of a measurement, that others say too: below, its residual says nothing of its noise


class OutlierGate:
    """Judges the candidates among the edges of a graph. Its verdicts are weights, recorded in its ledger.

    Attributes
    ----------
    is_calibrated : whether enough was measured twice to tell how good odometry is
    stated_scale : the factor by which the gate of an innovation exceeds the chi-square quantile, by noise as stated
    gate_scale : the same times the observed accuracy of odometry
    """

    def __init__(self, config: RobustConfig, graph: Graph, solver: Solver, ledger: Ledger | None = None) -> None:
        self._config, self._graph, self._solver = config, graph, solver
        self.ledger = Ledger() if ledger is None else ledger
        self._tightness = Tightness(graph, solver)
        self.is_calibrated = False
        self.gate_scale = self.stated_scale = config.noise_factor**2
        self._withdrawn: dict[int, Reason] = {}  # before they were taken
        self._vertices = 0  # those below were in the graph at the last solve
        self._next = 0  # of the accepted, where the next review goes on
        self._next_out = 0  # and of those that are out

    # -- what is new -------------------------------------------------------------------------------------------------

    def gate_new(self, end: int, keyframe: int, *, trusts_sightings: bool = True) -> list[int]:
        """Judge the new edges, up to an id, by their own noise.

        Those that fit are accepted. The others are returned and held back, as are all sightings if none is trusted.
        """
        ids = np.arange(self.ledger.ids.next, end)
        chi2, numbers = self._solver.chi2_of(ids)
        limit, judged = self._limits(ids, numbers), self._graph.has_label(ids, CANDIDATES)
        judged &= ~np.isin(ids, list(self._withdrawn))
        self.ledger.enter(keyframe, chi2, numbers, limit, self._solver.residuals_of(ids), judged)
        for edge, reason in self._withdrawn.items():
            self.ledger.note(edge, keyframe, Verdict.REJECTED, reason, _judged(self.ledger, edge)[0])
        self._withdrawn.clear()
        pending, unfit = list[int](), set(ids[chi2 > limit].tolist())
        for edge in ids[judged & self._config.decide].tolist():
            is_unfit = edge in unfit and not is_needed(self._solver, edge)  # by what is left of those before it
            if is_unfit or (not trusts_sightings and self._is_of_known(edge)):
                self._solver.set_weight(edge, 0.0)
                self.ledger.put(edge, Verdict.PENDING, Reason.UNLIKELY)
                pending.append(edge)
        self._vertices = self._graph.vertex_ids.next
        return pending

    def _is_of_known(self, edge: int) -> bool:
        """Return whether its landmark was part of the last solve: without the edge it is determined as before."""
        landmark = landmark_of(self._graph, edge)
        return landmark is not None and landmark < self._vertices

    def admit_compatible(self, pending: Sequence[int], keyframe: int) -> list[int]:
        """Compare held-back edges with the estimate, the likeliest first; returns those that are accepted."""
        out, admitted = list(pending), list[int]()
        while out:
            innovation = dict(zip(out, self.innovations(out), strict=True))
            likely = [edge for edge in out if self._is_likely(edge, innovation[edge])]
            if not likely:
                break
            best = min(likely, key=lambda edge: innovation[edge] / _judged(self.ledger, edge)[1])
            for edge in likely if admitted else [best]:
                self._readmit(edge, keyframe, innovation[edge], self._innovation_gate(edge))
                admitted.append(edge)
            out = [edge for edge in out if not self.ledger.is_inside(edge)]
            if out:
                self._solver.update()
        for edge in out:
            self.ledger.note(
                edge, keyframe, Verdict.PENDING, Reason.UNLIKELY, innovation[edge], self._innovation_gate(edge)
            )
        return admitted

    def unfit(self, edges: Sequence[int]) -> list[int]:
        """Return those of some edges that do not fit at the present estimate."""
        chi2, _ = self._solver.chi2_of(edges)
        limits = self.ledger.threshold.values[self.ledger.ids.existing(edges)]
        return [edges[k] for k in np.flatnonzero(chi2 > limits).tolist()]

    def refuse_unfit(self, edges: Sequence[int], keyframe: int) -> bool:
        """Reject those of some edges that still do not fit. Returns whether there were any."""
        unfit = self.unfit(edges)
        for edge, fit in zip(unfit, self._solver.chi2_of(unfit)[0].tolist(), strict=True):
            self.decide(edge, keyframe, Verdict.REJECTED, Reason.DOES_NOT_FIT, fit)
        return len(unfit) > 0

    # -- what was decided ---------------------------------------------------------------------------------------------

    def review(self, keyframe: int) -> None:
        """Judge the newest verdicts again and, in turn, some of the others."""
        self.recalibrate()
        inside = self.ledger.inside
        if len(inside) > 2 * _REVIEWED_AT_ONCE:
            self._next = (self._next + _REVIEWED_AT_ONCE) % (len(inside) - _REVIEWED_AT_ONCE)
            older = np.arange(self._next, self._next + _REVIEWED_AT_ONCE) % (len(inside) - _REVIEWED_AT_ONCE)
            inside = np.concatenate((np.unique(inside[older]), inside[-_REVIEWED_AT_ONCE:]))
        self._reweight(inside, keyframe)
        outside = self.ledger.outside
        chi2, _ = self._solver.chi2_of(outside)
        rows = self.ledger.ids.rows(outside)
        fits = chi2 <= self.ledger.threshold.values[rows]
        for edge, fit in zip(outside[fits].tolist(), chi2[fits].tolist(), strict=True):
            self._readmit(edge, keyframe, fit)
        others = outside[~fits & (self.ledger.verdict.values[rows] == Verdict.PENDING)].tolist()
        turn = [others[(self._next_out + k) % len(others)] for k in range(min(_RETESTS, len(others)))]
        self._next_out += len(turn)
        judged = list(zip(turn, self.innovations(turn), strict=True))
        for edge, fit in [(edge, fit) for edge, fit in judged if self._is_likely(edge, fit)]:
            self._readmit(edge, keyframe, fit, self._innovation_gate(edge))

    def reclassify(self, keyframe: int) -> bool:
        """Judge all candidates again after a full solve, by their residuals. Returns whether a verdict changed."""
        self.recalibrate()
        ledger, changed = self.ledger, False
        inside, outside = ledger.inside, ledger.outside
        for edges, out in ((inside, True), (outside, False)):
            chi2, _ = self._solver.chi2_of(edges)
            other = (chi2 > ledger.threshold.values[ledger.ids.rows(edges)]) == out
            for edge, fit in zip(edges[other].tolist(), chi2[other].tolist(), strict=True):
                if not out:
                    self._readmit(edge, keyframe, fit)
                elif is_needed(self._solver, edge):
                    continue
                else:
                    self.decide(edge, keyframe, Verdict.REJECTED, Reason.DOES_NOT_FIT, fit)
                changed = True
        return changed

    def readmit_next(self, keyframe: int, costs: dict[int, float]) -> bool:
        """Accept the rejected edge that fits best, if it would fit once accepted. Returns whether there was one.

        Parameters
        ----------
        costs : gets the innovations that were computed, by edge
        """
        nearest = self._nearest()
        for begin in range(0, len(nearest), _RETESTS):
            some = nearest[begin : begin + _RETESTS]
            costs |= zip(some, self.innovations(some), strict=True)
            for edge in some:
                if costs[edge] <= _judged(self.ledger, edge)[1] and self._is_likely(edge, costs[edge]):
                    self._readmit(edge, keyframe, costs[edge])
                    return True
        return False

    def readmit_group(self, keyframe: int, costs: Mapping[int, float]) -> list[int]:
        """Accept, as a trial, the rejected edges that may be likely together. Returns them: none, or at least two.

        A group costs at least what each of its edges costs alone. So one that costs more than all their gates together
        is in no such group.

        Parameters
        ----------
        costs : innovations, by edge
        """
        group = self._affordable(costs)
        for edge in group:
            self._readmit(edge, keyframe, costs[edge])
        return group

    def readmit_likely_group(self, keyframe: int) -> list[int]:
        """Accept those of the rejected edges that fit best of which each is likely given the others, though not alone.

        Their costs follow from their joint covariance, so nothing is solved for edges that stay out.
        """
        nearest = self._nearest(_RETESTS)
        costs = dict(zip(nearest, self.innovations(nearest), strict=True))
        group = likely_together(self._graph, self._solver, self._affordable(costs), self.most_cost, ENOUGH)
        for edge in group:
            self._readmit(edge, keyframe, costs[edge])
        return group

    def _affordable(self, costs: Mapping[int, float]) -> list[int]:
        """Return the edges of which none costs more than all may together: none, or at least two."""
        group = list(costs)
        while group and max(map(costs.__getitem__, group)) > (most := self.most_cost(group)):
            group = [edge for edge in group if costs[edge] <= most]
        return group if len(group) > 1 else []

    def _nearest(self, count: int = _READMISSIONS) -> list[int]:
        """Return the rejected edges that fit best."""
        outside = self.ledger.outside
        chi2, _ = self._solver.chi2_of(outside)
        nearest: list[int] = outside[np.argsort(chi2, kind="stable")[:count]].tolist()
        return nearest

    def most_cost(self, edges: Sequence[int]) -> float:
        """Return what some rejected edges may cost together: for each its gate, or the limit of its residual."""
        return sum(min(self._innovation_gate(edge), _judged(self.ledger, edge)[1]) for edge in edges)

    def withdraw(self, edges: Sequence[int], keyframe: int, reason: Reason = Reason.WITHDRAWN) -> None:
        """Remove edges permanently, for a reason other than their fit.

        If only rejected edges are left of a landmark, they are accepted again, because nothing else determines it.
        """
        for edge in edges:
            if edge >= self.ledger.ids.next:
                self._solver.set_weight(edge, 0.0)
                self._withdrawn[edge] = reason
            elif not self.ledger.is_withdrawn(edge):
                self.decide(edge, keyframe, Verdict.REJECTED, reason, _judged(self.ledger, edge)[0])
        landmarks = {landmark for edge in edges if (landmark := landmark_of(self._graph, edge)) is not None}
        for landmark in sorted(landmarks):
            if not is_determined(self._solver, landmark):
                self._readmit_all(self._solver.edges_on(landmark), keyframe)

    def _readmit_all(self, edges: Index, keyframe: int) -> None:
        """Accept all of these edges that were rejected, but not permanently."""
        for edge in np.intersect1d(edges, self.ledger.outside).tolist():
            if self.ledger.reason.values[self.ledger.ids.row(edge)] not in FINAL:
                self._readmit(edge, keyframe, *_judged(self.ledger, edge))

    def are_beyond_noise(self, edges: Sequence[int]) -> bool:
        """Return whether most of some rejected edges are farther off than odometry's noise as stated explains."""
        numbers = self.ledger.numbers.values[self.ledger.ids.existing(edges)].tolist()
        limits = [self.stated_scale * quantile(self._config.gate, one) for one in numbers]
        far = [cost > limit for cost, limit in zip(self.innovations(edges), limits, strict=True)]
        return 2 * sum(far) > len(far)

    def innovations(self, edges: Sequence[int]) -> list[float]:
        """Return the cost of accepting each of some rejected edges; infinite if it cannot be computed."""
        return innovations(self._graph, self._solver, edges)

    def exchange(self, included: Sequence[int], excluded: Sequence[int], keyframe: int) -> None:
        """Accept some edges and reject others, which may come back. Their fit is judged afterwards."""
        for edge in included:
            if not self.ledger.is_inside(edge):
                self._readmit(edge, keyframe, _judged(self.ledger, edge)[0])
        for edge in excluded:
            if self.ledger.is_inside(edge) and not is_needed(self._solver, edge):
                self.decide(edge, keyframe, Verdict.REJECTED, Reason.DOES_NOT_FIT, _judged(self.ledger, edge)[0])

    def adopt_verdicts(self, other: Ledger, keyframe: int) -> bool:
        """Take over the verdicts of a search on the same edges. Returns whether that changed one."""
        mine = self.ledger
        edges = mine.ids.since(mine.final)
        edges = edges[edges < other.ids.next]
        rows = mine.ids.rows(edges)
        is_judged = mine.verdict.values[rows] != Verdict.NOT_EVALUATED
        standing = edges[is_judged & ~np.isin(mine.reason.values[rows], FINAL)]
        return self._set_verdicts(standing, np.isin(standing, other.inside), keyframe, other)

    def force_inliers(self, edges: Index, keyframe: int) -> None:
        """Accept these candidates and no others, as a trial."""
        candidates = self.ledger.candidates
        self._set_verdicts(candidates, np.isin(candidates, edges), keyframe, self.ledger)

    def _set_verdicts(self, edges: Index, wanted: NDArray[np.bool_], keyframe: int, judge: Ledger) -> bool:
        """Accept the wanted edges, and reject the others. Returns whether a verdict has changed."""
        inside = np.isin(edges, self.ledger.inside)
        changed = 0
        for edge in edges[wanted & ~inside].tolist():
            self._readmit(edge, keyframe, *_judged(judge, edge))
            changed += 1
        for edge in edges[~wanted & inside].tolist():
            if not is_needed(self._solver, edge):
                statistic, threshold = _judged(judge, edge)
                self.decide(edge, keyframe, Verdict.REJECTED, Reason.OUTVOTED, statistic, threshold)
                changed += 1
        return changed > 0

    def _reweight(self, edges: Index, keyframe: int) -> None:
        """Reduce the weight of edges, or reject them, by the weight that their losses leave."""
        ledger = self.ledger
        chi2, _ = self._solver.chi2_of(edges)
        rows = ledger.ids.rows(edges)
        unfit = chi2 > ledger.threshold.values[rows]
        again = ~unfit & (ledger.verdict.values[rows] == Verdict.DOWN_WEIGHTED)
        for edge, fit in zip(edges[again].tolist(), chi2[again].tolist(), strict=True):
            ledger.note(edge, keyframe, Verdict.ACCEPTED, Reason.NONE, fit)
        for edge, fit in zip(edges[unfit].tolist(), chi2[unfit].tolist(), strict=True):
            loss = self._solver.settings.last_loss(self._graph.label_of(edge), self._graph.source_of(edge))
            weight, _ = weight_and_cost(loss.kind, loss.scale, fit)
            if weight < _OUT_BELOW and not is_needed(self._solver, edge):
                self.decide(edge, keyframe, Verdict.REJECTED, Reason.DOES_NOT_FIT, fit)
            elif weight < 1.0 and ledger.verdict_of(edge) is Verdict.ACCEPTED:
                ledger.note(edge, keyframe, Verdict.DOWN_WEIGHTED, Reason.NONE, fit)

    def _is_likely(self, edge: int, innovation: float) -> bool:
        return innovation <= self._innovation_gate(edge)

    def _innovation_gate(self, edge: int) -> float:
        """Return the threshold of an innovation."""
        return self.gate_scale * quantile(self._config.gate, int(self.ledger.numbers.values[self.ledger.ids.row(edge)]))

    # -- the solve after something was accepted ----------------------------------------------------------------------

    def make_fit(self, admitted: Sequence[int], keyframe: int, *, by_innovation: bool = False) -> None:
        """Solve until edges that were accepted despite a bad fit do fit. Those that still do not are rejected.

        Their loss lets go of large residuals. They have their full weight only if they are expected to fit, or while
        the accuracy of odometry is unknown: it would bend the map for false edges that are barely possible.

        Parameters
        ----------
        by_innovation : whether the statistic of each is its innovation; where that is within its threshold, the edge
            is expected to fit
        """
        solver = self._solver
        before = solver.values
        for _ in range(_UPDATES):
            solver.update()
            if not self.unfit(admitted):
                break
        if self._rose_since(before):  # an update's steps may overshoot where much turns; everything at once does not
            solver.start_at(before)
        elif not self.unfit(admitted):
            return
        if by_innovation and self.is_calibrated:
            admitted = self._pull(admitted, keyframe)
            if not self.unfit(admitted):
                return
        pulling = [] if self.is_calibrated else [Loss()]
        losses = {key: [*pulling, stages[-1]] for key, stages in solver.settings.losses.items()}
        solver.optimize(replace(solver.settings, losses=losses))
        if self.refuse_unfit(admitted, keyframe):
            solver.update()

    def _pull(self, admitted: Sequence[int], keyframe: int) -> list[int]:
        """Solve with the full weight of edges that are expected to fit. Returns the others, which have none meanwhile.

        If the cost is higher than without them, the prediction was wrong: they are rejected, and the estimate stays.
        """
        solver, ledger = self._solver, self.ledger
        unfit = np.array(self.unfit(admitted), dtype=np.int64)
        rows = ledger.ids.rows(unfit)
        is_expected = ledger.statistic.values[rows] <= ledger.threshold.values[rows]
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
        if self.refuse_unfit(expected, keyframe) or others:
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
        ledger, edges = self.ledger, self._solver.edges
        chi2, _ = self._solver.chi2_of(edges)
        limit = np.where(np.isin(edges, ledger.inside), ledger.threshold.values[ledger.ids.rows(edges)], np.inf)
        return float(np.minimum(chi2, limit).sum())

    def _rose_since(self, before: Array) -> bool:
        return self._solver.evaluate().cost_final > self._solver.evaluate(at=before).cost_final

    # -- one edge ----------------------------------------------------------------------------------------------------

    def decide(
        self,
        edge: int,
        keyframe: int,
        verdict: Verdict,
        reason: Reason,
        statistic: float,
        threshold: float | None = None,
    ) -> None:
        """Change the verdict on an edge that was judged, and its weight with it: nothing else does."""
        is_in = verdict not in OUTSIDE
        if (self.ledger.verdict_of(edge) not in OUTSIDE) != is_in:
            self._solver.set_weight(edge, float(is_in))
        self.ledger.note(edge, keyframe, verdict, reason, statistic, threshold)

    def _readmit(self, edge: int, keyframe: int, statistic: float, threshold: float | None = None) -> None:
        self.decide(edge, keyframe, Verdict.ACCEPTED, Reason.NONE, statistic, threshold)

    # -- what is too much --------------------------------------------------------------------------------------------

    def _limits(self, edges: Index, numbers: Index) -> Array:
        """Return the thresholds of chi2: the gate, or less if residuals of a class are far below their noise."""
        limit = {n: quantile(self._config.gate, n) for n in set(numbers.tolist())}
        out = np.array([limit[n] for n in numbers.tolist()], dtype=float)
        for label, tightness in self._tightness.of_class.items():
            out[self._graph.has_label(edges, (label,))] *= tightness
        return out

    def cautious_losses(self) -> dict[str, list[Loss]]:
        """Losses by class that let go of false candidates: Huber's, then DCS."""
        stages = [Loss.named(name, self._config.loss_scale) for name in ("huber", "dcs")]
        return dict.fromkeys(CANDIDATES, stages)

    def recalibrate(self) -> None:
        """Adapt the gates to the residuals: with a configured noise that is ten times too large they would accept all.

        The median of accepted residuals is compared with what is expected. False candidates do not change it.
        """
        inside, ledger, factor = self.ledger.inside, self.ledger, self._config.noise_factor**2
        chi2, numbers = self._solver.chi2_of(inside)
        for label in CANDIDATES:
            of_label = self._graph.has_label(inside, (label,))
            self._tightness.update(label, inside[of_label], chi2[of_label], numbers[of_label])
        freedom = self._solver.degrees_of_freedom
        self.is_calibrated = freedom >= TYPICAL
        if self.is_calibrated:
            # estimated noise allows for errors that are alike, so residuals are smaller: that says nothing of odometry
            is_stated = self._config.noise_scale == "configured"
            noise_ratio = self._solver.evaluate().chi2_final / freedom if is_stated else 1.0
            self.gate_scale = min(factor, max(_TIGHTEST, factor * noise_ratio))
        edges = ledger.candidates
        rows = ledger.ids.rows(edges)
        ledger.threshold.values[rows] = self._limits(edges, ledger.numbers.values[rows])


class Tightness:
    """The factor of each class's gate, from 0.1 to 1: less where its residuals are smaller than its noise says.

    With a configured noise that is ten times too large, a gate would accept everything. Residuals show that only where
    several measurements say the same. A closure of 1 mm after rough odometry fits exactly once it is accepted. So they
    are compared with what the edges' redundancy leaves of their noise.
    """

    def __init__(self, graph: Graph, solver: Solver) -> None:
        self._graph, self._solver = graph, solver
        self.of_class: dict[str, float] = {}
        self._redundancy: dict[str, tuple[int, float]] = {}  # of each class: of so many edges, a median

    def update(self, label: str, edges: Index, chi2: Array, numbers: Index) -> None:
        """Compare the residuals of a class's accepted edges with their noise. False ones do not change a median."""
        if len(edges) < TYPICAL:
            return
        ratio = _SLACK * float(np.median(chi2 / np.array([_median(n) for n in numbers.tolist()])))
        if ratio < 1.0:
            redundancy = self._redundancy_of(label, edges)
            ratio = ratio / redundancy if redundancy >= _REDUNDANT else 1.0
        self.of_class[label] = min(1.0, max(_TIGHTEST, ratio))

    def _redundancy_of(self, label: str, edges: Index) -> float:
        """Return the median redundancy of a class, by some of its edges, from 0 to 1; of old ones while it grows."""
        count, known = self._redundancy.get(label, (0, 0.0))
        if len(edges) >= GROWN * count:
            some = np.linspace(0, len(edges) - 1, TYPICAL).astype(int)
            try:
                found = [self._left_of(*of_table) for of_table in self._graph.by_table(edges[some]).items()]
            except (GraphSlamError, np.linalg.LinAlgError):
                return known
            known = float(np.median(np.concatenate(found)))
            self._redundancy[label] = len(edges), known
        return known

    def _left_of(self, table: EdgeTable, rows: Index) -> Array:
        """Return the expected chi2 (n,) of the residuals of accepted edges, for each number that they measure."""
        some = table.at(rows)
        ends = some.vertices
        joint = self._solver.edge_marginals(ends)
        _, jacobian = table.type.linearize(self._solver.values, self._graph.begins(ends), some.measured)
        white = some.sqrt_information @ jacobian
        return 1.0 - np.einsum("nij,njk,nik->n", white, joint, white) / white.shape[1]


@cache
def _median(numbers: int) -> float:
    return quantile(0.5, numbers)


def _judged(ledger: Ledger, edge: int) -> tuple[float, float]:
    """The statistic and its threshold."""
    row = ledger.ids.row(edge)
    return float(ledger.statistic.values[row]), float(ledger.threshold.values[row])
