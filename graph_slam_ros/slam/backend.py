"""The back-end: the graph, its solver, and what is believed of its edges, in step with one another."""

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from graph_slam_ros.config.pipeline import RobustConfig
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.background import Background, CancelToken, Work, guarded, run_when_asked
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.levels import GROWN
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.noise.factors import CLASSES, Key, NoiseScales
from graph_slam_ros.slam.noise.scale import NoiseScale, estimate_noise, factors_of
from graph_slam_ros.slam.revision import Applied, Revision
from graph_slam_ros.slam.robust.gating import CANDIDATES, OutlierGate
from graph_slam_ros.slam.robust.hypotheses import (
    Alternative,
    FrozenGraph,
    Outcome,
    moved_rigidly,
    search_alternatives,
)
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.solver import Report, Settings, Solver
from graph_slam_ros.typing import Array, Executor, Index, Numbers, Result

if TYPE_CHECKING:
    from graph_slam_ros.slam.snapshot import MapSnapshot

SECOND_LOOK, NOISE = "second_look", "noise_scale"  # of what is counted
_MAX_PENDING = 200  # edges that are compared with all that is known at once, at most; reviews look at the others
_NOISE_ROUNDS = 8  # at most, of estimating the scale of the noise and solving with it
_REVIEW_EVERY = 20  # keyframes: the newest verdicts are reviewed, and some of the others in turn


