"""The ledger: all decisions on every measurement that may be wrong, with keyframe and reason."""

from collections.abc import Callable, Iterable
from copy import copy, deepcopy
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.tables import Column, LastingIds
from graph_slam_ros.typing import Array, Index


class Verdict(IntEnum):
    """The verdict on an edge."""

    NOT_EVALUATED = 0  # it is odometry, or another edge that nobody doubts
    ACCEPTED = 1
    DOWN_WEIGHTED = 2  # it is in, but fits so badly that its loss leaves it little weight
    PENDING = 3  # held back since it came
    REJECTED = 4  # taken out after it was in


class Reason(IntEnum):
    """The reason why a verdict is not, or no longer, ``ACCEPTED``."""

    NONE = 0
    UNLIKELY = 1  # too far from what all else predicts, by their joint covariance
    DOES_NOT_FIT = 2  # after the solve its residual is too large
    OUTVOTED = 3  # a second look at everything found a better explanation without it
    WITHDRAWN = 4  # somebody, or association, took it out
    QUARANTINED = 5  # nothing could be solved with it
    DISPLACED = 6  # odometry, where the landmarks showed that the robot was moved without its noticing
    REVOKED = 7  # what replaced a displaced or slipped edge of odometry, which is used again
    BY_HAND = 9  # somebody decided so: taken out for good, or in and never judged
    SLIP = 11  # odometry, where its errors were larger than it says: an edge with more noise stands in its place


FINAL = (  # it is out for good
    *(Reason.WITHDRAWN, Reason.QUARANTINED, Reason.DISPLACED, Reason.REVOKED, Reason.BY_HAND),
    Reason.SLIP,
)
INSIDE = (Verdict.ACCEPTED, Verdict.DOWN_WEIGHTED)
OUTSIDE = (Verdict.PENDING, Verdict.REJECTED)
_ACCEPTED, _DOWN_WEIGHTED = _INSIDE = tuple(map(int, INSIDE))  # comparing with members of an enumeration is slow
_FINAL = frozenset(map(int, FINAL))


@dataclass(frozen=True, slots=True)
class VerdictChange:
    """A changed verdict: its keyframe, verdict, reason, statistic and threshold."""

    edge: int
    keyframe: int
    verdict: Verdict
    reason: Reason
    statistic: float
    threshold: float


