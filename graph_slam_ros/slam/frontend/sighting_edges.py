"""The origin of each sighting edge: its stamp, and the poses of robot and sensor relative to its keyframe."""

import numpy as np
from numpy.typing import ArrayLike

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import Column
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.typing import Array, Index


class SightingEdges:
    """The origin of each sighting edge, in columns that grow, in order of edges.

    Attributes
    ----------
    edge, stamp_ns : (n,)
    T_keyframe_base : (n, size)
    sensor : (n, dimensions) position of the sensor in the base frame; zeros if the message does not state it
    """

    def __init__(self, space: Geometry) -> None:
        self._space = space
        self._edge, self._stamp_ns = Column(np.int64), Column(np.int64)
        self._pose, self._sensor = Column(np.float64, space.pose.size), Column(np.float64, space.dimensions)

    @property
    def edge(self) -> Index:
        """Edge ids, a view."""
        return self._edge.values

    @property
    def stamp_ns(self) -> Index:
        """Stamps, a view."""
        return self._stamp_ns.values

    @property
    def T_keyframe_base(self) -> Array:
        """Poses of the base at the stamp, a view."""
        return self._pose.values

    @property
    def sensor(self) -> Array:
        """Positions of the sensors, a view."""
        return self._sensor.values

    def append(self, edge: int, s: Sighting, where: PoseAtStamp) -> None:
        """Add the origin of an edge."""
        sensor = (s.T_base_sensor or self._space.identity)[: self._space.dimensions]
        self.put(edge, where.stamp_ns, where.T_keyframe_base, sensor)

    def put(self, edge: int, stamp_ns: int, T_keyframe_base: ArrayLike, sensor: ArrayLike) -> None:
        """Add a row."""
        where = (self._pose, T_keyframe_base, 1), (self._sensor, sensor, 1)
        Column.extend((self._edge, edge, 1), (self._stamp_ns, stamp_ns, 1), *where)

    def keep(self, edges: Index) -> None:
        """Forget all but these edges."""
        rows = np.flatnonzero(np.isin(self.edge, edges))
        for column in (self._edge, self._stamp_ns, self._pose, self._sensor):
            column.values = column.values[rows]

    def __len__(self) -> int:
        return len(self._edge)

    def places(self, edges: Index) -> Index:
        """Return the row of each edge; -1 if it has none."""
        if not len(self):
            return np.full(len(edges), -1)
        at = np.minimum(np.searchsorted(self.edge, edges), len(self) - 1)
        return np.where(self.edge[at] == edges, at, -1)
