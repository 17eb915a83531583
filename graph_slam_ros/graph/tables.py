"""The records of a graph as growing columns, and views of them: some edges of one type, one edge, one vertex."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.graph import records
from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.records import address_of
from graph_slam_ros.graph.vertices import VertexKind
from graph_slam_ros.typing import Array, Index


class Column:
    """An array that grows at its end.

    Attributes
    ----------
    count : rows so far; room : rows that it can have before it moves in memory
    """

    __slots__ = ("_buffer", "_values", "count", "room")

    def __init__(self, dtype: type, *shape: int) -> None:
        self.__setstate__(np.empty((0, *shape), dtype=dtype))

    def __getstate__(self) -> NDArray[Any]:
        return self.values

    def __setstate__(self, values: NDArray[Any]) -> None:
        self._buffer: NDArray[Any] = values
        self._values: NDArray[Any] = values[:]
        self.count = self.room = len(values)

    def __len__(self) -> int:
        return self.count

    @property
    def values(self) -> NDArray[Any]:
        """The rows so far, a view; setting it replaces all rows."""
        if len(self._values) != self.count:
            self._values = self._buffer[: self.count]
        return self._values

    @values.setter
    def values(self, rows: NDArray[Any]) -> None:
        self.__setstate__(rows)

    def kept(self, rows: Index) -> "Column":
        """Some of its rows, as a column of their own."""
        out = Column(self.values.dtype.type)
        out.__setstate__(self.values[rows])
        return out

    @property
    def address(self) -> int:
        """The place in memory where it begins."""
        return address_of(self._buffer)

    @staticmethod
    def extend(*parts: tuple["Column", ArrayLike, int]) -> None:
        """Append rows to columns, as many to each (one row, or a scalar, is repeated): to all columns, or to none.

        Half a record would shift all later ones.
        """
        for column, rows, count in parts:
            begin = column.count
            end = begin + count
            column.lengthen(end)
            # beyond the end, where nothing is visible yet; a number alone takes a tenth of the time
            column._buffer[begin if isinstance(rows, int | float) and count == 1 else slice(begin, end)] = rows
        for column, _, count in parts:
            column.count += count

    def lengthen(self, rows: int) -> None:
        """Make room for at least so many rows."""
        if rows <= self.room:
            return
        before = self.values
        grown = np.empty((max(rows, 16, 2 * self.room), *before.shape[1:]), dtype=before.dtype)
        grown[: len(before)] = before
        self._buffer, self._values, self.room = grown, grown[: len(before)], len(grown)


class EdgeTable:
    """All edges of one type, a row each.

    Attributes
    ----------
    code : its place among the graph's tables; width : degrees of freedom of all vertices of an edge
    id : edge ids; vertices : (n, k) vertex ids; measured : (n, p); sqrt_information : (n, m, m)
    label, source : codes into ``Graph.labels`` and ``Graph.sources``
    weight : a factor on the information, 0 = out of the problem
    pointers : where all of it is in memory, for compiled code (``records``)
    """

    def __init__(self, edge: EdgeType, code: int) -> None:
        self.type, self.code, self.width, m = edge, code, sum(edge.dofs), edge.residual_size
        self.id, self.vertices = Column(np.int64), Column(np.int64, len(edge.accepts))
        self.measured, self.sqrt_information = Column(np.float64, edge.measured_size), Column(np.float64, m, m)
        self.label, self.source, self.weight = Column(np.int64), Column(np.int64), Column(np.float64)
        of_edge = self.id, self.vertices, self.measured, self.sqrt_information
        self.columns = (*of_edge, self.label, self.source, self.weight)
        self.pointers = np.zeros(records.TABLE_COLUMNS, dtype=np.int64)
        self.pointers[records.ENDS : records.LINEARIZE] = len(edge.accepts), edge.measured_size, m, self.width
        self.locate()

    def __len__(self) -> int:
        return self.id.count

    def lengthen(self, rows: int) -> None:
        """Make room for at least so many rows."""
        try:
            for column in self.columns:
                column.lengthen(rows)
        finally:
            self.locate()

    def locate(self) -> None:
        """Note where the columns are, after they moved in memory."""
        for k, column in enumerate(self.columns):
            self.pointers[k] = column.address
        self.pointers[records.ROOM] = min(column.room for column in self.columns)

    def at(self, rows: Index) -> "EdgeRows":
        """Some rows, as arrays."""
        return EdgeRows(self, rows)


class EdgeRows:
    """Some of the edges of one type: ``ids``, and the columns of their table, copied when they are asked for."""

    __slots__ = ("rows", "table")

    def __init__(self, table: EdgeTable, rows: Index) -> None:
        self.table, self.rows = table, rows

    @property
    def ids(self) -> Index:
        """Edge ids, (n,)."""
        return self.table.id.values[self.rows]

    def __getattr__(self, column: str) -> NDArray[Any]:
        """These rows of a column of the table."""
        return getattr(self.table, column).values[self.rows]


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """One edge, copied out of the graph: what is done to it does not change the graph.

    Attributes
    ----------
    vertices : ids; measured : (p,); sqrt_information : (m, m)
    label : the class it is counted under; source : the input that measured it, or empty
    weight : a factor on the information at this time, 0 = out of the problem
    """

    id: int
    type: EdgeType
    vertices: tuple[int, ...]
    measured: Array
    sqrt_information: Array
    label: str
    source: str
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class Vertex:
    """One vertex, copied out of the graph: what is done to it does not change the graph.

    Attributes
    ----------
    initial : (size,), the value it was added with
    stored : where its numbers are in ``Graph.initial`` and ``Solver.values``
    """

    id: int
    kind: VertexKind
    initial: Array
    stored: slice


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
