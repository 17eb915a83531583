"""Odometry between the keyframes, in its own frame: kept for trial fits of a calibration."""

from array import array
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.typing import Array, Index, Numbers

_SAMPLED_NS = 50_000_000


@dataclass(frozen=True, slots=True)
class OdometryTrack:
    """Odometry in its own frame, as its driver reports it.

    Attributes
    ----------
    keyframes : (n, size) at each keyframe
    stamps_ns, poses : (m,), (m, size) samples between them
    distance, turn : the factors that correct it
    """

    keyframes: Array
    stamps_ns: Index
    poses: Array
    distance: float = 1.0
    turn: float = 1.0


class OdometrySamples:
    """Samples of odometry: at most twenty a second, none at rest."""

    def __init__(self, space: Geometry) -> None:
        self._space = space
        self.forget()

    def forget(self) -> None:
        """Start over, for stamps of another time."""
        self._stamps_ns, self._poses = array("q"), array("d")
        self._last: Step | None = None
        self._kept_ns, self._there = 0, self._space.identity  # of the newest that is kept

    def forget_before(self, stamp_ns: int) -> None:
        """Forget the samples before a stamp."""
        first = int(np.searchsorted(self._stamps_ns, stamp_ns))
        del self._stamps_ns[:first], self._poses[: first * self._space.pose.size]

    def add(self, step: Step) -> None:
        """Keep a step if the next sample is due, and the one before where the robot begins to move."""
        last, self._last = self._last, step
        if last is not None:
            if step.stamp_ns - self._kept_ns < _SAMPLED_NS or step.T_odom_base == self._there:
                return
            if last.stamp_ns > self._kept_ns and last.T_odom_base == self._there:
                self._keep(last.stamp_ns, self._there)
        self._keep(step.stamp_ns, step.T_odom_base)
        self._kept_ns, self._there = step.stamp_ns, step.T_odom_base

    def _keep(self, stamp_ns: int, T_odom_base: Numbers) -> None:
        del self._poses[len(self._stamps_ns) * self._space.pose.size :]  # of one that there was no memory for
        self._poses.extend(T_odom_base)
        self._stamps_ns.append(stamp_ns)

    def track(self, keyframes: Array, factors: tuple[float, float]) -> OdometryTrack:
        """Return copies of all samples, with odometry at the keyframes and the factors of distance and turn."""
        stamps_ns, size = np.array(self._stamps_ns, dtype=np.int64), self._space.pose.size
        poses = np.array(self._poses)[: len(stamps_ns) * size].reshape(-1, size)
        return OdometryTrack(keyframes.copy(), stamps_ns, poses, *factors)
