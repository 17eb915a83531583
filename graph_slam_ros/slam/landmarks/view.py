"""Find what should be in view of a robot: what is nearer than something that it sees in about the same direction."""

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.typing import Array

FIT_M = 0.5
_SAME_DIRECTION_RAD = 0.3


def is_missing(in_base: Array, view: Array, points: Array, fit_m: float = FIT_M) -> NDArray[np.bool_]:
    """Return which of the landmarks should be seen and are not.

    Parameters
    ----------
    in_base : (..., L, n) where they should be seen, in the base frame [m]
    view : (V, n) what shows the field of view: what is nearer than a point in about the same direction is in view
    points : (P, n) what is seen
    fit_m : what is nearer to a landmark than this is the landmark
    """
    near, far = (np.linalg.norm(one, axis=-1) + 1e-9 for one in (in_base, view))
    is_in_view = (in_base / near[..., None]) @ (view / far[:, None]).T > np.cos(_SAME_DIRECTION_RAD)
    is_seen = np.linalg.norm(in_base[..., None, :] - points, axis=-1).min(axis=-1) < fit_m
    return np.asarray((is_in_view & (near[..., None] < far)).any(axis=-1) & ~is_seen)
