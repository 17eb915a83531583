"""Comparison of several odometries of the same motion: where they contradict each other, and which is wrong.

Two odometries are compared over the last 1, 2, 4, 8 and 16 motions, because small slips add up. If they contradict
each other, the odometry in use is believed at first, and the other is left out. Then both explanations are solved: with
the odometry in use alone, and with the others alone. Each odometry that is left out costs its gate. Observations that
were rejected since are in, with their loss. So the landmarks decide, or the majority of odometries. Without either,
the odometry in use stays until landmarks are seen again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.graph import GROUPS, Graph
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index

_LONGEST = 16  # motions that are compared at once
_GOES_ON, _GOES_ON_GATE = 8, 0.99  # a contradiction lasts while so many motions differ by more than this
_LAG = 20  # keyframes after its end in which it is decided
_EVERY, _MOST = 4, 10  # keyframes from one decision to the next, and contradictions that are decided anew
_LATER_EVERY, _LATER = 12, 1000  # the same after the lag, for as many keyframes while no landmark has decided it
_DECIDED = 10.0  # chi2 by which an explanation must be better
_UPDATES = 3
_LEAST_ALIKE, _ALIKE = 50, 0.05  # motions, and chi2 per degree of freedom: less is no chance
PARALLEL = "parallel"


@dataclass(slots=True)
class _Pair:
    """Two odometries of one motion: ids of their edges, the vertices, and chi2 of their difference."""

    used: int
    other: int
    vertices: tuple[int, ...]
    chi2: float = 0.0


@dataclass(slots=True)
class Contradiction:
    """A stretch over which odometries contradict each other.

    Attributes
    ----------
    pairs : motions of the odometry in use and of another
    sources : the others
    last : the newest keyframe of it
    is_open : whether it goes on
    trusts_used : which of the two explanations is believed
    evidence : chi2 by which the explanation that trusts the odometry in use is worse than the other
    """

    pairs: list[_Pair]
    sources: set[str]
    last: int
    is_open: bool = True
    trusts_used: bool = True
    evidence: float = 0.0


@dataclass(slots=True)
class _History:
    """The motions of one odometry beside the one in use."""

    pairs: list[_Pair] = field(default_factory=list)
    count: int = 0
    position: float = 0.0
    rotation: float = 0.0
    is_alike: bool = False


class OdometryJudge:
    """Judges the edges of several odometries between the same keyframes.

    Parameters
    ----------
    gate : probability of the chi2 distribution

    Attributes
    ----------
    contradictions : all of them, in order
    """

    def __init__(self, gate: float, graph: Graph, solver: Solver, ledger: Ledger, counters: Counters) -> None:
        self._gate, self._graph, self._solver, self._ledger = gate, graph, solver, ledger
        self._counters = counters
        self._next = graph.edge_count
        self._pairs: list[_Pair] = []
        self._used: dict[tuple[int, ...], int] = {}  # the edge of the odometry in use between two vertices
        self._histories: dict[str, _History] = {}
        self._displaced: dict[tuple[int, ...], list[_Pair]] = {}
        self.contradictions: list[Contradiction] = []

    @property
    def doubted(self) -> str:
        """The odometry that others contradict now, for a person; empty where none is."""
        now = self.contradictions[-1] if self.contradictions else None
        if now is None or not now.is_open:
            return ""
        wrong = now.sources if now.trusts_used else {self._graph.source_of(now.pairs[-1].used)}
        others = "another odometry" if now.trusts_used else " and ".join(sorted(now.sources))
        return f"{' and '.join(sorted(wrong))}: not used; contradicted by {others} (wheels that slip?)"

    def examine(self, count: int, keyframe: int) -> None:
        """Compare the odometries of motions that are new, up to a count of edges; the solver has these."""
        for edge in range(self._next, count):
            label = self._graph.label_of(edge)
            if label not in ("odometry", PARALLEL):
                continue
            vertices = self._graph.edge(edge).vertices
            if label == "odometry":
                self._used.setdefault(tuple(vertices), edge)
            elif (used := self._used.get(tuple(vertices))) is not None:
                self._compare(_Pair(used, edge, tuple(vertices)), self._graph.source_of(edge), keyframe)
        self._next = count

    def displace(self, vertices: Sequence[int], keyframe: int) -> None:
        """Leave all odometries out between two keyframes: the robot was carried there."""
        found = self._displaced[tuple(vertices)] = self._between(vertices)
        for one in self.contradictions:
            one.pairs = [pair for pair in one.pairs if pair not in found]
        for history in self._histories.values():
            history.pairs.clear()
        for pair in found:
            self._exclude(pair.other, keyframe, Reason.DISPLACED, 0.0)

    def return_to(self, vertices: Sequence[int], keyframe: int) -> None:
        """Undo ``displace``."""
        for pair in self._displaced.pop(tuple(vertices), []):
            self._include(pair.other, keyframe, pair.chi2, Reason.DISPLACED)

    def decide(self, keyframe: int, *, everything: bool = False) -> bool:
        """Solve both explanations of what is contradictory; returns whether another one is believed now."""
        changed = False
        for one in self.contradictions[-_MOST:]:
            if one.pairs and (everything or self._is_due(one, keyframe)):
                changed |= self._decide(one, keyframe)
        return changed

    def _is_due(self, one: Contradiction, keyframe: int) -> bool:
        if keyframe - one.last <= _LAG:
            return keyframe % _EVERY == 0
        is_open = abs(one.evidence) < _DECIDED and keyframe - one.last <= _LATER
        return is_open and keyframe % _LATER_EVERY == 0

    def finish(self) -> None:
        """Leave everything as it was decided: the map is held."""
        self.contradictions.clear()
        self._displaced.clear()

    def forget(self) -> None:
        """Forget all edges: they have other ids now. What is decided stays."""
        self.finish()
        self._pairs.clear()
        self._used.clear()
        for history in self._histories.values():
            history.pairs.clear()
        self._next = self._graph.edge_count

    # -- where they contradict each other ----------------------------------------------------------------------------

    def _compare(self, pair: _Pair, source: str, keyframe: int) -> None:
        history = self._histories.setdefault(source, _History())
        pairs = history.pairs
        if pairs and (pairs[-1].vertices[1] != pair.vertices[0] or self._source(pairs[-1]) != self._source(pair)):
            pairs.clear()  # a gap
        pairs.append(pair)
        self._pairs.append(pair)
        del pairs[:-_LONGEST]
        if self._is_alike(history, pair, source, keyframe):
            return
        differences = self._differences(pairs)
        dof = len(self._graph.edge(pair.used).sqrt_information)
        pair.chi2 = differences[0]
        now = next((one for one in reversed(self.contradictions) if one.is_open and source in one.sources), None)
        if now is not None and differences[min(_GOES_ON, len(differences)) - 1] > quantile(_GOES_ON_GATE, dof):
            self._extend(now, [pair], source, keyframe)
            return
        if now is not None:
            self._close(now, source, keyframe)
            pairs[:-1] = []  # what was contradictory has no part in what is compared next
            return
        limit = quantile(self._gate, dof)
        sizes = [size for size in (1, 2, 4, 8, 16) if size <= len(pairs)]
        worst = max(sizes, key=lambda size: differences[size - 1])
        if differences[worst - 1] > limit:
            open_one = next((one for one in reversed(self.contradictions) if one.is_open), None)
            if open_one is None:
                self.contradictions.append(open_one := Contradiction([], {source}, keyframe))
            open_one.sources.add(source)
            self._extend(open_one, pairs[-worst:], source, keyframe)

    def _source(self, pair: _Pair) -> str:
        return self._graph.source_of(pair.used)

    def _differences(self, pairs: Sequence[_Pair]) -> list[float]:
        """Chi2 of the difference of both odometries over the newest motion, the newest two, and so on."""
        out: list[float] = []
        sums: list[tuple[tuple[float, ...], Array]] = []
        for pair in reversed(pairs):
            steps = [self._graph.edge(pair.used), self._graph.edge(pair.other)]
            group = GROUPS[self._graph.vertex(pair.vertices[0]).kind]
            found = [(tuple(map(float, one.measured)), _covariance(one.sqrt_information)) for one in steps]
            if sums:
                found = [
                    (tuple(map(float, group.compose(T, after))), group.propagate(noise, after, of_after))
                    for (T, noise), (after, of_after) in zip(found, sums, strict=True)
                ]
            sums = found
            apart = np.array([float(x) for x in group.local(sums[1][0], sums[0][0])])
            out.append(float(apart @ np.linalg.solve(sums[0][1] + sums[1][1], apart)))
        return out

    def _extend(self, now: Contradiction, pairs: Sequence[_Pair], source: str, keyframe: int) -> None:
        known = {(pair.used, pair.other) for pair in now.pairs}
        now.pairs += [pair for pair in pairs if (pair.used, pair.other) not in known]
        now.last = keyframe
        self._apply(now, keyframe)

    def _close(self, now: Contradiction, source: str, keyframe: int) -> None:
        """The newest motions of an odometry agree again; the last of those before that did, too."""
        now.sources.discard(source)
        now.is_open = bool(now.sources)
        if not now.is_open:
            now.sources = {source}
        mine = [pair for pair in now.pairs if self._graph.source_of(pair.other) == source]
        again = mine[-_GOES_ON // 2 :]
        now.pairs = [pair for pair in now.pairs if pair not in again]
        for pair in again:
            self._include(pair.other, keyframe, pair.chi2)
            if not any(pair.used == other.used for other in now.pairs):
                self._include(pair.used, keyframe, pair.chi2)

    def _is_alike(self, history: _History, pair: _Pair, source: str, keyframe: int) -> bool:
        """Return whether an odometry has errors in common with that in use; then it is left out, motion by motion.

        Its difference is far below the noise of both, in position or in rotation.
        """
        if not history.is_alike:
            used, other = self._graph.edge(pair.used), self._graph.edge(pair.other)
            group = GROUPS[self._graph.vertex(pair.vertices[0]).kind]
            apart = np.array([float(x) for x in group.local(tuple(other.measured), tuple(used.measured))])
            noise = _covariance(used.sqrt_information) + _covariance(other.sqrt_information)
            n = 2 if len(apart) == 3 else 3
            history.count += 1
            for name, part in (("position", slice(0, n)), ("rotation", slice(n, None))):
                mean, e = getattr(history, name), apart[part]
                chi2_per_dof = float(e @ np.linalg.solve(noise[part, part], e)) / len(e)
                setattr(history, name, mean + (chi2_per_dof - mean) / history.count)
            history.is_alike = history.count >= _LEAST_ALIKE and min(history.position, history.rotation) < _ALIKE
            if not history.is_alike:
                return False
            for earlier in self._pairs:
                if self._graph.source_of(earlier.other) == source:
                    self._exclude(earlier.other, keyframe, Reason.WITHDRAWN, earlier.chi2)
        self._exclude(pair.other, keyframe, Reason.WITHDRAWN, 0.0)
        return True

    # -- which of them is wrong --------------------------------------------------------------------------------------

    def _decide(self, one: Contradiction, keyframe: int) -> bool:
        other, present = self._costs(one)
        one.evidence = (present - other) if one.trusts_used else (other - present)
        if present - other < _DECIDED:
            return False
        one.trusts_used = not one.trusts_used
        self._apply(one, keyframe)
        return True

    def _costs(self, one: Contradiction) -> list[float]:
        """The costs of the explanation that is not believed, and of the one that is. Its estimate stays.

        Observations since then that were rejected are in, because the wrong explanation rejects the right ones.
        """
        costs = []
        rejected = self._ledger.outside
        rejected = rejected[rejected > one.pairs[0].used]
        self._set_weights(rejected, 1.0)
        try:
            for trusts_used in (not one.trusts_used, one.trusts_used):
                self._weigh(one, trusts_used=trusts_used)
                for _ in range(_UPDATES):
                    self._solver.update()
                costs.append(self._cost(one, trusts_used=trusts_used))
        finally:
            self._weigh(one, trusts_used=one.trusts_used)
            self._set_weights(rejected, 0.0)
        self._solver.update()
        return costs

    def _cost(self, one: Contradiction, *, trusts_used: bool) -> float:
        """The cost of all that is in, and the gate for each motion of an odometry that is left out."""
        out = {pair.other if trusts_used else pair.used for pair in one.pairs}
        limit = quantile(self._gate, len(self._graph.edge(min(out)).sqrt_information))
        return self._solver.evaluate().cost_final + limit * len(out)

    def _set_weights(self, edges: Index, weight: float) -> None:
        for edge in edges.tolist():
            self._solver.set_weight(edge, weight)

    def _weigh(self, one: Contradiction, *, trusts_used: bool) -> None:
        for pair in one.pairs:
            for edge, is_in in ((pair.used, trusts_used), (pair.other, not trusts_used)):
                if self._ledger.verdict_of(edge) is not Verdict.REJECTED or self._is_contradicted(edge):
                    self._solver.set_weight(edge, float(is_in))

    def _apply(self, one: Contradiction, keyframe: int) -> None:
        """Have the ledger and the weights say what is believed."""
        for pair in one.pairs:
            included, doubted = (pair.used, pair.other) if one.trusts_used else (pair.other, pair.used)
            self._exclude(doubted, keyframe, Reason.CONTRADICTED, pair.chi2)
            self._include(included, keyframe, pair.chi2)

    def _exclude(self, edge: int, keyframe: int, reason: Reason, statistic: float) -> None:
        if self._ledger.verdict_of(edge) is Verdict.REJECTED:
            return
        self._solver.set_weight(edge, 0.0)
        limit = quantile(self._gate, len(self._graph.edge(edge).sqrt_information))
        self._ledger.note(edge, keyframe, Verdict.REJECTED, reason, statistic, limit)
        source, is_alike = self._graph.source_of(edge), reason is Reason.WITHDRAWN
        self._counters.count(source, "odometry_alike" if is_alike else "odometry_contradicted")

    def _is_contradicted(self, edge: int) -> bool:
        """Return whether an edge is out because of another odometry, and not as a slip or by hand."""
        return bool(self._ledger.reason.values.item(edge) == Reason.CONTRADICTED)

    def _include(self, edge: int, keyframe: int, statistic: float, after: Reason = Reason.CONTRADICTED) -> None:
        if self._ledger.verdict_of(edge) is Verdict.REJECTED and self._ledger.reason.values.item(edge) == after:
            self._solver.set_weight(edge, 1.0)
            self._ledger.note(edge, keyframe, Verdict.NOT_EVALUATED, Reason.NONE, statistic)

    def _between(self, vertices: Sequence[int]) -> list[_Pair]:
        used = self._used.get(tuple(vertices))
        return [pair for pair in self._pairs if pair.used == used]


def _covariance(root: Array) -> Array:
    return np.asarray(np.linalg.inv(root.T @ root), dtype=float)
