"""Edges from poses: fixes, loop closures and given poses."""

import numpy as np

from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edge_noise import edge_noise
from graph_slam_ros.measurements.types import Closure, Fix, InitialPose
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.noise_factors import NoiseScales
from graph_slam_ros.typing import Array, Numbers


class PoseEdges:
    """Adds fixes, loop closures and given poses to a graph. Repaired noise is counted."""

    def __init__(self, space: Geometry, edges: NoiseScales, counters: Counters) -> None:
        self._space, self._edges, self._counters = space, edges, counters

    def initial_pose(self, vertex: int, pose: InitialPose) -> None:
        """Add a prior for a pose that a user gave."""
        noise = self._noise("initialpose", motion_compensation.as_matrix(pose.covariance))
        self._edges.add_edge(self._space.pose_prior, [vertex], pose.T_map_base, noise, "initialpose")

    def fix(self, m: Fix, where: PoseAtStamp, T_map_keyframe: Numbers) -> None:
        """Add a prior to a keyframe. A position without some axes gives one prior per known principal axis."""
        space, vertices, topic = self._space, [where.vertex], m.topic
        if m.kind not in space.fixes:
            self._counters.count(topic, "not_in_this_space")
            return
        compensated = motion_compensation.fix(space, m, where, T_map_keyframe)
        n = space.dimensions
        axes = motion_compensation.axes_known(compensated.covariance) if m.kind == "position" else []
        for axis, variance in axes:
            noise = edge_noise(self._counters, topic, np.array([[variance]]), 1)
            along = float(axis @ compensated.measured[:n])
            measured = (*axis.tolist(), along, *compensated.measured[n:])
            self._edges.add_edge(space.coordinate_prior, vertices, measured, noise, "fixes", topic)
        if not axes:
            metres = n if m.kind in ("pose", "position") else 0
            noise = edge_noise(self._counters, topic, compensated.covariance, metres)
            self._edges.add_edge(space.fixes[m.kind], vertices, compensated.measured, noise, "fixes", topic)
        self._counters.used[topic] += 1

    def closure(self, m: Closure, earlier: PoseAtStamp, later: PoseAtStamp) -> None:
        """Add a closure between two keyframes."""
        if earlier.keyframe == later.keyframe:
            self._counters.count(m.topic, "within_one_keyframe")
            return
        compensated = motion_compensation.closure(self._space, m, earlier, later)
        noise, vertices = self._noise(m.topic, compensated.covariance), [earlier.vertex, later.vertex]
        self._edges.add_edge(self._space.relative_pose, vertices, compensated.measured, noise, "closures", m.topic)
        self._counters.used[m.topic] += 1

    def _noise(self, source: str, covariance: Array) -> Gaussian:
        """The noise of a pose."""
        return edge_noise(self._counters, source, covariance, self._space.dimensions)
