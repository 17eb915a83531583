"""Landmarks that a displacement at a keyframe would move, and accepted edges that it would contradict."""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index, Numbers

_CLOSURES = -1


@dataclass(frozen=True, slots=True)
class Begin:
    """A keyframe at which the robot may have been moved.

    Attributes
    ----------
    first : its vertex
    contradicted, explained : edges that speak against it, and for it
    """

    first: int
    contradicted: int
    explained: int


@dataclass(frozen=True, slots=True)
class Connections:
    """Accepted edges that connect what is before a keyframe with it or a later one.

    Such an edge is a sighting of a landmark that was begun before the keyframe, or a closure. A displacement at the
    keyframe would move one of its ends alone.

    Attributes
    ----------
    keyframes : (K,) vertices of keyframes that are compared, in order
    landmarks : (L,) vertices of what is connected, -1 for all closures together
    counts : (L, K) numbers of edges
    held_back : (m, 2) keyframe and landmark of each sighting that is not accepted, before ``end``
    """

    keyframes: Index
    landmarks: Index
    counts: Index
    held_back: Index

    def likeliest(self, fitting: Index) -> Begin:
        """The last keyframe at which a displacement explains most more edges than it contradicts.

        It contradicts what connects across the keyframe, and explains why sightings since then are not accepted.

        Parameters
        ----------
        fitting : landmarks whose newest sightings fit the displacement
        """
        contradicted = self.counts[~np.isin(self.landmarks, fitting)].sum(axis=0)
        seen_from = np.sort(self.held_back[np.isin(self.held_back[:, 1], fitting), 0])
        explained = len(seen_from) - np.searchsorted(seen_from, self.keyframes)
        best = len(explained) - 1 - int(np.argmax((explained - contradicted)[::-1]))
        return Begin(int(self.keyframes[best]), int(contradicted[best]), int(explained[best]))


def landmarks_begun(graph: Graph, held: Index) -> Index:
    """Return for each landmark, by its vertex, the first keyframe from which a sighting of it is accepted.

    Other vertices have themselves; -1 where more than sightings determines one.

    Parameters
    ----------
    held : vertices that are held in place
    """
    count = graph.vertex_ids.next
    begun, is_sighted, is_tied = np.arange(count), np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    is_tied[held] = True
    for table in graph.tables.values():
        used = table.at(np.flatnonzero(table.weight.values > 0.0))
        ends, of_landmark = used.vertices, graph.has_label(used.ids, ("landmarks",))
        is_tied[ends[~of_landmark]] = True
        if of_landmark.any():
            keyframes, landmarks = ends[of_landmark, :2].T
            begun[landmarks[~is_sighted[landmarks]]] = count
            is_sighted[landmarks] = True
            np.minimum.at(begun, landmarks, keyframes)
    begun[is_sighted & is_tied] = -1
    return begun


def connections_across(graph: Graph, held: Index, keyframes: Index, end: int) -> Connections:
    """Count the accepted edges that connect what is before each keyframe with it or a later one.

    Parameters
    ----------
    held : vertices that are held in place
    keyframes : vertices, in order
    end : vertex of a later keyframe, up to which sightings that are not accepted are of interest
    """
    begun, found = landmarks_begun(graph, held), [np.empty((0, 3), dtype=np.int64)]
    held_back = [np.empty((0, 2), dtype=np.int64)]
    for table in graph.tables.values():
        is_used, of_landmark = table.weight.values > 0.0, graph.has_label(table.ids, ("landmarks",))
        if of_landmark.any():
            out = table.at(np.flatnonzero(of_landmark & ~is_used)).vertices[:, :2]
            held_back.append(out[(out[:, 0] >= keyframes[0]) & (out[:, 0] < end)])
        used = table.at(np.flatnonzero(is_used))
        seen, closed = used.vertices[of_landmark[is_used]], used.vertices[graph.has_label(used.ids, ("closures",))]
        if len(seen):
            found.append(np.column_stack([seen[:, 1], begun[seen[:, 1]], seen[:, 0]]))
        if len(closed):
            found.append(np.column_stack([np.full(len(closed), _CLOSURES), np.sort(closed[:, :2], axis=1)]))
    what, first, last = np.concatenate(found).T
    is_across = (first < last) & (last >= keyframes[0])
    landmarks, rows = np.unique(what[is_across], return_inverse=True)
    steps = np.zeros((len(landmarks), len(keyframes) + 1), dtype=np.int64)
    np.add.at(steps, (rows, np.searchsorted(keyframes, first[is_across], side="right")), 1)
    np.add.at(steps, (rows, np.searchsorted(keyframes, last[is_across], side="right")), -1)
    return Connections(keyframes, landmarks, np.cumsum(steps, axis=1)[:, :-1], np.concatenate(held_back))


def moved_values(space: Geometry, solver: Solver, motions: Mapping[int, Numbers]) -> Array:
    """The stored numbers of all vertices, with each from the first of these on moved as the last of these before.

    The robot is moved, and with it the landmarks whose first accepted sighting is newer.

    Parameters
    ----------
    motions : of keyframes in map, by their vertices
    """
    graph, values, keyframes = solver.graph, solver.values, sorted(motions)
    begun, every = landmarks_begun(graph, solver.held), graph.vertex_ids.since()
    for vertex in every[begun[every] >= keyframes[0]].tolist():
        motion, one = motions[keyframes[bisect_right(keyframes, begun[vertex]) - 1]], graph.vertex(vertex)
        numbers = tuple(values[one.stored].tolist())
        if one.kind is space.pose:
            values[one.stored] = space.group.compose(motion, numbers)
        elif one.kind is space.point:
            values[one.stored] = space.group.act(motion, numbers)
    return values
