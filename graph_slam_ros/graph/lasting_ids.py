"""Ids that last: the number of a row of a graph stays the same when rows before it are removed."""

import numpy as np

from graph_slam_ros.typing import Index


class LastingIds:
    """The lasting ids of the rows of a table, ascending. They are never used twice.

    Until rows are removed, the id of a row is its number. After that, the first rows have ids of their own, and those
    of all later ones follow one another.

    Attributes
    ----------
    early : (n,) ids of the first n rows
    later : the id of the row after these
    """

    __slots__ = ("early", "later")

    def __init__(self, early: Index | None = None, later: int = 0) -> None:
        self.early = np.empty(0, dtype=np.int64) if early is None else early
        self.later = later

    def of(self, row: int) -> int:
        """The id of a row."""
        count = len(self.early)
        return int(self.early[row]) if row < count else self.later + row - count

    def of_all(self, rows: Index) -> Index:
        """The ids of rows, (n,)."""
        count = len(self.early)
        out = rows + (self.later - count)
        is_early = rows < count
        out[is_early] = self.early[rows[is_early]]
        return out

    def find(self, lasting: int) -> int | None:
        """The row of an id; None where it was removed. The row of an id that comes later may not be there yet."""
        count = len(self.early)
        if lasting >= self.later:
            return count + lasting - self.later
        at = int(np.searchsorted(self.early, lasting))
        return at if at < count and self.early[at] == lasting else None

    def kept(self, rows: Index, count: int) -> "LastingIds":
        """The ids after all of so many rows were removed but some, which are given in order."""
        return LastingIds(self.of_all(rows), self.of(count))
