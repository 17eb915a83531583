"""The history of landmarks: when each was first seen, and from which keyframe on it is well known."""

from graph_slam_ros.graph import Graph
from graph_slam_ros.slam.robust.ledger import Ledger
from graph_slam_ros.typing import Index

_SUPPORT, _FIRST = 4, 20  # accepted sightings, of the first so many, that make a landmark one to compare with
_DOUBTED = 0.3  # part of them that may be held back: else the landmark itself stands at the wrong place


_Judged = tuple[tuple[int, int], list[int], list[int]]
"""Of a landmark's first sightings: changes of the ledger and the number of those judged; keyframes of those that are
accepted; edges of those that are held back."""


class LandmarkHistory:
    """The first sightings of each landmark.

    Parameters
    ----------
    graph, ledger : of the back-end
    """

    def __init__(self, graph: Graph, ledger: Ledger) -> None:
        self._graph, self._ledger = graph, ledger
        self._start = graph.vertex_count  # landmarks of a map that was loaded are known
        self._surveyed: set[int] = set()
        self._earliest: dict[int, list[tuple[int, int]]] = {}  # (edge, keyframe) of each landmark's first sightings
        self._known: dict[int, _Judged] = {}

    def renumber(self, vertices: Index, edges: Index, first: int) -> None:
        """Take over new ids of all vertices and edges, by old ones; -1: it was removed.

        Parameters
        ----------
        first : the first keyframe that stays, by its new vertex; landmarks before it are known
        """
        self._start = first
        self._surveyed = {int(vertices[landmark]) for landmark in self._surveyed if vertices[landmark] >= 0}
        self._earliest = {
            int(vertices[landmark]): [(int(edges[e]), int(vertices[k])) for e, k in earliest if edges[e] >= 0]
            for landmark, earliest in self._earliest.items()
            if vertices[landmark] >= first
        }
        self._known.clear()

    def add_survey(self, landmark: int) -> None:
        """Note a landmark, by its vertex, whose position is surveyed."""
        self._surveyed.add(landmark)

    def add(self, edge: int, keyframe: int, landmark: int) -> None:
        """Note a sighting of a landmark."""
        earliest = self._earliest.setdefault(landmark, [])
        if len(earliest) < _FIRST:
            earliest.append((edge, keyframe))

    def known_from(self, landmark: int, newest: int) -> int:
        """The keyframe, by its vertex, from which on a landmark was well known.

        Parameters
        ----------
        newest : from this edge on a sighting that is held back tells nothing against the landmark
        """
        if landmark < self._start or landmark in self._surveyed:
            return -1
        _, accepted, held_back = self._judged(landmark)
        doubted = sum(edge < newest for edge in held_back)
        if doubted > _DOUBTED * (doubted + len(accepted)):
            return self._graph.vertex_count
        return accepted[_SUPPORT - 1] if len(accepted) >= _SUPPORT else self._graph.vertex_count

    def _judged(self, landmark: int) -> _Judged:
        """The verdicts on the first sightings of a landmark, looked up only where some may have changed."""
        earliest, count = self._earliest[landmark], len(self._ledger)
        judged = len(earliest)
        while judged and earliest[judged - 1][0] >= count:
            judged -= 1
        as_of = self._ledger.changes, judged
        known = self._known.get(landmark)
        if known is None or known[0] != as_of:
            are_inside = self._ledger.are_inside(edge for edge, _ in earliest[:judged])
            verdicts = list(zip(earliest, are_inside, strict=False))
            accepted = [k for (_, k), is_inside in verdicts if is_inside]
            known = as_of, accepted, [edge for (edge, _), is_inside in verdicts if not is_inside]
            self._known[landmark] = known
        return known
