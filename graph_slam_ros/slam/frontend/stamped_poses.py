"""Poses with stamps, stored in columns: all of them are read as arrays, one of them as a record."""

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import numpy as np

from graph_slam_ros.graph.tables import Column
from graph_slam_ros.typing import Array, Index, Numbers

Instant = TypeVar("Instant")


class StampedPoses(Generic[Instant]):
    """Rows of an id, a stamp and a pose, in columns that grow. The first of them may be forgotten.

    Rows are numbered from 0, and keep their number: ``len`` is how many there were. ``ids``, ``stamps_ns`` and
    ``poses`` begin with the row ``first``.

    Parameters
    ----------
    record : makes the record of one instant of these three
    size : numbers of a pose

    Attributes
    ----------
    first : the number of the first row that is there
    """

    __slots__ = ("_id", "_pose", "_record", "_stamp_ns", "first")

    def __init__(self, record: Callable[[int, int, Numbers], Instant], size: int, first: int = 0) -> None:
        self._record, self.first = record, first
        self._id, self._stamp_ns, self._pose = Column(np.int64), Column(np.int64), Column(np.float64, size)

    @property
    def ids(self) -> Index:
        """Id of each row: the vertex of a keyframe, or the keyframe of a sighting. A view."""
        return self._id.values

    @property
    def stamps_ns(self) -> Index:
        """Stamp of each, a view."""
        return self._stamp_ns.values

    @property
    def poses(self) -> Array:
        """Pose of each, (n, size), a view."""
        return self._pose.values

    def append(self, id_: int, stamp_ns: int, pose: Numbers) -> None:
        """Add a row."""
        Column.extend((self._id, id_, 1), (self._stamp_ns, stamp_ns, 1), (self._pose, pose, 1))

    def extend(self, ids: Index, stamps_ns: Index, poses: Array) -> None:
        """Add rows; the poses may be end to end."""
        count = len(ids)
        poses = poses.reshape(count, self.poses.shape[1])
        Column.extend((self._id, ids, count), (self._stamp_ns, stamps_ns, count), (self._pose, poses, count))

    def without(self, gone: Index) -> "StampedPoses[Instant]":
        """Return the same without some rows, by number."""
        return self._part(np.delete(np.arange(len(self.ids)), gone - self.first), self.first)

    def since(self, first: int) -> "StampedPoses[Instant]":
        """Return the rows from a number on."""
        return self._part(np.arange(first - self.first, len(self.ids)), first)

    def _part(self, rows: Index, first: int) -> "StampedPoses[Instant]":
        out = StampedPoses(self._record, self.poses.shape[1], first)
        out.extend(self.ids[rows], self.stamps_ns[rows], self.poses[rows])
        return out

    def __len__(self) -> int:
        return self.first + len(self._id)

    def __getitem__(self, number: int) -> Instant:
        row = number if number < 0 else number - self.first
        if row < 0 <= number:
            raise IndexError(f"row {number} was forgotten: the first is {self.first}")
        return self._record(int(self.ids[row]), int(self.stamps_ns[row]), tuple(self.poses[row].tolist()))

    def __iter__(self) -> Iterator[Instant]:
        return (self[k] for k in range(self.first, len(self)))
