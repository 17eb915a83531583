"""TUM trajectories: ``stamp x y z qx qy qz qw``, seconds and metres."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se3

NS = 1_000_000_000


def tum_text(stamps_ns: Sequence[int], poses: NDArray[np.float64]) -> str:
    """Poses in the plane (n, 3) or in space (n, 7) as TUM lines; stamps keep their nanoseconds."""
    rows = zip(stamps_ns, se3.in_space(poses).tolist(), strict=True)
    return "".join(f"{_stamp(stamp)} {' '.join(map(repr, pose))}\n" for stamp, pose in rows)


def _stamp(stamp_ns: int) -> str:
    return f"{stamp_ns // NS}.{stamp_ns % NS:09d}"
