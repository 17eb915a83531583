"""New numbers of clusters and landmarks, after the oldest clusters have left: what they are of is final."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from graph_slam_ros.slam.association.beam import Decision, Ids
from graph_slam_ros.slam.association.scans import Scan

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Renumbered:
    """New numbers. A landmark has the number of the cluster that began it; if that has left, a fresh one.

    Attributes
    ----------
    gone : how many clusters have left
    fresh : makes the number of a landmark that no cluster has begun
    """

    gone: int
    fresh: Callable[[], int]
    _of_gone: dict[int, int] = field(default_factory=dict)

    def landmark(self, number: int) -> int:
        """Return the new number of a landmark. A negative number stays."""
        if number < 0:
            return number
        if number >= self.gone:
            return number - self.gone
        if number not in self._of_gone:
            self._of_gone[number] = self.fresh()
        return self._of_gone[number]

    def landmarks(self, numbers: Ids) -> Ids:
        """The new numbers of landmarks, of any shape."""
        old, where = np.unique(numbers, return_inverse=True)
        return np.array([self.landmark(one) for one in old.tolist()], dtype=np.int64)[where].reshape(numbers.shape)

    def kept(self, by_landmark: Mapping[int, T], which: Collection[int]) -> dict[int, T]:
        """Return what is known of landmarks, by their new numbers, of some of these."""
        return {number: one for k, one in by_landmark.items() if (number := self.landmark(k)) in which}

    def histories(self, last: Sequence[Decision | None]) -> list[Decision | None]:
        """Chains of decisions without those of clusters that have left. What chains share stays shared."""
        done, out = dict[int, Decision](), list[Decision | None]()
        for one in last:
            chain = list[Decision]()
            while one is not None and one.cluster >= self.gone and id(one) not in done:
                chain.append(one)
                one = one.before
            now = done.get(id(one)) if one is not None else None
            for old in reversed(chain):
                count = 1 + (now.count if now else 0)
                now = done[id(old)] = Decision(now, old.cluster - self.gone, self.landmark(old.landmark), count)
            out.append(now)
        return out


def first_of_later(scans: Sequence[Scan], keyframe: int) -> int:
    """Return the first scan from which on nothing was seen from a keyframe before a number."""
    for k in range(len(scans), 0, -1):
        if any(seen.where.keyframe < keyframe for c in scans[k - 1].clusters for seen in c.seen):
            return k
    return 0