class Backend:
    """Solves the additions to ``graph`` keyframe by keyframe, and owns the verdicts on its edges.

    Parameters
    ----------
    start : whose graph and ledger to go on with
    executor : begins the work of a second look; the function that it returns waits for the result

    Attributes
    ----------
    path : the keyframes
    graph, solver : the problem; decisions : the outlier gate, which judges edges
    noise : adds edges to the graph, with noise in scale
    handed_over : the solver has the vertices and edges of the graph below these ids
    frozen, frozen_edges : vertices, and verdicts on edges, below these ids stay for good
    held : the same while the robot is only located (``hold_map``): vertices and edges; zeros otherwise
    holds_back : whether what does not fit stays out, and verdicts stay as they are, until somebody has decided
    trusts_sightings : whether a new sighting that fits is believed; else it waits until it is compared with all else
    edits : by hand, in order
    bounded : what has been condensed
    """

    def __init__(
        self,
        path: KeyframeList,
        config: RobustConfig,
        settings: Settings,
        start: "MapSnapshot",
        counters: Counters,
        executor: Executor = run_when_asked,
    ) -> None:
        self.path, self._config, self._counters = path, config, counters
        self.graph = start.graph
        self.noise = NoiseScales(self.graph, start.noise_factors)
        self.solver = Solver(self.graph, settings)
        self.decisions = OutlierGate(config, self.graph, self.solver, start.ledger)
        self.handed_over, self.held = (0, 0), (0, 0)
        self.frozen, self.frozen_edges = start.frozen, start.ledger.final
        self.edits, self.bounded = list(start.edits), start.bounded or BoundedState()
        self._background = Background[Outcome | None](SECOND_LOOK, executor, config.apply_after_keyframes, counters)
        self._out = 0  # edges that were out at the last search
        self._rivals: tuple[Alternative, ...] = ()
        self.holds_back = False
        self.trusts_sightings = True
        self._reviewed = 0  # the keyframe of the last review
        self._pending: list[int] = []  # edges that have come and do not fit by themselves

    @property
    def keyframe(self) -> int:
        """The number of the newest keyframe, which decisions are noted with."""
        return len(self.path.keyframes) - 1

    @property
    def ledger(self) -> Ledger:
        """The ledger of decisions on all edges."""
        return self.decisions.ledger

    @property
    def rivals(self) -> tuple[Alternative, ...]:
        """Other explanations of the same measurements that the last second look could not rule out."""
        return tuple(one for one in self._rivals if one.stands(self.ledger))

    def restore(self, vertices: Sequence[int], values: Array, held: tuple[int, int] = (0, 0)) -> Report:
        """Solve all accepted edges of a loaded graph: some of its vertices, from given values.

        Parameters
        ----------
        held : vertices and edges below these ids are held, besides those of a frozen map
        """
        self.solver.add(vertices, self.graph.edge_ids.since())
        self.solver.start_at(values)
        for vertex in vertices:
            if vertex < self.frozen:
                self.solver.hold(vertex)
        if held[0]:
            self._hold(*held)
        if self._config.noise_scale != "estimated":
            self.use_noise({})
        self.handed_over = self.graph.vertex_ids.next, self.graph.edge_ids.next
        report = self.solver.optimize(self.solver.settings.until_still())  # what is believed was decided before
        self.decisions.recalibrate()
        self.cancel_search()
        return report

    def hold_map(self) -> None:
        """Fix all present vertices, and the verdicts on all present edges."""
        self.hand_over()
        self.cancel_search()
        self._hold(self.graph.vertex_ids.next, self.ledger.ids.next)

    def _hold(self, vertices: int, edges: int) -> None:
        self.held = vertices, edges
        inside = self.solver.vertices
        for vertex in inside[inside < vertices].tolist():
            self.solver.hold(vertex)
        self.ledger.finish(edges)

    def release_map(self) -> None:
        """Undo ``hold_map``. A frozen map stays fixed."""
        held, self.held = self.solver.held, (0, 0)
        self.solver.release(held[held >= self.frozen])
        self.ledger.finish(self.frozen_edges)
        self.cancel_search()

    def hand_over(self) -> None:
        """Pass new vertices and edges to the solver."""
        (vertices, edges), end = self.handed_over, (self.graph.vertex_ids.next, self.graph.edge_ids.next)
        if (vertices, edges) != end:
            self.solver.add(self.graph.vertex_ids.since(vertices), self.graph.edge_ids.since(edges))
            self.handed_over = end

    def gate_new(self) -> None:
        """Judge new edges by their own noise. Those that do not fit are held back for a comparison with all others."""
        self.hand_over()
        new = self.decisions.gate_new(self.handed_over[1], self.keyframe, trusts_sightings=self.trusts_sightings)
        self._pending = [*self._pending, *new][-_MAX_PENDING:]

    def update(self) -> None:
        """Solve with the new accepted edges, then judge the held-back ones."""
        self.gate_new()
        if self.holds_back:
            self.solver.update()
            return
        is_due = self._config.decide and self.keyframe - self._reviewed >= _REVIEW_EVERY
        if is_due:
            self._reviewed = self.keyframe
            self.decisions.review(self.keyframe)
        found = self._background.due(self.keyframe)
        if found is not None:
            self._use_found(found())
        self.solver.update()
        self._admit()
        if is_due and (group := self.decisions.readmit_likely_group(self.keyframe)):
            self.decisions.make_fit(group, self.keyframe)
        if self._is_search_due():
            self._out = self.ledger.outside_count
            self._background.begin(partial(self._search, self.solver.settings), self.keyframe)

    def optimize(self, settings: Settings) -> Report:
        """Solve everything, and search for a better explanation."""
        self.gate_new()
        report = self.solver.optimize(settings)
        if not self._config.decide or self.holds_back:
            return report
        self._admit()
        outcome = guarded(self._counters, SECOND_LOOK, lambda: self._search(settings)(CancelToken()))
        applied = self._use_found(outcome, settings)
        self.cancel_search()
        return (applied and applied.report) or report

    def scale_noise(self, everything: Settings | None) -> Report | None:
        """Estimate the scale of the noise if that is due, and solve with it. Returns the last report of a solve.

        It is due at 50 keyframes, 100, 200 and so on, at the solve after each of these, and when everything is solved.
        A map that was edited by hand keeps its noise until a keyframe is added: residuals that an edit makes are not
        the noise of a sensor.
        """
        is_driven = not self.edits or self.keyframe > self.edits[-1].keyframe
        is_due = is_driven if everything is not None else self.noise.is_due(self.keyframe + 1)
        if self._config.noise_scale != "estimated" or not is_due:
            return None
        applied = None
        for _ in range(_NOISE_ROUNDS if everything else 1):
            changed = self.apply(
                NOISE, lambda: Revision(noise=factors_of(self.noise_scale()), solves="all", settings=everything)
            )
            if changed is None:
                break
            applied = changed
        if applied is not None:
            self.decisions.recalibrate()
        return applied.report if applied and everything else None

    # -- changes of what was solved ----------------------------------------------------------------------------------

    def apply(self, what: str, propose: Callable[[], Revision]) -> Applied | None:
        """Change what was solved as a policy proposes; None if nothing changes, or it fails: then all is as before.

        What is held is not touched: a revision that replaces an edge of it fails, and verdicts on it stay. A failure,
        of the proposal, too, is counted under ``what``.
        """
        return self.all_or_nothing(what, lambda: self._applied(propose()))

    def _applied(self, r: Revision) -> Applied | None:
        solver, decisions, keyframe, report = self.solver, self.decisions, self.keyframe, None
        named = [*(one.edge for one in r.replaced), *(edge for edge, _ in r.restored), *r.withdrawn]
        first = self.first_free_edge
        if named and min(named) < first:
            raise GraphSlamError(f"edge {min(named)} is of a map that is held")
        accepted, rejected = ([edge for edge in edges if edge >= first] for edges in (r.accepted, r.rejected))
        if r.noise is not None and not self.noise.change(r.noise, first):
            return None
        for one in r.remeasured:
            one.table.measured.values[one.rows] = one.measured
            one.table.sqrt_information.values[one.rows] = one.sqrt_information
        if r.noise is not None or r.remeasured:
            solver.rebuild()
        self.withdraw(r.withdrawn, r.reason, vertex=r.vertex)
        replaced = self._replace(r)
        for edge, in_its_place in r.restored:
            self._restore(edge, in_its_place, r.evidence)
        if r.verdicts is not None and not decisions.adopt_verdicts(r.verdicts, keyframe) and r.settings is None:
            return None
        if r.values is not None:
            solver.start_at(r.values)
        if r.is_judged_anew:
            decisions.reclassify(keyframe)
        decisions.exchange(accepted, rejected, keyframe)
        if r.noise is not None or r.remeasured or r.replaced or r.restored:
            self.cancel_search()
        if r.accepted:
            self.holds_back = False
            decisions.make_fit(accepted, keyframe)
        elif r.solves == "all":
            report = solver.optimize(r.settings)
            if r.remeasured and decisions.reclassify(keyframe):
                report = solver.optimize(r.settings)
        elif r.solves == "new":
            self._pending = [*self._pending, *r.compared][-_MAX_PENDING:]
            solver.update()
            if r.compared:  # all others wait while an alarm is not decided
                self._admit()
        return Applied((*replaced, *((edge, -1) for edge in r.withdrawn)), report)

    def _replace(self, r: Revision) -> tuple[tuple[int, int], ...]:
        """Put edges in place of edges of odometry; returns both. The ledger has both."""
        if not r.replaced:
            return ()
        graph, out = self.graph, list[tuple[int, int]]()
        for one in r.replaced:
            old = graph.edge(one.edge)
            out.append((one.edge, graph.add_edge(old.type, old.vertices, one.motion, one.noise, old.label, old.source)))
        self.gate_new()
        for edge, _ in out:
            self.decisions.decide(edge, self.keyframe, Verdict.REJECTED, r.reason, r.evidence, r.threshold)
            if r.threshold is not None:
                self.ledger.threshold.values[self.ledger.ids.row(edge)] = r.threshold
        return tuple(out)

    def _restore(self, edge: int, in_its_place: int, evidence: float) -> None:
        """Undo ``_replace`` and ``withdraw``. A candidate is accepted, and judged as others are."""
        ends = np.setdiff1d(self.graph.edge(edge).vertices, self.solver.vertices)
        self.solver.add(ends.tolist(), [])
        is_candidate = self.graph.label_of(edge) in CANDIDATES
        if in_its_place >= 0:
            threshold, row = self.ledger.threshold.values, self.ledger.ids.row
            self.decisions.withdraw([in_its_place], self.keyframe, Reason.REVOKED)
            threshold[row(edge)] = threshold[row(in_its_place)]
        verdict = Verdict.ACCEPTED if is_candidate else Verdict.NOT_EVALUATED
        self.decisions.decide(edge, self.keyframe, verdict, Reason.NONE, evidence)

    def all_or_nothing(self, what: str, change: Callable[[], Result | None]) -> Result | None:
        """Change what was solved. After an exception, which is counted, all is as it was, and the result is None."""
        before, handed_over = self._frozen_graph(self.solver.settings), self.handed_over
        factors, count, pending = dict(self.noise.factors), len(self.ledger.history), list(self._pending)
        try:
            return change()
        except Exception as error:
            self._counters.count_failure(what, error)
        vars(self.graph).update(vars(before.graph))
        going_on = {"history": self.ledger.history[:count], "changes": self.ledger.changes + 1}
        vars(self.ledger).update(vars(before.ledger) | going_on)
        self.noise.factors, self._pending = factors, pending
        fresh = Solver(self.graph, self.solver.settings)
        fresh.start_at(before.values)
        fresh.add(before.vertices, self.graph.edge_ids.since(0, handed_over[1]))
        for vertex in before.held.tolist():
            fresh.hold(vertex)
        with suppress(Exception):
            fresh.update()
        vars(self.solver).update(vars(fresh))
        self.handed_over = handed_over
        return None

    def withdraw(self, edges: Sequence[int], reason: Reason = Reason.WITHDRAWN, *, vertex: int | None = None) -> None:
        """Remove edges permanently, and with all of its edges a vertex."""
        self.decisions.withdraw(edges, self.keyframe, reason)
        self._pending = [edge for edge in self._pending if edge not in edges]
        if vertex is not None:
            self.solver.remove(vertex)

    def move(self, T_new_old: Numbers) -> None:
        """Move everything rigidly. A running search is cancelled."""
        self.solver.start_at(moved_rigidly(self.graph, self.solver.values, T_new_old))
        self.cancel_search()

    # -- noise -------------------------------------------------------------------------------------------------------

    def noise_scale(self, labels: Container[str] = CLASSES) -> list[NoiseScale]:
        """Estimate the scale of the noise of some classes without changing anything."""
        stamps = np.zeros(self.graph.vertex_ids.next, dtype=np.int64)
        stamps[self.path.keyframes.ids] = self.path.keyframes.stamps_ns
        edges = range(self.first_free_edge, self.handed_over[1])
        return estimate_noise(self.graph, self.solver, self.noise.factors, stamps, edges, labels)

    def use_noise(self, factors: Mapping[Key, float]) -> None:
        """Scale the configured noise of edges by other factors than now; groups without one have none."""
        if self.noise.change(self.noise.neutral() | dict(factors), self.first_free_edge):
            self.solver.rebuild()

    @property
    def first_free_edge(self) -> int:
        """The first edge that is not of a frozen or held map."""
        return max(self.frozen_edges, self.held[1])

    @property
    def is_quiet(self) -> bool:
        """Return whether every edge was judged and solved, and nothing that could change a verdict goes on."""
        is_handed_over = self.handed_over == (self.graph.vertex_ids.next, self.graph.edge_ids.next)
        is_judged = is_handed_over and len(self.ledger) == self.graph.edge_count and not self._pending
        return is_judged and not (self.holds_back or self._background.is_busy)

    def note_condensed(self) -> None:
        """Note edges that the solver has already: nobody doubts them."""
        self.handed_over = self.graph.vertex_ids.next, self.graph.edge_ids.next
        self.decisions.gate_new(self.handed_over[1], self.keyframe)

    def keep(self, vertices: Index, edges: Index) -> None:
        """Remove all other vertices and edges from the graph."""
        self.solver.keep(vertices, edges)
        self.ledger.keep(edges)
        self._rivals = ()
        self.cancel_search()

    def cancel_search(self) -> None:
        """Cancel a running search: the problem that it began with has changed."""
        self._background.cancel()
        self._out = self.ledger.outside_count

    def _is_search_due(self) -> bool:
        """Return whether enough edges have come out since the last search: it gets rarer as its cost grows."""
        after, out = self._config.second_look_after, self.ledger.outside_count
        self._out = min(self._out, out)
        is_on = self._config.decide and after > 0 and not self._background.is_busy
        return is_on and out >= max(self._out + after, GROWN * self._out)

    def _search(self, settings: Settings) -> Work[Outcome | None]:
        frozen = self._frozen_graph(settings)
        return lambda token: search_alternatives(self._config, frozen, token)

    def _use_found(self, outcome: Outcome | None, settings: Settings | None = None) -> Applied | None:
        """Solve with what a search has found; without settings only if that is another explanation."""
        if outcome is None:
            return None
        self._rivals = outcome.rivals

        def proposed() -> Revision:
            values = outcome.carried_to(self.graph, self.solver.values)
            return Revision(verdicts=outcome.ledger, values=values, solves="all", settings=settings)

        return self.apply(SECOND_LOOK, proposed)

    def _admit(self) -> None:
        """Judge held-back edges by the joint covariance of the estimate."""
        pending = [edge for edge in self._pending if not self.ledger.is_inside(edge)]
        admitted = self.decisions.admit_compatible(pending, self.keyframe)
        self._pending = []
        if admitted:
            self.decisions.make_fit(admitted, self.keyframe, by_innovation=True)

    def _frozen_graph(self, settings: Settings) -> FrozenGraph:
        problem = self.graph.copy(), self.solver.vertices, self.solver.held, self.solver.values
        return FrozenGraph(self.keyframe, *problem, settings, self.ledger.copy())
