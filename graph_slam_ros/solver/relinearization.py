"""The schedule of relinearisation: when vertices are searched for large steps."""

import numpy as np

from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Index

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

    def is_due(self, every: int, *, closes: bool) -> bool:
        """Return whether all vertices that moved are to be searched: every so many updates, or sooner at a closure."""
        self._updates += 1
        if self._updates * (3 if closes else 2) < 2 * every:
            return False
        self._updates = 0
        return True

    def after_update(self, solved: Index) -> Index:
        """Return the vertices to search for steps that are large by far: those that this update solved."""
        unseen, self._unseen = self._unseen, NONE
        return np.union1d(solved, unseen) if len(unseen) else solved
