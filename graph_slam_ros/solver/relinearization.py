"""The schedule of relinearisation: when vertices are searched for large steps."""

import numpy as np

from graph_slam_ros.solver.clique_tree.storage import TAIL_LEAST
from graph_slam_ros.solver.pending import NONE
from graph_slam_ros.typing import Index

BY_FAR = 10.0  # times the threshold: steps that are linearised anew at once


class RelinearizationSchedule:
    """Counts updates, and collects the vertices that moved until all are searched for large steps."""

    def __init__(self) -> None:
        self._moved: list[Index] = []
        self._unseen = NONE
        self._updates = 0

    def note(self, moved: Index) -> None:
        """Note vertices that moved after an update's last search; the next update searches them."""
        self._moved.append(moved)
        self._unseen = moved

    def hasten(self, every: int) -> None:
        """Let the present update search all collected vertices."""
        self._updates = every

    def after_update(self, moved: Index, every: int) -> tuple[Index, float]:
        """Return the vertices to search for large steps, and the multiple of the threshold that a step must exceed.

        After a number of updates, or sooner if many moved, these are all that moved since; else those that this update
        moved.
        """
        self._moved.append(moved)
        self._updates += 1
        if self._updates * (3 if len(moved) > TAIL_LEAST else 2) < 2 * every:
            unseen, self._unseen = self._unseen, NONE
            return np.union1d(moved, unseen) if len(unseen) else moved, BY_FAR
        moved = np.unique(np.concatenate(self._moved))
        self._moved, self._unseen, self._updates = [], NONE, 0
        return moved, 1.0
