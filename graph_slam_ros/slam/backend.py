"""The back-end: the graph, its solver, and what is believed of its edges, in step with one another."""

from collections.abc import Callable, Container, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy

import numpy as np

from graph_slam_ros.config.pipeline import RobustConfig
from graph_slam_ros.graph import Gaussian, Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.calibration.rows import TrialProblem
from graph_slam_ros.slam.doubt.record import DisplacementHypothesis
from graph_slam_ros.slam.frontend.keyframes import Keyframe, KeyframeList
from graph_slam_ros.slam.frontend.noise_factors import CLASSES, Key, NoiseScales
from graph_slam_ros.slam.frontend.sighting_edges import SightingEdges
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.noise_scale import NoiseScale, estimate_noise, factors_of
from graph_slam_ros.slam.robust.gating import OutlierGate
from graph_slam_ros.slam.robust.hypotheses import (
    Alternative,
    Background,
    FrozenGraph,
    Outcome,
    run_when_asked,
    search_alternatives,
)
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver import Report, Settings, Solver
from graph_slam_ros.typing import Array, Executor, Index, Numbers, Result

_MAX_PENDING = 200  # edges that are compared with all that is known at once, at most; reviews look at the others
_NOISE_ROUNDS = 8  # at most, of estimating the scale of the noise and solving with it
_REVIEW_EVERY = 20  # keyframes: the newest verdicts are reviewed, and some of the others in turn


