"""Search for the best explanation: solve, judge, solve again, from several starts; the lowest cost wins.

The first verdicts of an online run may rest on a false closure that came before the true ones. So there are several
starts: the online estimate with its verdicts; the candidates that agree with a neighbour, at the online estimate and at
odometry alone; and the largest group of rejected candidates. From each start, everything is solved and every candidate
is judged by its residual, until no verdict changes. A rejected candidate costs the limit of its gate (truncated least
squares).
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.config.pipeline import RobustConfig
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import GROUPS, Graph, Loss
from graph_slam_ros.slam.background import CancelToken
from graph_slam_ros.slam.robust.gating import OutlierGate
from graph_slam_ros.slam.robust.ledger import FINAL, Ledger
from graph_slam_ros.slam.robust.pairwise_consistency import (
    consistent_groups,
    contradicting_sightings,
    jumps_and_back,
    odometry_in_use,
    space_of,
)
from graph_slam_ros.solver import Settings, Solver
from graph_slam_ros.typing import Array, Index, Numbers

_ITERATIONS = 20  # of each stage of the losses, from another start
_ROUNDS = 10  # of a search at most: solve everything, then review all verdicts
_HOPELESS = 2.0  # times the least cost that was found: another explanation is none
_SAME = 1e-4  # of a cost, that one explanation may differ by from itself: solves end a little off the optimum
_NEAR = 1e-3  # m or rad: what two solves of one optimum differ by at most
_STORY = 5  # closures that agree with one another and not with the map


@dataclass(frozen=True, slots=True)
class FrozenGraph:
    """The input of a search: copies that nothing else changes.

    Attributes
    ----------
    vertices : of the graph, that are part of the problem
    held : those of them that stay where they are
    values : the online estimate, the stored numbers of all vertices
    ledger : what is believed online
    """

    keyframe: int
    graph: Graph
    vertices: Index
    held: Index
    values: Array
    settings: Settings
    ledger: Ledger


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another consistent explanation at a similar cost: this graph cannot decide between the two.

    Attributes
    ----------
    cost, best_cost : truncated cost of this one, and of the one that is believed
    only_here, only_there : closures that this one believes and the other does not, and the other way round
    """

    cost: float
    best_cost: float
    only_here: tuple[int, ...] = ()
    only_there: tuple[int, ...] = ()

    def stands(self, ledger: Ledger) -> bool:
        """Return whether it is still possible: none of its edges was withdrawn."""
        return not np.isin(ledger.reason.values[ledger.ids.existing(self.only_here)], FINAL).any()


@dataclass(frozen=True, slots=True)
class Outcome:
    """An explanation: its start, its verdicts, the stored numbers of all vertices, its truncated cost."""

    start: str
    ledger: Ledger
    values: Array
    cost: float
    frozen: FrozenGraph
    rivals: tuple[Alternative, ...] = ()

    def carried_to(self, graph: Graph, values: Array) -> Array:
        """Stored numbers of the grown graph. Newer vertices move with the newest pose of the search."""
        known, old, out = len(self.values), self.frozen.graph, values.copy()
        odometry = old.edges_of("odometry")
        if known < len(values) and len(odometry):
            here = graph.vertex(old.edge(int(odometry[-1])).vertices[1]).stored
            group = space_of(graph).group
            moved = group.compose(tuple(self.values[here]), group.inverse(tuple(values[here])))
            out = moved_rigidly(graph, values, moved)
        out[:known] = self.values
        return out


def moved_rigidly(graph: Graph, values: Array, T_new_old: Numbers) -> Array:
    """Stored numbers of all vertices of a map that is moved rigidly."""
    out, space, vertices = values.copy(), space_of(graph), graph.vertex_ids.since()
    for kind in (space.pose, space.point):
        if kind in graph.kinds:
            of_kind = vertices[graph.kind_codes(vertices) == graph.kinds.index(kind)]
            at = graph.begins(of_kind)[:, None] + np.arange(kind.size)
            move = space.group.compose if kind is space.pose else space.group.act
            out[at] = np.stack(move(T_new_old, tuple(values[at].T)), axis=-1)
    return out


@dataclass(frozen=True, slots=True)
class _Way:
    """The result of the first solve of a start: accepted edges, stored numbers of all vertices, truncated cost."""

    inside: Index
    values: Array
    cost: float

    def joins(self, other: "_Way") -> bool:
        """Return whether another start has come to the same place, up to what solves end off the optimum."""
        if not (np.array_equal(self.inside, other.inside) and abs(self.cost - other.cost) <= _SAME * other.cost):
            return False
        return bool(np.abs(self.values - other.values).max() <= _NEAR)


