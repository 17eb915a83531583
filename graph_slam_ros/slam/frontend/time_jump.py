"""Stamps that begin anew though no clock tells: a time server, a recording that is played again without /clock."""

from collections import deque
from collections.abc import Iterable

from graph_slam_ros.measurements.types import Measured, Odometry

_SURE_NS, _SURE = 1_000_000_000, 3  # of stamps, and messages: a burst that was held up is shorter
_AGAIN_NS = 10_000_000_000  # what has been told not longer ago is told again where nothing new comes


class TimeJumpDetector:
    """Looks whether odometry goes on from an earlier stamp, and nothing of any odometry from where it was.

    Parameters
    ----------
    back_s : what is less is messages out of order
    """

    def __init__(self, back_s: float) -> None:
        self._back_ns = round(back_s * 1e9)
        self._newest_ns: dict[str, int] = {}
        self._recent_ns: dict[str, deque[int]] = {}
        self._anew: dict[str, list[int]] = {}  # ascending stamps from which it may go on: the first, the last, how many

    def is_jump(self, measured: Iterable[Measured]) -> bool:
        """Return whether stamps jumped back with one of these, in the order they came."""
        jumped = [
            self._has_jumped(m) for m in measured if isinstance(m, Odometry)
        ]  # all of them, whatever the first tells
        return any(jumped)

    def forget(self) -> None:
        """Forget all stamps: what comes next is of another time."""
        self._newest_ns.clear()
        self._recent_ns.clear()
        self._anew.clear()

    def _has_jumped(self, m: Odometry) -> bool:
        newest_ns = self._newest_ns.get(m.source, 0)
        if m.stamp_ns >= newest_ns - self._back_ns:
            self._newest_ns[m.source] = max(newest_ns, m.stamp_ns)
            self._remember(m)
            self._anew.clear()
            return False
        if m.stamp_ns in self._recent_ns[m.source]:
            return False
        first_ns, last_ns, count = self._anew.get(m.source, (0, 0, 0))
        if count == 0 or m.stamp_ns <= last_ns:
            first_ns, count = m.stamp_ns, 0
        self._anew[m.source] = [first_ns, m.stamp_ns, count + 1]
        return count + 1 >= _SURE and m.stamp_ns - first_ns >= _SURE_NS

    def _remember(self, m: Odometry) -> None:
        recent = self._recent_ns.setdefault(m.source, deque())
        recent.append(m.stamp_ns)
        while recent and recent[0] < self._newest_ns[m.source] - _AGAIN_NS:
            recent.popleft()
