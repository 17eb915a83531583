"""The schedule of relinearisation: when vertices are searched for large steps."""

from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Index

NOT_YET, MAYBE, SURELY = range(3)
BY_FAR = 10.0  # times the threshold: steps that are linearised anew at once


class RelinearizationSchedule:
    """Counts updates, and keeps the vertices that an update solved last, to be searched by the next one."""

    def __init__(self) -> None:
        self._unseen = NONE
        self._updates = 0

    def note(self, solved: Index) -> None:
        """Note vertices that were solved after an update's last search; the next update searches them."""
        self._unseen = solved

    def hasten(self, every: int) -> None:
        """Let the next update search all vertices."""
        self._updates = every

    def is_due(self, every: int) -> int:
        """Return whether all vertices that moved are to be searched: SURELY, NOT_YET, or MAYBE, at a closure."""
        self._updates += 1
        if self._updates >= every:
            return SURELY
        return MAYBE if 3 * self._updates >= 2 * every else NOT_YET

    def begin(self) -> None:
        """Count from the present search."""
        self._updates = 0

    def unseen(self) -> Index:
        """Return the vertices that the last update solved after its last search; once."""
        unseen, self._unseen = self._unseen, NONE
        return unseen