def search_alternatives(config: RobustConfig, frozen: FrozenGraph, wanted: CancelToken | None = None) -> Outcome | None:
    """Explain a graph anew from each start; the lowest cost wins. None if nothing can be solved, or if cancelled."""
    search = _Search(config, frozen)
    for name, start, inliers in search.starts():
        if wanted is not None and not wanted.still:
            return None
        if inliers is not None and search.explains_everything:
            break
        with suppress(GraphSlamError, np.linalg.LinAlgError):  # what is believed there does not hold together
            search.explain_from(name, start, inliers)
    found = search.found
    if not found:
        return None
    best = min(found, key=lambda outcome: outcome.cost)
    rivals = {rival.only_here: rival for rival in (_rival(one, best) for one in found) if rival is not None}
    return replace(best, rivals=tuple(rivals.values()))


def _rival(one: Outcome, best: Outcome) -> Alternative | None:
    """Another explanation as an alternative to the best, if a whole group of closures differs."""
    graph = best.frozen.graph
    here, there = (outcome.ledger.inside for outcome in (one, best))
    only_here, only_there = np.setdiff1d(here, there), np.setdiff1d(there, here)
    is_story = np.count_nonzero(graph.has_label(only_here, ("closures",))) >= _STORY
    if not is_story or one.cost > _HOPELESS * best.cost:
        return None
    return Alternative(one.cost, best.cost, tuple(only_here.tolist()), tuple(only_there.tolist()))


class _Search:
    """The starts of one search. They share one solver: from one to the next, what differs is ordered and grouped anew.

    Attributes
    ----------
    found : the explanations so far
    """

    def __init__(self, config: RobustConfig, frozen: FrozenGraph) -> None:
        self._config, self._frozen, self._graph = config, frozen, frozen.graph.copy()
        self._candidates = frozen.ledger.candidates
        self._weights = self._graph.weights(self._candidates)
        self._solver = Solver(self._graph, frozen.settings)
        self._solver.add(frozen.vertices, frozen.ledger.ids.since())
        for vertex in (held := frozen.held.tolist()):
            self._solver.hold(vertex)
        self._odometry = _along_odometry(self._graph, frozen.values, set(held))
        limits = frozen.ledger.threshold.values[frozen.ledger.ids.rows(self._candidates)]
        self._jumps = jumps_and_back(self._graph, self._odometry, self._candidates, limits)
        self.found = list[Outcome]()
        self._ways = list[_Way]()

    @property
    def explains_everything(self) -> bool:
        """Return whether the online verdicts reject nothing."""
        return any(one.start == "online" and not len(one.ledger.outside) for one in self.found)

    def starts(self) -> Iterator[tuple[str, Array, Index | None]]:
        """The online verdicts; candidates that agree with a neighbour, at the online estimate and along odometry alone.

        Between them all but fixes that have jumped and come back. The last accepts the largest rejected group alone.
        """
        frozen, candidates, odometry = self._frozen, self._candidates, self._odometry
        ledger, graph = frozen.ledger, frozen.graph
        yield "online", frozen.values, None
        is_closure = graph.has_label(candidates, ("closures",))
        closures, others = candidates[is_closure], candidates[~is_closure]
        limits = self._config.noise_factor**2 * ledger.threshold.values[ledger.ids.rows(others)]
        others = np.setdiff1d(others, contradicting_sightings(graph, odometry, others, limits))
        if self._jumps:
            yield "fixes", frozen.values, np.setdiff1d(candidates, np.concatenate(self._jumps))
        if not len(closures):
            yield "neighbours", frozen.values, others
            return
        limits = ledger.threshold.values[ledger.ids.rows(closures)]
        groups = consistent_groups(graph, odometry, closures, limits)
        inliers = np.concatenate((others, *groups))
        yield "neighbours", frozen.values, inliers
        yield "odometry", odometry, inliers
        out = [group[~np.isin(group, ledger.inside)] for group in groups]
        largest = max(out, key=len, default=closures[:0])
        if len(largest) >= _STORY:
            yield "rejected", odometry, np.concatenate((others, largest))

    def explain_from(self, name: str, start: Array, inliers: Index | None) -> None:
        """Solve and judge in turn, starting with the verdicts of the ledger, or with these candidates.

        Nothing is found if it comes to where another start has come: what follows is the same.
        """
        frozen, mine = self._frozen, self._frozen.ledger.copy()
        decisions = self._gate(start, mine)
        hopeless = _HOPELESS * min((one.cost for one in self.found), default=np.inf)
        solver = self._solver
        if inliers is not None:
            decisions.force_inliers(inliers, frozen.keyframe)
            solver.optimize(replace(frozen.settings, losses=decisions.cautious_losses(), max_iterations=_ITERATIONS))
            decisions.reclassify(frozen.keyframe)
            here = _Way(mine.inside, solver.values, self._cost(mine))
            if any(here.joins(one) for one in self._ways):
                return
            self._ways.append(here)
        if inliers is None or self._cost(mine) <= 2.0 * hopeless:
            self._alternate(decisions, hopeless)
        judged = mine.candidates
        mine.statistic.values[mine.ids.rows(judged)], _ = solver.chi2_of(judged)
        cost = self._cost(mine)
        if np.isfinite(cost):
            self.found.append(Outcome(name, mine, solver.values, cost, frozen))

    def _gate(self, start: Array, ledger: Ledger) -> OutlierGate:
        """Return the gate of a start, at whose values the weights of the frozen graph hold again."""
        now = self._graph.weights(self._candidates)
        for k in np.flatnonzero(now != self._weights).tolist():
            self._solver.set_weight(int(self._candidates[k]), float(self._weights[k]))
        self._solver.start_at(start)
        return OutlierGate(self._config, self._graph, self._solver, ledger)

    def _alternate(self, decisions: OutlierGate, hopeless: float) -> None:
        """Solve and judge until no verdict changes.

        It ends, too, when the verdicts are again those of an earlier round (a candidate that was accepted on trial does
        not fit after all), when the cost is too high, or where another start has ended.
        """
        solver, mine, keyframe = self._solver, decisions.ledger, self._frozen.keyframe
        solved = dict[bytes, Array]()  # values by verdicts
        for k in range(_ROUNDS):
            solver.optimize()
            if k + 1 == _ROUNDS or self._cost(mine) > hopeless:
                return
            solved[mine.inside.tobytes()] = solver.values
            if decisions.reclassify(keyframe):
                if (values := solved.get(mine.inside.tobytes())) is None:
                    continue
                solver.start_at(values)
                return
            if _is_known(self._cost(mine), mine, self.found):
                return
            costs = dict[int, float]()
            if not (decisions.readmit_next(keyframe, costs) or _together(decisions, solver, self._frozen, costs)):
                return

    def _cost(self, ledger: Ledger) -> float:
        """Chi2 of all accepted edges; a candidate costs at most its threshold, and those of one jump that once."""
        inside, outside, limits = ledger.inside, ledger.outside, ledger.threshold.values
        rows, rows_out = ledger.ids.rows(inside), ledger.ids.rows(outside)
        chi2, _ = self._solver.chi2_of(inside)
        jumped = np.concatenate([outside[:0], *(jump[1:] for jump in self._jumps)])
        out = np.where(np.isin(outside, jumped), ledger.numbers.values[rows_out], limits[rows_out])
        doubted = float(np.minimum(chi2, limits[rows]).sum() + out.sum())
        return self._solver.evaluate().chi2_final - float(chi2.sum()) + doubted


