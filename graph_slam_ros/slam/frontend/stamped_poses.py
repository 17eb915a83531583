"""Poses with stamps, stored in columns: all of them are read as arrays, one of them as a record."""

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import numpy as np

from graph_slam_ros.graph.tables import Column
from graph_slam_ros.typing import Array, Index, Numbers

Instant = TypeVar("Instant")


class StampedPoses(Generic[Instant]):
    """Rows of an id, a stamp and a pose, in columns that grow.

    Parameters
    ----------
    record : makes the record of one instant of these three
    size : numbers of a pose
    """

    __slots__ = ("_id", "_pose", "_record", "_stamp_ns")

    def __init__(self, record: Callable[[int, int, Numbers], Instant], size: int) -> None:
        self._record = record
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

    def without(self, gone: Index) -> "StampedPoses[Instant]":
        """Return the same without some rows."""
        left = np.delete(np.arange(len(self)), gone)
        out = StampedPoses(self._record, self.poses.shape[1])
        columns = (out._id, self.ids), (out._stamp_ns, self.stamps_ns), (out._pose, self.poses)
        Column.extend(*((column, values[left], len(left)) for column, values in columns))
        return out

    def __len__(self) -> int:
        return len(self._id)

    def __getitem__(self, index: int) -> Instant:
        return self._record(int(self.ids[index]), int(self.stamps_ns[index]), tuple(self.poses[index].tolist()))

    def __iter__(self) -> Iterator[Instant]:
        return (self[k] for k in range(len(self)))
