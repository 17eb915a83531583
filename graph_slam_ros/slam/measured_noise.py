"""The noise of odometry and of all else as residuals so far show it, for tests of hypotheses on odometry."""

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses

_EVERY, _MORE = 100, 0.2  # keyframes since the last time, and as a part of those then: one measurement looks at all
_PRIOR_DOF = 20.0  # degrees of freedom that would say that odometry's noise is as stated
_LARGEST = 3.0
_UNKNOWN, _KNOWN = 1.5, 1.2  # all noise may be larger by this factor, where it is not measured and where it is


class MeasuredNoise:
    """Factors of noise, measured anew as the drive goes on.

    Attributes
    ----------
    of_odometry : (dof,) of its sigmas, at least 1
    of_all : of all sigmas
    """

    def __init__(self, space: Geometry, backend: Backend) -> None:
        self._space, self._backend = space, backend
        self._measured_at = -_EVERY
        self.of_odometry, self.of_all = np.ones(space.dof), _UNKNOWN

    def measure(self, keyframes: StampedPoses[Keyframe]) -> None:
        """Measure it, if there are many keyframes more than last time."""
        if len(keyframes) - self._measured_at < max(_EVERY, _MORE * self._measured_at):
            return
        self._measured_at, n = len(keyframes), self._space.dimensions
        parts = {"position": slice(n), "rotation": slice(n, None)}
        of_odometry, others = np.ones(self._space.dof), list[float]()
        for one in self._backend.noise_scale(keyframes, ("odometry", "landmarks")):
            if one.label == "odometry" and one.dof > 0.0:
                variance = (one.per_dof * one.dof + _PRIOR_DOF) / (one.dof + _PRIOR_DOF)
                factor = float(np.sqrt(np.clip(variance, 1.0, _LARGEST**2)))
                of_odometry[parts[one.part]] = np.maximum(of_odometry[parts[one.part]], factor)
            elif one.label == "landmarks" and not one.reason:
                others.append(one.factor)
        self.of_odometry = of_odometry
        self.of_all = _KNOWN * max([1.0, *others]) if others else _UNKNOWN
