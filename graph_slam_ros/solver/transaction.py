"""A change of the problem that is made as a whole, or not at all."""

from typing import Protocol

from graph_slam_ros.solver.clique_tree.storage import ENTERED, SUBSTITUTED, Tree
from graph_slam_ros.solver.pending import PendingChanges


class Undoable(Protocol):
    """A problem whose last change can be undone."""

    _tree: Tree
    _pending: PendingChanges

    def _undo(self, substituted: int) -> None: ...


class Transaction:
    """The context in which all that is pending enters and is solved for; an error undoes it.

    After an error it is pending again, and the estimate is that of before. The tree is rebuilt at the next update,
    because its numbers are half old and half new; not so if nothing has entered yet.

    A generator as context would take twice the time, in each update.
    """

    __slots__ = ("_entered", "_problem", "_substituted")

    def __init__(self, problem: Undoable) -> None:
        state = problem._tree.state
        self._problem, self._entered, self._substituted = problem, int(state[ENTERED]), int(state[SUBSTITUTED])

    def __enter__(self) -> None:
        pass

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None:
            self._problem._pending = PendingChanges()
        elif self._problem._tree.state[ENTERED] != self._entered:
            self._problem._undo(self._substituted)
