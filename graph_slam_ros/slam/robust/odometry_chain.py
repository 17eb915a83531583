"""The newest keyframes along odometry alone: the frame in which the search for a displacement lays out sightings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Index, Numbers

_MOST = 2000  # keyframes that are kept


@dataclass(frozen=True, slots=True)
class _Link:
    """The newest part of the chain, up to a keyframe.

    Attributes
    ----------
    edge : odometry's edge to it
    stamp_ns : of the keyframe
    pose : of the keyframe in the chain's frame
    drift : variances [m^2, rad^2] of odometry since the chain began
    """

    edge: int
    stamp_ns: int
    pose: Numbers
    drift: Array


class OdometryChain:
    """The motions of odometry from keyframe to keyframe, one after the other, of the newest keyframes.

    Keyframes are named by their vertices. Its frame is that of the first keyframe before them that was ever added.
    """

    def __init__(self, space: Geometry, graph: Graph) -> None:
        self._space, self._graph = space, graph
        self._links: dict[int, _Link] = {}

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._links

    def __bool__(self) -> bool:
        return bool(self._links)

    @property
    def vertices(self) -> Index:
        """The keyframes, in order."""
        return np.fromiter(self._links, dtype=np.int64, count=len(self._links))

    def add(self, edge: int, vertices: Sequence[int], T_last_now: Numbers, stamp_ns: int) -> None:
        """Add the motion from one keyframe to the next, whose stamp it is. A second edge there replaces the first."""
        last, now = vertices
        if now in self._links:
            self._links[now] = replace(self._links[now], edge=edge)
            return
        before = self._links.get(last)
        pose = self._space.group.compose(before.pose if before else self._space.identity, T_last_now)
        drift = (before.drift if before else np.zeros(2)) + self._drift_of(edge)
        self._links[now] = _Link(edge, stamp_ns, tuple(map(float, pose)), drift)
        if len(self._links) > _MOST:
            del self._links[next(iter(self._links))]

    def forget_before(self, keyframe: int) -> None:
        """Forget older keyframes."""
        while self._links and (oldest := next(iter(self._links))) < keyframe:
            del self._links[oldest]

    def renumber(self, vertices: Index, edges: Index, first: int) -> None:
        """Take over new ids of all vertices and edges, by old ones.

        Parameters
        ----------
        first : the first keyframe that stays, by its new vertex: motions from it on are kept
        """
        links = list(self._links.values())
        vertices_now = vertices[self.vertices].tolist()
        edges_now = edges[[link.edge for link in links]].tolist() if links else []
        self._links = {
            vertex: _Link(edge, link.stamp_ns, link.pose, link.drift)
            for vertex, edge, link in zip(vertices_now, edges_now, links, strict=True)
            if vertex > first
        }

    def pose(self, keyframe: int) -> Numbers:
        """Return where odometry alone has a keyframe."""
        return self._links[keyframe].pose

    def edge(self, keyframe: int) -> int:
        """The edge of odometry to a keyframe."""
        return self._links[keyframe].edge

    def stamp_ns(self, keyframe: int) -> int:
        """The stamp of a keyframe."""
        return self._links[keyframe].stamp_ns

    def drift(self, keyframe: int) -> Array:
        """Variances [m^2, rad^2] of odometry up to a keyframe."""
        return self._links[keyframe].drift

    def drift_since(self, variances: Array, pose: Numbers, keyframe: int) -> tuple[float, float]:
        """Sigmas [m, rad] of odometry up to a keyframe, since it had these variances and was there."""
        since, n = self.drift(keyframe) - variances, self._space.dimensions
        lever = float(np.linalg.norm(np.subtract(self.pose(keyframe)[:n], pose[:n])))
        return float(np.sqrt(since[0] + since[1] * lever**2)), float(np.sqrt(since[1]))

    def _drift_of(self, edge: int) -> Array:
        """Variances [m^2, rad^2] of one step of odometry, the largest of any direction."""
        root, n = self._graph.edge(edge).sqrt_information, self._space.dimensions
        variances = np.linalg.inv(root.T @ root).diagonal()
        return np.array([variances[:n].max(), variances[n:].max()])
