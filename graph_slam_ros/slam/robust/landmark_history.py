"""The history of landmarks: when each was first seen, and from which keyframe on it is well known."""

from graph_slam_ros.graph import Graph
from graph_slam_ros.slam.robust.ledger import Ledger

_SUPPORT, _FIRST = 4, 20  # accepted sightings, of the first so many, that make a landmark one to compare with
_DOUBTED = 0.3  # part of them that may be held back: else the landmark itself stands at the wrong place


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
        count = len(self._ledger)
        judged = [(edge, k) for edge, k in self._earliest[landmark] if edge < count]
        are_inside = self._ledger.are_inside(edge for edge, _ in judged)
        accepted = [k for (_, k), is_inside in zip(judged, are_inside, strict=True) if is_inside]
        doubted = sum(edge < newest and not is_inside for (edge, _), is_inside in zip(judged, are_inside, strict=True))
        if doubted > _DOUBTED * (doubted + len(accepted)):
            return self._graph.vertex_count
        return accepted[_SUPPORT - 1] if len(accepted) >= _SUPPORT else self._graph.vertex_count