def _together(decisions: OutlierGate, solver: Solver, frozen: FrozenGraph, costs: Mapping[int, float]) -> bool:
    """Accept rejected edges that support one another: they fit, and cost together no more than a gate for each.

    Alone each of them may be too unlikely, because the map was solved without the others.

    Parameters
    ----------
    costs : innovations of the edges that fit best
    """
    before, chi2 = solver.values, solver.evaluate().chi2_final
    group = decisions.readmit_group(frozen.keyframe, costs)
    if not group:
        return False
    full = {key: [Loss(), stages[-1]] for key, stages in frozen.settings.losses.items()}
    solver.optimize(replace(frozen.settings, losses=full, max_iterations=_ITERATIONS))
    rise = solver.evaluate().chi2_final - chi2
    if not decisions.unfit(group) and rise <= decisions.most_cost(group):
        return True
    decisions.exchange((), group, frozen.keyframe)
    solver.start_at(before)
    return False


def _is_known(cost: float, ledger: Ledger, found: Sequence[Outcome]) -> bool:
    """Return whether another start ended with the same verdicts at the same cost: the same optimum."""
    return any(
        abs(cost - one.cost) <= _SAME * one.cost and np.array_equal(ledger.inside, one.ledger.inside) for one in found
    )


def _along_odometry(graph: Graph, values: Array, held: set[int]) -> Array:
    """Return the path by odometry alone. Landmarks and fixed vertices stay where they are."""
    out = values.copy()
    for edge in odometry_in_use(graph).tolist():
        one = graph.edge(edge)
        last, new = (graph.vertex(v) for v in one.vertices)
        if new.id not in held:
            out[new.stored] = GROUPS[new.kind].compose(tuple(out[last.stored]), tuple(one.measured))
    return out
