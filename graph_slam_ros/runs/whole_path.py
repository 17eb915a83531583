"""The whole path of a run: the keyframes that are in its map, and those that have left it."""

from pathlib import Path

import numpy as np

from graph_slam_ros.runs.condensed_map import read_left
from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.slam.lifelong.state import Left
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index


class WholePath:
    """All keyframes of a pipeline, those that were condensed included, in order of time.

    Parameters
    ----------
    left : the part that has left the map

    Attributes
    ----------
    stamps_ns : (n,) of the keyframes
    odometry : (n, size) their poses by odometry alone, ``T_odom_base``
    """

    def __init__(self, slam: GraphSlam, left: Left) -> None:
        self._slam, self._left = slam, left
        removed, keyframes = left.keyframes, slam.keyframes
        self.stamps_ns: Index = np.concatenate((removed["stamp_ns"], keyframes.stamps_ns))
        self.odometry: Array = np.concatenate((removed["T_odom"], keyframes.poses.reshape(-1, slam.space.pose.size)))

    @classmethod
    def of(cls, slam: GraphSlam, folder: Path) -> "WholePath":
        """Return that of a pipeline whose run folder has what was condensed. Raises FormatError where that is lost."""
        return cls(slam, read_left(folder, slam.space, slam.bounded))

    def poses(self, solver: Solver | None = None) -> Array:
        """Return the poses ``T_map_base``, (n, size); of another solution of the graph if given."""
        slam = self._slam
        path = (solver or slam.solver).estimate(slam.keyframes.ids).reshape(-1, slam.space.pose.size)
        return np.concatenate((removed_path(slam, self._left, solver), path))


def removed_path(slam: GraphSlam, left: Left, solver: Solver | None = None) -> Array:
    """Return the present poses of the keyframes that have left the map, (n, size); of another solution if given."""
    if slam.bounded is None:
        return np.empty((0, slam.space.pose.size))
    solver = solver or slam.solver
    vertices = np.array([*(one.vertex for one in slam.bounded.old), *slam.keyframes.ids.tolist()], dtype=np.int64)
    vertices = np.sort(vertices)
    return left.path(slam.space, slam.graph.vertex_ids.of_all(vertices), solver.estimate(vertices))
