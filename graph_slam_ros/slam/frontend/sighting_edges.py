"""The origin of each sighting edge: its stamp, and the poses of robot and sensor relative to its keyframe."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import Column
from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.typing import Index


class SightingEdges:
    """The origin of each sighting edge, in order of edges."""

    def __init__(self, space: Geometry) -> None:
        poses = ("T_keyframe_base", "f8", (space.pose.size,)), ("sensor", "f8", (space.dimensions,))
        self._space, self._rows = space, Column(np.dtype([("edge", "i8"), ("stamp_ns", "i8"), *poses]))

    @property
    def rows(self) -> NDArray[Any]:
        """A row of each edge, a view.

        ``edge``; ``stamp_ns``; ``T_keyframe_base``, the pose of the base then; ``sensor``, the position of the sensor
        in the base frame, zeros if the message does not state it.
        """
        return self._rows.values

    def append(self, edge: int, s: Sighting, where: PoseAtStamp) -> None:
        """Add the origin of an edge."""
        sensor = tuple((s.T_base_sensor or self._space.identity)[: self._space.dimensions])
        Column.extend((self._rows, (edge, where.stamp_ns, tuple(where.T_keyframe_base), sensor), 1))

    def keep(self, edges: Index) -> None:
        """Forget all but these edges."""
        self._rows.values = self.rows[np.isin(self.rows["edge"], edges)]

    def places(self, edges: Index) -> Index:
        """Return the row of each edge; -1 if it has none."""
        known = self.rows["edge"]
        if not len(known):
            return np.full(len(edges), -1)
        at = np.minimum(np.searchsorted(known, edges), len(known) - 1)
        return np.where(known[at] == edges, at, -1)
