"""The pose of the robot in the map at each odometry message, extrapolated from the last estimate without a solve."""

from collections import deque
from dataclasses import replace
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.node.estimate import Estimate
from graph_slam_ros.slam.frontend.odometry_integration import IntegratedOdometry, OdometryNoise, StationaryDetector
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector, Step
from graph_slam_ros.typing import Numbers

_MOST = 2_000  # messages since the newest keyframe: of a robot that stands there are many


class PoseExtrapolator:
    """The last estimate composed with the odometry since then. Its covariance grows accordingly.

    A jump of odometry is no motion: there is no pose until an estimate has a keyframe after it.
    """

    def __init__(self, config: Config) -> None:
        self._space, self._noise = config.space, OdometryNoise(config.odometry, config.space)
        self._selector = OdometrySelector(config.odometry, [], config.space, Counters())
        self._since: deque[Step] = deque(maxlen=_MOST)
        self._estimate: Estimate | None = None
        self._motion: IntegratedOdometry | None = None
        self._last: Numbers = self._space.identity
        self._jumped_ns = 0  # stamp of a jump that no estimate has yet; 0: there is none

    @property
    def newest(self) -> Step | None:
        """The newest odometry of the source in use; None also after a jump that no estimate has yet."""
        return self._since[-1] if self._since and not self._jumped_ns else None

    @property
    def source(self) -> str:
        """The odometry in use; empty before the first."""
        return self._selector.used.source if self._selector.used else ""

    def on_odometry(self, m: Odometry, estimate: Estimate | None) -> bool:
        """Add an odometry message. Return whether there is a pose at it: it is newer, and of the source in use."""
        used = self._selector.used
        if estimate is not None and estimate.source != m.source:
            return False
        if used is not None and m.source == used.source and m.stamp_ns <= used.stamp_ns:
            return False
        if used is not None and m.source != used.source:
            self._selector.forget()
        (step,) = self._selector.steps(m)
        if step.broken:
            self._since.clear()
            self._jumped_ns = m.stamp_ns
        elif estimate is not None and estimate.stamp_ns >= self._jumped_ns:
            self._jumped_ns = 0
        self._since.append(step)
        return not self._jumped_ns

    def forget(self) -> None:
        """Begin anew with the stamps or the map."""
        self._since.clear()
        self._selector.forget()
        self._jumped_ns = 0
        self._estimate = self._motion = None

    def pose(self, estimate: Estimate) -> tuple[Numbers, NDArray[np.float64]]:
        """``T_map_base`` at the newest odometry and its covariance in its tangent space."""
        group = self._space.group
        if estimate is not self._estimate or self._motion is None:
            self._estimate, self._last = estimate, estimate.T_odom_keyframe
            self._motion = IntegratedOdometry(
                self._noise, self._space, 0, estimate.stamp_ns, StationaryDetector(self._noise, self._space)
            )
            while len(self._since) > 1 and self._since[0].stamp_ns <= estimate.stamp_ns:
                self._since.popleft()
        at_ns = self._motion.now.stamp_ns
        for step in reversed(list(takewhile(lambda step: step.stamp_ns > at_ns, reversed(self._since)))):
            self._motion.step(replace(step, T_last_base=group.between(self._last, step.T_odom_base)))
            self._last = step.T_odom_base
        moved = self._motion.now
        T_map_keyframe = group.compose(estimate.T_map_odom, estimate.T_odom_keyframe)
        covariance = group.propagate(estimate.covariance, moved.T_keyframe_base, moved.covariance)
        return group.compose(T_map_keyframe, moved.T_keyframe_base), covariance