class Backend:
    """Solves the additions to ``graph`` keyframe by keyframe, and owns the verdicts on its edges.

    Parameters
    ----------
    executor : begins the work of a second look; the function that it returns waits for the result
    start : whose graph and ledger to go on with

    Attributes
    ----------
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
        config: RobustConfig,
        settings: Settings,
        executor: Executor = run_when_asked,
        start: MapSnapshot | None = None,
        counters: Counters | None = None,
    ) -> None:
        self._config, self._counters = config, counters or Counters()
        start = start or MapSnapshot()
        self.graph = start.graph
        self.noise = NoiseScales(self.graph, start.noise_factors)
        self.solver = Solver(self.graph, settings)
        self.decisions = OutlierGate(config, self.graph, self.solver, start.ledger)
        self.handed_over, self.held = (0, 0), (0, 0)
        self.frozen, self.frozen_edges = start.frozen, start.ledger.final
        self.edits, self.bounded = list(start.edits), start.bounded or BoundedState()
        self._background = Background(config, executor)
        self._rivals: tuple[Alternative, ...] = ()
        self.holds_back = False
        self.trusts_sightings = True
        self._reviewed = 0  # the keyframe of the last review
        self._pending: list[int] = []  # edges that have come and do not fit by themselves

    @property
    def decides(self) -> bool:
        """Return whether outlier rejection is on."""
        return self._config.decide

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
        if self.is_handed_over:
            return
        vertices, edges = self.handed_over
        self.solver.add(self.graph.vertex_ids.since(vertices), self.graph.edge_ids.since(edges))
        self.handed_over = self.graph.vertex_ids.next, self.graph.edge_ids.next

    def gate_new(self, keyframe: int) -> None:
        """Judge new edges by their own noise. Those that do not fit are held back for a comparison with all others."""
        self.hand_over()
        new = self.decisions.gate_new(self.handed_over[1], keyframe, trusts_sightings=self.trusts_sightings)
        self._pending = [*self._pending, *new][-_MAX_PENDING:]

    def update(self, keyframe: int) -> None:
        """Solve with the new accepted edges, then judge the held-back ones."""
        self.gate_new(keyframe)
        if self.holds_back:
            self.solver.update()
            return
        is_due = self._config.decide and keyframe - self._reviewed >= _REVIEW_EVERY
        if is_due:
            self._reviewed = keyframe
            self.decisions.review(keyframe)
        found = self._background.found(keyframe)
        if found is not None:
            self.revise("second_look", lambda: self._use_found(found(), keyframe))
        self.solver.update()
        self._admit(keyframe)
        if is_due and (group := self.decisions.readmit_likely_group(keyframe)):
            self.decisions.make_fit(group, keyframe)
        out = self.ledger.outside_count
        if self._config.decide and self._background.is_due(out):
            self._background.start(self._frozen_graph(keyframe, self.solver.settings), out)

    def optimize(self, keyframe: int, settings: Settings) -> Report:
        """Solve everything, and search for a better explanation."""
        self.gate_new(keyframe)
        report = self.solver.optimize(settings)
        if not self._config.decide or self.holds_back:
            return report
        self._admit(keyframe)
        report = self.revise("second_look", lambda: self._explained(keyframe, settings)) or report
        self.cancel_search()
        return report

    def scale_noise(self, keyframes: StampedPoses[Keyframe], everything: Settings | None) -> Report | None:
        """Estimate the scale of the noise if that is due, and solve with it. Returns the last report of a solve.

        It is due at 50 keyframes, 100, 200 and so on, at the solve after each of these, and when everything is solved.
        A map that was edited by hand keeps its noise until a keyframe is added: residuals that an edit makes are not
        the noise of a sensor.
        """
        is_driven = not self.edits or len(keyframes) > self.edits[-1].keyframe + 1
        is_due = is_driven if everything is not None else self.noise.is_due(len(keyframes))
        if self._config.noise_scale != "estimated" or self.holds_back or not is_due:
            return None
        report = None
        for _ in range(_NOISE_ROUNDS if everything else 1):
            changed = self.revise("noise_scale", lambda: self._rescaled(keyframes, everything))
            if changed is None:
                break
            report = changed
        if report is not None:
            self.decisions.recalibrate()
            self.cancel_search()
        return report if everything else None

    def _rescaled(self, keyframes: StampedPoses[Keyframe], everything: Settings | None) -> Report | None:
        """Solve with the noise that residuals show; None where that is the present one."""
        if not self.noise.change(factors_of(self.noise_scale(keyframes)), self.first_free_edge):
            return None
        self.solver.rebuild()
        return self.solver.optimize(everything)

    def revise(self, what: str, change: Callable[[], Result | None]) -> Result | None:
        """Change what was solved. After an exception, which is counted, all is as it was, and the result is None."""
        before, handed_over = self._frozen_graph(0, self.solver.settings), self.handed_over
        factors, count = dict(self.noise.factors), len(self.ledger.history)
        try:
            return change()
        except Exception as error:
            self._counters.count_failure(what, error)
        vars(self.graph).update(vars(before.graph))
        going_on = {"history": self.ledger.history[:count], "changes": self.ledger.changes + 1}
        vars(self.ledger).update(vars(before.ledger) | going_on)
        self.noise.factors = factors
        fresh = Solver(self.graph, self.solver.settings)
        fresh.start_at(before.values)
        fresh.add(before.vertices, self.graph.edge_ids.since(0, handed_over[1]))
        for vertex in before.held.tolist():
            fresh.hold(vertex)
        with suppress(Exception):
            fresh.update()
        vars(self.solver).update(vars(fresh))
        self.handed_over = handed_over
        self.decisions.recount()
        return None

    def noise_scale(self, keyframes: StampedPoses[Keyframe], labels: Container[str] = CLASSES) -> list[NoiseScale]:
        """Estimate the scale of the noise of some classes without changing anything."""
        stamps = np.zeros(self.graph.vertex_ids.next, dtype=np.int64)
        stamps[keyframes.ids] = keyframes.stamps_ns
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

    def trial_problem(
        self,
        space: Geometry,
        path: KeyframeList,
        origins: SightingEdges,
        factors: tuple[float, float] = (1.0, 1.0),
    ) -> TrialProblem:
        """A copy of the present problem for a trial fit. Rejected sightings are included, under their loss.

        Parameters
        ----------
        factors : of distance and turn, by which odometry is corrected
        """
        graph, solver, out = self.graph.copy(), self.solver, self.ledger.outside
        graph.set_weights(out[graph.has_label(out, ("landmarks",))], 1.0)
        rows, begins = path.keyframes, [max(k - path.keyframes.first, 0) for k in path.segments]
        keyframes = rows.ids.copy(), rows.stamps_ns.copy(), tuple(dict.fromkeys(begins))
        problem = solver.vertices, solver.held, solver.values, solver.settings
        track = path.samples.track(path.keyframes.poses, factors)
        return TrialProblem(
            space, graph, *problem, deepcopy(origins, {id(space): space}), *keyframes, track, self.first_free_edge
        )

    @property
    def is_handed_over(self) -> bool:
        """Return whether the solver has all of the graph."""
        return self.handed_over == (self.graph.vertex_ids.next, self.graph.edge_ids.next)

    @property
    def is_quiet(self) -> bool:
        """Return whether every edge was judged and solved, and nothing that could change a verdict goes on."""
        is_judged = self.is_handed_over and len(self.ledger) == self.graph.edge_count and not self._pending
        return is_judged and not (self.holds_back or self._background.is_busy)

    def note_condensed(self, keyframe: int) -> None:
        """Note edges that the solver has already: nobody doubts them."""
        self.handed_over = self.graph.vertex_ids.next, self.graph.edge_ids.next
        self.decisions.gate_new(self.handed_over[1], keyframe)

    def keep(self, vertices: Index, edges: Index) -> None:
        """Remove all other vertices and edges from the graph."""
        self.solver.keep(vertices, edges)
        self.ledger.keep(edges)
        self.decisions.recount()
        self._rivals = ()
        self.cancel_search()

    def cancel_search(self) -> None:
        """Cancel a running search: the problem that it began with has changed."""
        self._background.cancel(self.ledger.outside_count)

    def move(self, T_new_old: Numbers, space: Geometry) -> None:
        """Move everything rigidly. A running search is cancelled."""
        self.solver.start_at(moved_values(self.graph, self.solver.values, T_new_old, space))
        self.cancel_search()

    def withdraw(self, edges: Sequence[int], keyframe: int, reason: Reason = Reason.WITHDRAWN) -> None:
        """Remove edges permanently."""
        self.decisions.withdraw(edges, keyframe, reason)
        self._pending = [edge for edge in self._pending if edge not in edges]

    def split(
        self,
        replacement: tuple[int, Sequence[float], Gaussian],
        initial_poses: Sequence[int],
        values: Array,
        found: DisplacementHypothesis,
        keyframe: int,
    ) -> int:
        """Begin a segment in the past: odometry there gets next to no weight, and sightings are judged anew.

        Returns the edge that replaces odometry's.

        Parameters
        ----------
        replacement : the edge of odometry that leads there, and the motion and noise that it is to have instead
        initial_poses : edges that are out from now on, until they fit
        values : stored numbers of all vertices to go on from
        """
        link, motion, noise = replacement
        old = self.graph.edge(link)
        edge = self.graph.add_edge(old.type, old.vertices, motion, noise, "odometry", old.source)
        self.hand_over()
        self.decisions.gate_new(self.handed_over[1], keyframe)
        self.decisions.decide(link, keyframe, Verdict.REJECTED, Reason.DISPLACED, found.evidence)
        self.decisions.exchange(found.fitting, (*found.contradicting, *initial_poses), keyframe)
        self.solver.start_at(values)
        self._go_on(found, keyframe)
        return edge

    def rejoin(self, link: int, replacement: int, keyframe: int, evidence: float = 0.0) -> None:
        """Undo ``split``: odometry's edge is accepted again, and its replacement is rejected."""
        self.decisions.withdraw([replacement], keyframe, Reason.REVOKED)
        self.decisions.decide(link, keyframe, Verdict.NOT_EVALUATED, Reason.NONE, evidence)

    def judge_anew(self, values: Array, found: DisplacementHypothesis, keyframe: int) -> None:
        """Judge all edges from other stored numbers of all vertices, and accept what shows where the robot is."""
        self.solver.start_at(values)
        self.decisions.reclassify(keyframe)
        self.decisions.exchange(found.fitting, found.contradicting, keyframe)
        self._go_on(found, keyframe)

    def admit(self, edges: Sequence[int], keyframe: int) -> None:
        """Compare some edges that may be out with all that is known."""
        self._pending = [*self._pending, *edges][-_MAX_PENDING:]
        self.solver.update()
        self._admit(keyframe)

    def _go_on(self, found: DisplacementHypothesis, keyframe: int) -> None:
        self.cancel_search()
        self.holds_back = False
        self.decisions.make_fit(list(found.fitting), keyframe)

    def _admit(self, keyframe: int) -> None:
        """Judge held-back edges by the joint covariance of the estimate."""
        pending = [edge for edge in self._pending if not self.ledger.is_inside(edge)]
        admitted = self.decisions.admit_compatible(pending, keyframe)
        self._pending = []
        if admitted:
            self.decisions.make_fit(admitted, keyframe, by_innovation=True)

    def _use_found(self, outcome: Outcome | None, keyframe: int) -> None:
        """Solve with what a search in the background has found, if that is another explanation."""
        if outcome is not None and self._adopt(outcome, keyframe):
            self.solver.start_at(outcome.carried_to(self.graph, self.solver.values))
            self.solver.optimize()

    def _explained(self, keyframe: int, settings: Settings) -> Report | None:
        """Solve with the best explanation; None where a search finds none."""
        outcome = search_alternatives(self._config, self._frozen_graph(keyframe, settings))
        if outcome is None:
            return None
        self._adopt(outcome, keyframe)
        self.solver.start_at(outcome.values)
        return self.solver.optimize(settings)

    def _adopt(self, outcome: Outcome, keyframe: int) -> bool:
        """Use the verdicts of a search. Returns whether it explains the measurements in another way than now."""
        self._rivals = outcome.rivals
        return self.decisions.adopt_verdicts(outcome.ledger, keyframe)

    def _frozen_graph(self, keyframe: int, settings: Settings) -> FrozenGraph:
        problem = self.graph.copy(), self.solver.vertices, self.solver.held, self.solver.values
        return FrozenGraph(keyframe, *problem, settings, self.ledger.copy())


def moved_values(graph: Graph, values: Array, T_new_old: Numbers, space: Geometry) -> Array:
    """Stored numbers of all vertices of a map that is moved rigidly."""
    out = values.copy()
    vertices = graph.vertex_ids.since()
    for kind in (space.pose, space.point):
        if kind in graph.kinds:
            of_kind = vertices[graph.kind_codes(vertices) == graph.kinds.index(kind)]
            at = graph.begins(of_kind)[:, None] + np.arange(kind.size)
            move = space.group.compose if kind is space.pose else space.group.act
            out[at] = np.stack(move(T_new_old, tuple(values[at].T)), axis=-1)
    return out
