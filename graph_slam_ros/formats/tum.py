"""TUM trajectories: ``stamp x y z qx qy qz qw``, seconds and metres."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NS = 1_000_000_000


def tum_text(stamps_ns: Sequence[int], poses: NDArray[np.float64]) -> str:
    """Poses in the plane (n, 3) or in space (n, 7) as TUM lines; stamps keep their nanoseconds."""
    if poses.shape[1] == 7:
        rows = zip(stamps_ns, poses.tolist(), strict=True)
        return "".join(f"{_stamp(stamp)} {' '.join(map(repr, pose))}\n" for stamp, pose in rows)
    half = 0.5 * poses[:, 2]
    columns = zip(stamps_ns, poses.tolist(), np.sin(half).tolist(), np.cos(half).tolist(), strict=True)
    return "".join(f"{_stamp(stamp)} {x!r} {y!r} 0 0 0 {z!r} {w!r}\n" for stamp, (x, y, _), z, w in columns)


def _stamp(stamp_ns: int) -> str:
    return f"{stamp_ns // NS}.{stamp_ns % NS:09d}"
