"""Keyframes that left the map, for closures that begin at them. They are in a temporary file, not in memory."""

import tempfile
from typing import IO

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph.geometry import Geometry

Records = NDArray[np.void]
NOWHERE = -1
"""Base of a keyframe that no closure can begin at."""


def attached_type(space: Geometry) -> np.dtype[np.void]:
    """Return the type of a row: how a keyframe is joined to the graph.

    ``base``, the lasting id of a vertex, ``T_base``, the keyframe's pose relative to it, and ``covariance``, (dof, dof)
    of that in its tangent space.
    """
    pose, covariance = (space.pose.size,), (space.dof, space.dof)
    return np.dtype([("base", "<i8"), ("T_base", "<f8", pose), ("covariance", "<f8", covariance)])


class AttachedKeyframes:
    """Rows of keyframes that left the map, in order of their numbers.

    Each has ``stamp_ns``, ``T_odom``, the pose by odometry, and the columns of ``attached_type``.

    Attributes
    ----------
    first, end : numbers of the first keyframe, and of that after the last
    """

    def __init__(self, first: int = 0) -> None:
        self._file: IO[bytes] | None = None
        self._kind: np.dtype[np.void] = np.dtype([("stamp_ns", "<i8")])
        self.first = self.end = first

    def add(self, space: Geometry, first: int, keyframes: Records, attached: Records) -> None:
        """Add the rows of keyframes; those that do not follow on the others take their place.

        Parameters
        ----------
        first : number of the first of them
        keyframes : rows of ``removed.record_type``; attached : of ``attached_type``

        Raises
        ------
        OSError
            They cannot be written. Those before them can still be read.
        """
        if self._file is None:
            self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  it lives as long as this
            pose = ("<f8", (space.pose.size,))
            self._kind = np.dtype([("stamp_ns", "<i8"), ("T_odom", *pose), *attached_type(space).descr])
        if first != self.end:
            self.first = first
        rows = np.zeros(len(keyframes), self._kind)
        for of in (keyframes[["stamp_ns", "T_odom"]], attached):
            for name in of.dtype.names or ():
                rows[name] = of[name]
        self._file.seek((first - self.first) * self._kind.itemsize)
        if self._file.write(rows.tobytes()) != rows.nbytes:
            raise OSError("the disk of temporary files is full")
        self.end = first + len(rows)

    def read(self, number: int) -> np.void:
        """Return the row of a keyframe."""
        if self._file is None or not self.first <= number < self.end:
            raise IndexError(f"keyframe {number} is not among {self.first} to {self.end - 1}")
        size = self._kind.itemsize
        self._file.seek((number - self.first) * size)
        return np.void(np.frombuffer(self._file.read(size), self._kind)[0])

    def before(self, stamp_ns: int, since: int) -> int | None:
        """Return the number of the last keyframe at or before a stamp; None if there is none.

        Parameters
        ----------
        since : number of the first keyframe that counts: stamps ascend from it on
        """
        low, high = max(since, self.first), self.end
        if low >= high or int(self.read(low)["stamp_ns"]) > stamp_ns:
            return None
        while high - low > 1:
            middle = (low + high) // 2
            if int(self.read(middle)["stamp_ns"]) <= stamp_ns:
                low = middle
            else:
                high = middle
        return low
