"""The noise that a slip adds to edges of odometry."""

import numpy as np

from graph_slam_ros.config.frontend import OdometryConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array

_LASTS_S = 0.5  # correlation time of the errors of a slip
_LONGEST_S = 1.0  # of one edge; wheels that stand longer do not slip: the robot was carried
_SHARED = 0.5  # sigma of the fraction of the motion that is lost in the whole stretch
_OTHERS = 1.0 / 3.0  # sigma along the other axes, relative to the first


class SlipNoise:
    """Noise by the kind of slip: ``translation`` or ``rotation``."""

    def __init__(self, space: Geometry, config: OdometryConfig) -> None:
        self._space, self._config = space, config

    def variances(self, kind: str, seconds: float) -> Array:
        """Variances (dof,) that are added to an edge that lasts so long."""
        n, seconds = self._space.dimensions, min(seconds, _LONGEST_S)
        sigmas = np.zeros(self._space.dof)
        if kind == "translation":
            sigmas[:n] = self._config.doubt_m_s * seconds * _OTHERS
            sigmas[0] = self._config.doubt_m_s * seconds
        else:
            sigmas[n:] = self._config.doubt_rad_s * seconds * _OTHERS
            sigmas[-1] = self._config.doubt_rad_s * seconds
        return np.asarray(sigmas**2 * max(1.0, _LASTS_S / max(seconds, 1e-9)))

    def shared(self, kind: str, measured: Array) -> Array:
        """Sigmas (dof,) of the error that all edges of a slip share, of one that measured so much."""
        space, out = self._space, np.zeros(self._space.dof)
        motion = np.asarray(space.group.local(space.identity, tuple(measured.tolist())), dtype=float)
        of_kind = slice(space.dimensions) if kind == "translation" else slice(space.dimensions, None)
        out[of_kind] = _SHARED * motion[of_kind]
        return out