class Ledger:
    """Verdicts of all edges of a graph: a row of each column for each, in order.

    Attributes
    ----------
    ids : of the edges that have one, with their rows
    verdict, reason : codes of ``Verdict`` and ``Reason``
    statistic, threshold : chi2 that was last judged, and what it was held against
    numbers : how many numbers were measured, the statistic's degrees of freedom
    residuals : end to end, how far each of these was from what was expected when the edge came, in its units
    keyframe : at which it was judged first
    changes : how often a verdict was set after an edge was entered
    final : verdicts of edges below this id stay: they are of a map that is frozen
    history : every change after the first verdict, and first verdicts that are not ``ACCEPTED``, in order
    """

    def __init__(self) -> None:
        self.verdict, self.reason = Column(np.int64), Column(np.int64)
        self.ids = LastingIds("edge", self.verdict)
        self.statistic, self.threshold = Column(np.float64), Column(np.float64)
        self.numbers, self.keyframe = Column(np.int64), Column(np.int64)
        self.residuals = Column(np.float64)
        self.history: list[VerdictChange] = []
        self.final = self.changes = 0
        self._out: set[int] = set()

    def finish(self, edges: int) -> None:
        """Make the verdicts of edges below an id final. All others may change."""
        self.final = edges
        first = self.ids.first_from(edges)
        verdict, reason = self.verdict.values[first:], self.reason.values[first:]
        is_out = np.isin(verdict, OUTSIDE) & ~np.isin(reason, FINAL)
        self._out = set(self.ids.since(edges)[is_out].tolist())

    def __len__(self) -> int:
        return len(self.verdict)

    def keep(self, edges: Index) -> None:
        """Forget all edges but some, and the history of the others."""
        is_kept = np.isin(self.ids.since(), edges)
        self.ids.put(edges, self.ids.next)
        self.residuals.values = self.residuals.values[np.repeat(is_kept, self.numbers.values)]
        for column in (self.verdict, self.reason, self.statistic, self.threshold, self.numbers, self.keyframe):
            column.values = column.values[is_kept]
        self.history[:] = [one for one in self.history if self.ids.has(one.edge)]
        self._out = set(filter(self.ids.has, self._out))

    def copy(self) -> "Ledger":
        """Another ledger with the same records and an empty history."""
        out = copy(self)
        for name, column in vars(self).items():
            if isinstance(column, Column):
                setattr(out, name, deepcopy(column))
        out.history, out._out, out.ids = [], set(self._out), LastingIds("edge", out.verdict)
        out.ids.put(self.ids.early, self.ids.later)
        return out

    def enter(
        self,
        keyframe: int | Index,
        statistic: Array,
        numbers: Index,
        threshold: Array,
        residuals: Array,
        judged: NDArray[Any],
    ) -> Index:
        """Open a record for each new edge. Edges that are never judged are accepted. Returns their ids.

        Parameters
        ----------
        residuals : what each measured differs from what was expected of it then, end to end
        """
        count = len(statistic)
        ids = np.arange(self.ids.next, self.ids.next + count)
        Column.extend(
            (self.verdict, np.where(judged, Verdict.ACCEPTED, Verdict.NOT_EVALUATED), count),
            (self.reason, Reason.NONE, count),
            (self.keyframe, keyframe, count),
            (self.statistic, statistic, count),
            (self.threshold, threshold, count),
            (self.numbers, numbers, count),
            (self.residuals, residuals, len(residuals)),
        )
        return ids

    def put(self, edge: int, verdict: Verdict, reason: Reason) -> None:
        """Set a verdict without adding to the history."""
        self.changes += 1
        row = self.ids.row(edge)
        self.verdict.values[row], self.reason.values[row] = verdict, reason
        if verdict in OUTSIDE and reason not in FINAL:
            self._out.add(edge)
        else:
            self._out.discard(edge)

    def note(
        self,
        edge: int,
        keyframe: int,
        verdict: Verdict,
        reason: Reason,
        statistic: float,
        threshold: float | None = None,
    ) -> None:
        """Set a verdict and add it to the history. The default threshold is that of the edge."""
        self.put(edge, verdict, reason)
        row = self.ids.row(edge)
        self.statistic.values[row] = statistic
        limit = float(self.threshold.values[row]) if threshold is None else threshold
        self.history.append(VerdictChange(edge, keyframe, verdict, reason, float(statistic), limit))

    def verdict_of(self, edge: int) -> Verdict:
        """The verdict on one edge; new edges without a record have one, too."""
        row = self.ids.row(edge)
        return Verdict(int(self.verdict.values[row])) if row < len(self) else Verdict.NOT_EVALUATED

    def is_inside(self, edge: int) -> bool:
        """Return whether an edge has a weight."""
        return self.verdict.values.item(self.ids.row(edge)) in _INSIDE

    def are_inside(self, edges: Iterable[int]) -> list[bool]:
        """Return whether each of some edges has a weight."""
        verdict, row = self.verdict.values, self.ids.row
        return [verdict.item(row(edge)) in _INSIDE for edge in edges]

    def is_withdrawn(self, edge: int) -> bool:
        """Return whether an edge was removed permanently."""
        row = self.ids.row(edge)
        return row < len(self) and self.reason.values.item(row) in _FINAL and self.verdict.values.item(row) != 0

    def is_standing(self) -> Callable[[int], bool]:
        """Return a function of an edge: whether it is judged and was not removed permanently, as it is now."""
        end, row, reason, verdict = self.ids.next, self.ids.row, self.reason.values.item, self.verdict.values.item
        return lambda edge: edge < end and not (reason(row(edge)) in _FINAL and verdict(row(edge)) != 0)

    @property
    def inside(self) -> Index:
        """Judged edges with a weight that may be judged again."""
        verdict = self.verdict.values[self.ids.first_from(self.final) :]
        return self.ids.since(self.final)[(verdict == _ACCEPTED) | (verdict == _DOWN_WEIGHTED)]

    @property
    def outside(self) -> Index:
        """Rejected edges that may come back."""
        return np.array(sorted(self._out), dtype=np.int64)

    @property
    def candidates(self) -> Index:
        """Judged edges that may be judged again, with a weight or rejected, in order."""
        return np.sort(np.concatenate((self.inside, self.outside)))

    @property
    def outside_count(self) -> int:
        """The number of rejected edges that may come back."""
        return len(self._out)
