"""A change of the problem that is made as a whole, or not at all."""

from typing import Protocol

from graph_slam_ros.solver.clique_tree.storage import SUBSTITUTED, Tree
from graph_slam_ros.solver.entry import enter_newest
from graph_slam_ros.solver.pending import PendingChanges
from graph_slam_ros.typing import Index


class Undoable(Protocol):
    """A problem whose last change can be undone."""

    _tree: Tree
    _pointers: Index
    _pending: PendingChanges

    def _undo(self, substituted: int, vertices: Index, edges: Index) -> None: ...


class Transaction:
    """The context in which vertices and edges enter and are solved for; an error undoes it.

    A generator as context would take twice the time, in each update.
    """

    __slots__ = ("_edges", "_problem", "_substituted", "_vertices")

    def __init__(self, problem: Undoable, vertices: Index, edges: Index) -> None:
        self._problem, self._vertices, self._edges = problem, vertices, edges
        self._substituted = int(problem._tree.state[SUBSTITUTED])

    def __enter__(self) -> None:
        try:
            enter_newest(self._problem._pointers, self._vertices, self._edges)
        except BaseException:
            self._problem._undo(self._substituted, self._vertices, self._edges)
            raise

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None:
            self._problem._pending = PendingChanges()
        else:
            self._problem._undo(self._substituted, self._vertices, self._edges)
