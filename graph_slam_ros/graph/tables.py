"""The records of a graph as growing columns, and views of them: some edges of one type, one edge, one vertex."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.graph import records
from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.vertices import VertexKind
from graph_slam_ros.lie.addresses import address_of
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
        """The rows so far, a view."""
        if len(self._values) != self.count:
            self._values = self._buffer[: self.count]
        return self._values

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


@dataclass(slots=True, eq=False)
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

    type: EdgeType
    code: int
    pointers: Index = field(init=False)
    columns: tuple[Column, ...] = field(init=False)
    width: int = field(init=False)
    id: Column = field(init=False)
    vertices: Column = field(init=False)
    measured: Column = field(init=False)
    sqrt_information: Column = field(init=False)
    label: Column = field(init=False)
    source: Column = field(init=False)
    weight: Column = field(init=False)

    def __post_init__(self) -> None:
        m = self.type.residual_size
        self.width = sum(self.type.dofs)
        self.id = Column(np.int64)
        self.vertices = Column(np.int64, len(self.type.accepts))
        self.measured = Column(np.float64, self.type.measured_size)
        self.sqrt_information = Column(np.float64, m, m)
        self.label, self.source = Column(np.int64), Column(np.int64)
        self.weight = Column(np.float64)
        self.columns = (
            *(self.id, self.vertices, self.measured, self.sqrt_information),
            *(self.label, self.source, self.weight),
        )
        self.pointers = np.zeros(records.TABLE_COLUMNS, dtype=np.int64)
        sizes = len(self.type.accepts), self.type.measured_size, m, self.width
        self.pointers[records.ENDS : records.LINEARIZE] = sizes
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


@dataclass(frozen=True, slots=True, eq=False)
class EdgeRows:
    """Some of the edges of one type, as arrays that are copied when they are asked for."""

    table: EdgeTable
    rows: Index

    @property
    def ids(self) -> Index:
        """Edge ids, (n,)."""
        return self.table.id.values[self.rows]

    @property
    def vertices(self) -> Index:
        """Vertex ids, (n, k)."""
        return self.table.vertices.values[self.rows]

    @property
    def measured(self) -> Array:
        """Measurements, (n, p)."""
        return self.table.measured.values[self.rows]

    @property
    def sqrt_information(self) -> Array:
        """Square root information matrices, (n, m, m)."""
        return self.table.sqrt_information.values[self.rows]

    @property
    def label(self) -> Index:
        """Codes into ``Graph.labels``, (n,)."""
        return self.table.label.values[self.rows]

    @property
    def source(self) -> Index:
        """Codes into ``Graph.sources``, (n,)."""
        return self.table.source.values[self.rows]

    @property
    def weight(self) -> Array:
        """Factors on the information, (n,)."""
        return self.table.weight.values[self.rows]


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
