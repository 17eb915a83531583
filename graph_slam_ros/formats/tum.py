"""TUM trajectories: ``stamp x y z qx qy qz qw``, seconds and metres."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

NS = 1_000_000_000


def tum_text(stamps_ns: Sequence[int], poses: NDArray[np.float64]) -> str:
    """Planar poses (n, 3) as TUM lines; stamps keep their nanoseconds."""
    half = 0.5 * poses[:, 2]
    columns = zip(stamps_ns, poses.tolist(), np.sin(half).tolist(), np.cos(half).tolist(), strict=True)
    return "".join(
        f"{stamp // NS}.{stamp % NS:09d} {x!r} {y!r} 0 0 0 {z!r} {w!r}\n" for stamp, (x, y, _), z, w in columns
    )
