"""The noise that a slip adds to edges of odometry."""

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array

_SLIP_M_S, _SLIP_RAD_S = 0.35, 0.35  # sigmas of what odometry does not notice: some of an indoor robot's speeds
_LASTS_S = 0.5  # correlation time of the errors of a slip
_LONGEST_S = 1.0  # of one edge; wheels that stand longer do not slip: the robot was carried
_OTHERS = 1.0 / 3.0  # sigma along the other axes, relative to the first


class SlipNoise:
    """Noise by the kind of slip: ``translation`` or ``rotation``."""

    def __init__(self, space: Geometry) -> None:
        self._space = space

    def variances(self, kind: str, seconds: float | Array) -> Array:
        """Variances (..., dof) that are added to edges that last so long (...)."""
        n, seconds = self._space.dimensions, np.minimum(seconds, _LONGEST_S)
        per_s = np.zeros(self._space.dof)
        if kind == "translation":
            per_s[:n] = _SLIP_M_S * _OTHERS
            per_s[0] = _SLIP_M_S
        else:
            per_s[n:] = _SLIP_RAD_S * _OTHERS
            per_s[-1] = _SLIP_RAD_S
        independent = np.maximum(1.0, _LASTS_S / np.maximum(seconds, 1e-9))
        return np.asarray((np.asarray(seconds)[..., None] * per_s) ** 2 * independent[..., None])
