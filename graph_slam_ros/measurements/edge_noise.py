"""The noise of an edge from a propagated covariance, with a lower bound; rounding errors are repaired and counted."""

import numpy as np

from graph_slam_ros.errors import NoiseError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.typing import Array

LEAST_M2, LEAST_RAD2 = 1e-8, 1e-10  # 0.1 mm, 0.01 mrad
_FINEST = 1e-6  # of a distance: a lever arm of a million standard deviations is as much as a solve resolves
_LEAST_EIGENVALUE = 1e-9  # of the largest, where rounding has left a covariance indefinite


def edge_noise(counters: Counters, source: str, covariance: Array, metres: int, distance_m: float = 0.0) -> Gaussian:
    """Return the noise of an edge. Call it before anything is added to the graph, so that nothing fails half-way.

    Parameters
    ----------
    covariance : (m, m); its first ``metres`` rows are lengths, the others angles
    distance_m : distance of what was measured; the standard deviation is at least a millionth of it
    """
    least_m2 = max(LEAST_M2, (_FINEST * distance_m) ** 2)
    least = covariance + np.diag([least_m2] * metres + [LEAST_RAD2] * (len(covariance) - metres))
    try:
        return Gaussian.from_covariance(least)
    except NoiseError:  # of extreme numbers: a kilometre's lever arm, an hour's motion in one step
        counters.count(source, "covariance_floored")
        values, vectors = np.linalg.eigh(0.5 * (least + least.T))
        floored = np.maximum(values, _LEAST_EIGENVALUE * values[-1])
        return Gaussian.from_covariance((vectors * floored) @ vectors.T)
