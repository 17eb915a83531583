"""Messages from the future: they wait a moment for the clock, which may be on its way, and are refused then."""

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence

from graph_slam_ros.measurements.types import Closure, Fix, Odometry, Sightings

Stamped = Odometry | Sightings | Fix | Closure

_PATIENCE_S = 1.0


class FutureStamps:
    """Lets pass what is not ahead of the clock, in the order it came.

    Parameters
    ----------
    most_s : how far ahead is not ahead; 0: everything passes
    now_ns : the clock; 0 where there is none, then everything passes
    refuse : is handed a message that has waited too long
    """

    def __init__(self, most_s: float, now_ns: Callable[[], int], refuse: Callable[[Sequence[Stamped]], None]) -> None:
        self._most_ns, self._now_ns, self._refuse = round(most_s * 1e9), now_ns, refuse
        self._until_ns = 0  # what is older passes without a look at the clock
        self._held: deque[tuple[float, Sequence[Stamped]]] = deque()

    def pass_on(self, messages: Sequence[Stamped]) -> Iterable[Sequence[Stamped]]:
        """The measurements of messages that are due now: of this one and of those that were held."""
        if not self._held and (not self._most_ns or not self.is_ahead(messages)):
            return (messages,)
        self._held.append((time.monotonic(), messages))
        return self.due()

    def due(self) -> list[Sequence[Stamped]]:
        """The held measurements that are due now; those held for too long are refused."""
        out = []
        while self._held:
            since_s, messages = self._held[0]
            if not self.is_ahead(messages):
                out.append(messages)
            elif time.monotonic() - since_s < _PATIENCE_S:
                break
            else:
                self._refuse(messages)
            self._held.popleft()
        return out

    def is_ahead(self, messages: Sequence[Stamped]) -> bool:
        """Return whether one of the messages is too far ahead of the clock."""
        newest_ns = max((m.stamp_ns for m in messages), default=0)
        if newest_ns <= self._until_ns:
            return False
        now_ns = self._now_ns()
        self._until_ns = now_ns + self._most_ns if now_ns else 0
        return bool(now_ns) and newest_ns > self._until_ns

    def drain(self) -> list[Sequence[Stamped]]:
        """Hold nothing any more: refuse measurements ahead of the clock, and return the others."""
        out: list[Sequence[Stamped]] = []
        for _, messages in self._held:
            if self.is_ahead(messages):
                self._refuse(messages)
            else:
                out.append(messages)
        self._held.clear()
        return out

    def forget_time(self) -> None:
        """The clock begins anew."""
        self._until_ns = 0
