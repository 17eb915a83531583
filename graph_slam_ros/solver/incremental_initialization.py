"""Initial values by an incremental solution, for graphs where batch solvers end in a local minimum.

Pose after pose, each predicted from the estimate so far, the incremental solver corrects the graph before the next
closure arrives; so it often reaches the optimum where batch solvers, from any start, do not.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import EdgeType, Graph, VertexKind
from graph_slam_ros.lie import se2, se3
from graph_slam_ros.solver.solver import Solver
from graph_slam_ros.typing import Array, Index

OnPose: TypeAlias = Callable[[int, int], None]


def replayed_values(
    graph: Graph, values: Array, poses: Sequence[int], relative: Sequence[EdgeType], sighting: EdgeType, on_pose: OnPose
) -> Array:
    """Return the stored numbers of all vertices after an incremental solution along some poses.

    Parameters
    ----------
    values : stored numbers to begin with; the first pose keeps its own, and so does what is not reached
    poses : in order of time
    relative, sighting : types of the edges that are driven along; all others are left to what comes after
    on_pose : called before each pose (``initial_values``)

    Raises
    ------
    GraphSlamError
        A pose that no relative pose joins to an earlier one.
    """
    kind = graph.kind_of(poses[0])
    drive = _Drive(graph, values, kind)
    rank = np.full(graph.vertex_count, -1, dtype=np.int64)
    rank[list(poses)] = np.arange(len(poses))
    arriving: list[list[tuple[int, EdgeType, int]]] = [[] for _ in poses]
    for edge in (*relative, sighting):
        if edge in graph.tables:
            table = graph.tables[edge]
            rows = np.flatnonzero(table.weight.values)
            newest = rank[table.vertices.values[rows]].max(axis=1)
            for row, k in zip(rows.tolist(), newest.tolist(), strict=True):
                arriving[k].append((int(table.id.values[row]), edge, row))
    for k, pose in enumerate(poses):
        on_pose(k, len(poses))
        drive.to(pose, sorted(arriving[k], key=lambda item: item[0]), rank, sighting)
    return drive.finish()


class _Drive:
    """A solver that goes through a graph pose by pose."""

    def __init__(self, graph: Graph, values: Array, kind: VertexKind) -> None:
        self.graph, self.values, self.kind = graph, values.copy(), kind
        self.solver = Solver(graph)
        self.solver.start_at(values)
        self.group = se2 if kind.dof == 3 else se3
        self.known: set[int] = set()

    def to(self, pose: int, edges: Sequence[tuple[int, EdgeType, int]], rank: Index, sighting: EdgeType) -> None:
        """Add a pose, the landmarks that are first seen from it, and its edges."""
        new = [pose]
        if self.known:
            self.solver.place(pose, self._predicted(pose, edges, rank, sighting))
        here = tuple(self.solver.estimate([pose])[0].tolist())
        for _, edge, row in edges:
            if edge is sighting:
                point, seen = self._ends(edge, row)[1], self._measured(edge, row)
                if point not in self.known and point not in new:
                    self.solver.place(point, np.array(self.group.act(here, seen)))
                    new.append(point)
        self.solver.add(new, [edge_id for edge_id, _, _ in edges])
        if not self.known:
            self.solver.hold(pose)
        self.known.update(new)
        self.solver.update()

    def finish(self) -> Array:
        """Return the stored numbers of all vertices: the estimate where it has one."""
        for vertex in sorted(self.known):
            value, at = self.solver.estimate([vertex])[0], self.graph.offset.values[vertex]
            self.values[at : at + len(value)] = value
        return self.values

    def _predicted(
        self, pose: int, edges: Sequence[tuple[int, EdgeType, int]], rank: Index, sighting: EdgeType
    ) -> Array:
        """Predict a pose from the latest earlier pose that an edge joins it to."""
        best, value = -1, None
        for _, edge, row in edges:
            i, j = self._ends(edge, row)
            other = i if j == pose else j
            if edge is not sighting and rank[other] > best:
                best, step = int(rank[other]), self._measured(edge, row)
                from_other = tuple(self.solver.estimate([other])[0].tolist())
                value = self.group.compose(from_other, step if j == pose else self.group.inverse(step))
        if value is None:
            raise GraphSlamError(f"init online: no relative pose joins vertex {pose} to an earlier one")
        return np.array(value)

    def _ends(self, edge: EdgeType, row: int) -> tuple[int, int]:
        i, j = self.graph.tables[edge].vertices.values[row].tolist()
        return i, j

    def _measured(self, edge: EdgeType, row: int) -> tuple[float, ...]:
        return tuple(self.graph.tables[edge].measured.values[row].tolist())
