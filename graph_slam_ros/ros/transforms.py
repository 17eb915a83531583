"""Static transforms between frames: where sensors sit on the robot."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def rotation_matrix(q: Any) -> Array:
    """(3, 3) from a unit quaternion message."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix(translation: Any, rotation: Any) -> Array:
    """(4, 4) from a translation or position message and a unit quaternion message."""
    out = np.eye(4)
    out[:3, :3] = rotation_matrix(rotation)
    out[:3, 3] = translation.x, translation.y, translation.z
    return out


class StaticTransforms:
    """What /tf_static has said so far."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, Array]] = {}

    def add(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Take one transform; a later one for the same child replaces it."""
        self._parent[child] = (parent, T_parent_child)

    def lookup(self, target: str, source: str) -> Array | None:
        """``T_target_source`` (4, 4), or None where the frames are not linked."""
        to_root_target, to_root_source = self._to_root(target), self._to_root(source)
        for frame, T_frame_source in to_root_source.items():
            if frame in to_root_target:
                linked: Array = np.linalg.inv(to_root_target[frame]) @ T_frame_source
                return linked
        return None

    def _to_root(self, frame: str) -> dict[str, Array]:
        """``T_ancestor_frame`` of the frame itself and each ancestor, nearest first."""
        out = {frame: np.eye(4)}
        at, T_at_frame = frame, np.eye(4)
        while at in self._parent:
            at, T_parent_at = self._parent[at]
            if at in out:  # a loop
                break
            T_at_frame = T_parent_at @ T_at_frame
            out[at] = T_at_frame
        return out
