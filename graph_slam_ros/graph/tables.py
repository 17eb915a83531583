"""The records of a graph as growing columns, and views of them: some edges of one type, one edge, one vertex."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import records
from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.records import address_of
from graph_slam_ros.graph.vertices import VertexKind
from graph_slam_ros.typing import Array, Index

_INT64 = np.dtype(np.int64)


class Column:
    """An array that grows at its end.

    Attributes
    ----------
    count : rows so far; room : rows that it can have before it moves in memory
    """

    __slots__ = ("_buffer", "_values", "count", "room")

    def __init__(self, dtype: DTypeLike, *shape: int) -> None:
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
    edge_row : of each edge, its place in the graph; vertex_rows : (n, k) those of its vertices
    measured : (n, p); sqrt_information : (n, m, m)
    label, source : codes into ``Graph.labels`` and ``Graph.sources``
    weight : a factor on the information, 0 = out of the problem
    pointers : where all of it is in memory, for compiled code (``records``)
    vertex_ids, edge_ids : as of ``Graph``
    """

    def __init__(self, edge: EdgeType, code: int, vertex_ids: "LastingIds", edge_ids: "LastingIds") -> None:
        self.vertex_ids, self.edge_ids = vertex_ids, edge_ids
        self.type, self.code, self.width, m = edge, code, sum(edge.dofs), edge.residual_size
        self.edge_row, self.vertex_rows = Column(np.int64), Column(np.int64, len(edge.accepts))
        self.measured, self.sqrt_information = Column(np.float64, edge.measured_size), Column(np.float64, m, m)
        self.label, self.source, self.weight = Column(np.int64), Column(np.int64), Column(np.float64)
        of_edge = self.edge_row, self.vertex_rows, self.measured, self.sqrt_information
        self.columns = (*of_edge, self.label, self.source, self.weight)
        self.pointers = np.zeros(records.TABLE_COLUMNS, dtype=np.int64)
        self.pointers[records.ENDS : records.LINEARIZE] = len(edge.accepts), edge.measured_size, m, self.width
        self.locate()

    def __len__(self) -> int:
        return self.edge_row.count

    @property
    def ids(self) -> Index:
        """Edge ids, (n,)."""
        return self.edge_ids.of_all(self.edge_row.values)

    @property
    def vertices(self) -> Index:
        """Vertex ids, (n, k)."""
        return self.vertex_ids.of_all(self.vertex_rows.values)

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

    def at(self, rows: Index | int) -> "EdgeRows":
        """Some rows, as arrays."""
        return EdgeRows(self, rows)


class EdgeRows:
    """Some of the edges of one type: their ids, and the columns of their table, copied when they are asked for."""

    __slots__ = ("rows", "table")

    def __init__(self, table: EdgeTable, rows: Index | int) -> None:
        self.table, self.rows = table, rows

    @property
    def ids(self) -> Index:
        """Edge ids, (n,)."""
        return self.table.edge_ids.of_all(self.table.edge_row.values[self.rows])

    @property
    def vertices(self) -> Index:
        """Vertex ids, (n, k)."""
        return self.table.vertex_ids.of_all(self.table.vertex_rows.values[self.rows])

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
    """The ids of vertices or edges, which have a row each: they ascend, last and are never used twice.

    Until rows are removed, the id of a row is its number. After that, the first rows have ids of their own, and those
    of all later ones follow one another.

    Attributes
    ----------
    early : (n,) ids of the first n rows; row_of : those rows, by id
    later : the id of the row after these
    shift : from there on, the difference between an id and its row
    """

    __slots__ = ("_column", "_what", "early", "later", "row_of", "shift")

    def __init__(self, what: str, column: Column) -> None:
        self._what, self._column = what, column
        self.put(np.empty(0, dtype=np.int64), 0)

    def put(self, early: Index, later: int) -> None:
        """Give the rows other ids, because others are removed, or all are read from a file."""
        self.early, self.later, self.shift = early, later, later - len(early)
        self.row_of = {one: row for row, one in enumerate(early.tolist())}

    @property
    def next(self) -> int:
        """The id that the next one gets: all are below it."""
        return self._column.count + self.shift

    def since(self, first: int = 0, end: int | None = None) -> Index:
        """All from one on, or up to another, in order."""
        last = self._column.count if end is None else self.first_from(end)
        return self.of_all(np.arange(self.first_from(first), last))

    def has(self, one: int) -> bool:
        """Return whether there is one of this id, which was not removed."""
        return 0 <= self.row(one) < self._column.count

    def of(self, row: int) -> int:
        """The id of a row."""
        return row + self.shift if not self.later or row >= len(self.early) else int(self.early[row])

    def of_all(self, rows: Index) -> Index:
        """The ids of rows, of any shape."""
        if not self.later:
            return rows
        out, is_early = rows + self.shift, rows < len(self.early)
        if is_early.any():
            out[is_early] = self.early[rows[is_early]]
        return out

    def row(self, one: int) -> int:
        """The row of an id; -1 where it was removed."""
        return one - self.shift if one >= self.later else self.row_of.get(one, -1)

    def rows(self, ids: Index) -> Index:
        """The rows of ids, of any shape; -1 where one was removed."""
        if not self.later:
            return ids
        out, is_early = ids - self.shift, ids < self.later
        if is_early.any():
            out[is_early] = [self.row_of.get(one, -1) for one in ids[is_early].tolist()]
        return out

    def existing(self, ids: ArrayLike) -> Index:
        """The rows of ids, (n,); a GraphSlamError where one does not exist."""
        given = whole_numbers(ids, self._what).ravel()
        rows = self.rows(given)
        strange = rows.view(np.uint64) >= self._column.count  # negative ones, too
        if strange.any():
            raise GraphSlamError(f"{self._what} {int(given[strange][0])} does not exist")
        return rows

    def first_from(self, one: int) -> int:
        """The first row whose id is not below one."""
        return one - self.shift if one >= self.later else int(self.early.searchsorted(one))


def whole_numbers(ids: ArrayLike, what: str) -> Index:
    """Return ids as an array. Numbers with a fraction are refused."""
    given = np.asarray(ids)
    if given.dtype is _INT64:
        return given
    if given.dtype.kind not in "iu" and given.size:
        raise GraphSlamError(f"{what}: ids must be whole numbers, got {given.ravel()[:5].tolist()}")
    return given.astype(np.int64, copy=False)
