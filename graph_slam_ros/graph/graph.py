"""The graph: append-only records of vertices and edges, kept as arrays."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graph_slam_ros.errors import GraphSlamError, NoiseError
from graph_slam_ros.graph.edge_type import EdgeType
from graph_slam_ros.graph.noise import Gaussian
from graph_slam_ros.graph.records import (
    FITS,
    ITSELF,
    LINEARIZE,
    MISSING,
    NOT_FINITE,
    address_of,
    append_edges,
    append_vertices,
    labels_of,
    weights_of,
)
from graph_slam_ros.graph.tables import Column, Edge, EdgeTable, LastingIds, Vertex, whole_numbers
from graph_slam_ros.graph.vertices import VertexKind
from graph_slam_ros.typing import Array, Index, Mask


class Graph:
    """Vertices with their initial values, and edges by type. Ids ascend, last and are never reused.

    Each record is a row, numbered from 0, of columns for the solver and compiled code. Until rows are removed
    (``keep``) the id of a row is its number.

    An estimate does not live here: the solver owns it.

    Attributes
    ----------
    kind : code of the kind of each row of a vertex, an index into ``kinds``
    offset : where it begins in ``initial``, the stored numbers of all vertices end to end
    table_of_edge, row_of_edge : of each row of an edge, its table (counted in the order of ``tables``) and row there
    pointers : where all of it is in memory, for compiled code (``records``)
    vertex_ids, edge_ids : of the rows
    """

    def __init__(self) -> None:
        self.kinds: list[VertexKind] = []
        self.kind = Column(np.int64)
        self.offset = Column(np.int64)
        self.initial = Column(np.float64)
        self.tables: dict[EdgeType, EdgeTable] = {}
        self._accepted: dict[EdgeType, Mask] = {}  # (slots, kinds): whether a slot takes a kind
        self._in_order: list[EdgeTable] = []
        self.labels: list[str] = []
        self.sources: list[str] = []
        self.table_of_edge = Column(np.int64)
        self.row_of_edge = Column(np.int64)
        self.vertex_ids, self.edge_ids = LastingIds("vertex", self.kind), LastingIds("edge", self.row_of_edge)
        self.locate()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        for table in self.tables.values():
            table.pointers[LINEARIZE] = 0  # it may be another process
            table.locate()
        self.locate()

    def __repr__(self) -> str:
        codes, counts = np.unique(self.kind.values, return_counts=True)
        kinds = [f"{n} {self.kinds[code].name}" for code, n in zip(codes.tolist(), counts.tolist(), strict=True)]
        labels = [f"{len(self.edges_of(label))} {label}" for label in self.labels]
        vertices = f"{self.vertex_count} vertices" + (f": {', '.join(kinds)}" if kinds else "")
        return f"Graph({vertices}; {self.edge_count} edges" + (f": {', '.join(labels)})" if labels else ")")

    @property
    def vertex_count(self) -> int:
        """Number of vertices."""
        return self.kind.count

    @property
    def edge_count(self) -> int:
        """Number of edges."""
        return self.row_of_edge.count

    def kind_codes(self, vertices: Index) -> Index:
        """The kinds of vertices, as indices into ``kinds``."""
        return np.asarray(self.kind.values[self.vertex_ids.rows(vertices)])

    def begins(self, vertices: Index) -> Index:
        """Where the numbers of vertices begin among the stored numbers of all."""
        return np.asarray(self.offset.values[self.vertex_ids.rows(vertices)])

    def add_vertices(self, kind: VertexKind, values: ArrayLike) -> Index:
        """Add n vertices with initial values (n, size), or (n,) where one number is stored; returns their ids."""
        rows = np.asarray(values, dtype=float)
        if rows.ndim == 1 and kind.size == 1:
            rows = rows[:, None]
        if rows.shape != (len(rows) if rows.ndim else 0, kind.size):
            raise GraphSlamError(f"{kind.name}: values of shape {rows.shape}, not (n, {kind.size})")
        count, first, numbers = len(rows), self.kind.count, self.initial.count
        if first + count > self.kind.room or numbers + rows.size > self.initial.room:
            vertices = (self.kind, first + count), (self.offset, first + count)
            self._lengthen(*vertices, (self.initial, numbers + rows.size))
        code = _code(self.kinds, kind)
        unfit = append_vertices(self.pointers, first, numbers, _plain(rows), code)
        if unfit >= 0 or kind.holds is not None:
            fault = kind.fault(rows)
            if fault is not None:
                row, why = fault
                raise GraphSlamError(f"initial value {rows[row].tolist()} of vertex {self.vertex_ids.next + row} {why}")
        if code == len(self.kinds):
            self.kinds.append(kind)
        self.initial.count += rows.size
        new = self.vertex_ids.next
        self.kind.count = self.offset.count = first + count
        return np.arange(new, new + count)

    def add_vertex(self, kind: VertexKind, value: ArrayLike) -> int:
        """Add one vertex with its initial value (size,); returns its id."""
        return int(self.add_vertices(kind, np.asarray(value, dtype=float)[None])[0])

    def add_edges(
        self, edge: EdgeType, vertices: ArrayLike, measured: ArrayLike, noise: Gaussian, label: str, source: str = ""
    ) -> Index:
        """Add n edges of one type; returns their ids.

        Parameters
        ----------
        vertices : (n, k) ids of existing vertices of the kinds the edge type accepts
        measured : (n, p), finite; its tail may be left out
        noise : one for all, or n
        label : the class an edge is counted under, e.g. ``odometry``
        source : the input that measured it
        """
        ids, z = whole_numbers(vertices, edge.name), edge.whole(measured)
        at = self.vertex_ids.rows(ids)
        if z.ndim != 2 or z.shape[1] != edge.measured_size or at.shape != (len(z), len(edge.accepts)):
            self._refuse_shapes(edge, ids, z)
        if not isinstance(noise, Gaussian):
            hint = "Gaussian.from_sigmas, from_covariance or from_information makes one"
            raise NoiseError(f"{edge.name}: noise is a {type(noise).__name__}, not a Gaussian: {hint}")
        shape, count = noise.sqrt_information.shape, len(at)
        if shape[-1] != edge.residual_size or (len(shape) == 3 and shape[0] != count):
            raise GraphSlamError(f"{edge.name}: noise of shape {shape} does not fit")
        table = self.tables.get(edge)
        if table is None:
            table = EdgeTable(edge, len(self.tables), self.vertex_ids, self.edge_ids)
        first, row = self.row_of_edge.count, len(table)
        if row + count > table.edge_row.room:
            table.lengthen(row + count)
        if first + count > self.row_of_edge.room:
            self._lengthen((self.table_of_edge, first + count), (self.row_of_edge, first + count))
        there = self.kind.count, first, row
        codes = table.code, _code(self.labels, label), _code(self.sources, source)
        given = _plain(at), _plain(z), _plain(np.asarray(noise.sqrt_information, dtype=np.float64).ravel())
        fault, *where = append_edges(self.pointers, table.pointers, there, *given, self._accepted_by(edge), codes)
        if fault != FITS:
            self._refuse_unfit(edge, ids, z, fault, *where)
        if codes[0] == len(self.tables) or codes[1] == len(self.labels) or codes[2] == len(self.sources):
            self._register(table, label, source)
        for column in table.columns:
            column.count = row + count
        new = self.edge_ids.next
        self.table_of_edge.count = self.row_of_edge.count = first + count
        return np.arange(new, new + count)

    def add_edge(
        self, edge: EdgeType, vertices: ArrayLike, measured: ArrayLike, noise: Gaussian, label: str, source: str = ""
    ) -> int:
        """Add one edge, of (k,) vertices and what was measured (p,); returns its id."""
        one = np.asarray(vertices)[None], np.asarray(measured, dtype=float)[None]
        return int(self.add_edges(edge, *one, noise, label, source)[0])

    def kind_of(self, vertex: int) -> VertexKind:
        """The kind of one vertex."""
        return self.kinds[self.kind.values[self.vertex_ids.row(vertex)]]

    def vertex(self, vertex_id: int) -> Vertex:
        """One vertex, by its id; a GraphSlamError where there is none."""
        (row,) = self.vertex_ids.existing([vertex_id]).tolist()
        kind, begin = self.kinds[self.kind.values[row]], int(self.offset.values[row])
        stored = slice(begin, begin + kind.size)
        return Vertex(vertex_id, kind, self.initial.values[stored].copy(), stored)

    def edge(self, edge_id: int) -> Edge:
        """One edge, by its id; a GraphSlamError where there is none."""
        if type(edge_id) is not int or not self.edge_ids.has(edge_id):
            self.edge_ids.existing([edge_id])
        table, row = self.row(edge_id)
        return Edge(
            edge_id,
            table.type,
            tuple(map(self.vertex_ids.of, table.vertex_rows.values[row].tolist())),
            table.measured.values[row].copy(),
            table.sqrt_information.values[row].copy(),
            self.labels[table.label.values[row]],
            self.sources[table.source.values[row]],
            float(table.weight.values[row]),
        )

    def row(self, edge_id: int) -> tuple[EdgeTable, int]:
        """The table of an edge, and its row there."""
        row = self.edge_ids.row(edge_id)
        return self._in_order[self.table_of_edge.values[row]], int(self.row_of_edge.values[row])

    def places(self, edges: Index) -> tuple[Index, Index]:
        """The table of each edge, counted in the order of ``tables``, and its row there."""
        rows = self.edge_ids.rows(edges)
        return self.table_of_edge.values[rows], self.row_of_edge.values[rows]

    def by_table(self, edges: Index) -> dict[EdgeTable, Index]:
        """Edges as rows of their tables."""
        return self.rows_by_table(self.edge_ids.rows(edges))

    def rows_by_table(self, edges: Index) -> dict[EdgeTable, Index]:
        """The same of edges by their rows."""
        rows: Index = self.row_of_edge.values[edges]
        if len(edges) == 1:
            return {self._in_order[self.table_of_edge.values[edges[0]]]: rows}
        if len(self.tables) == 1:
            return dict.fromkeys(self.tables.values(), rows)
        codes = self.table_of_edge.values[edges]
        by_table = ((table, rows[codes == code]) for code, table in enumerate(self._in_order))
        return {table: of_table for table, of_table in by_table if len(of_table)}

    def ends_of(self, edge_id: int) -> tuple[int, ...]:
        """The vertices of an edge."""
        table, row = self.row(edge_id)
        return tuple(map(self.vertex_ids.of, table.vertex_rows.values[row].tolist()))

    def label_of(self, edge_id: int) -> str:
        """The class of an edge."""
        table, row = self.row(edge_id)
        return self.labels[int(table.label.values[row])]

    def source_of(self, edge_id: int) -> str:
        """The input that measured an edge; empty where none did."""
        table, row = self.row(edge_id)
        return self.sources[int(table.source.values[row])]

    def weights(self, edges: Index) -> Array:
        """The weights of some edges, (n,)."""
        return np.asarray(weights_of(self.pointers, self.edge_ids.existing(edges)))

    def set_weights(self, edges: Index, weight: float) -> None:
        """Set the weight of some edges. Where a solver has them, use ``Solver.set_weight``."""
        for table, rows in self.by_table(edges).items():
            table.weight.values[rows] = weight

    def copy(self) -> "Graph":
        """Another graph with the same records; kinds and types are the same objects."""
        same = (*self.tables, *self._accepted, *self.kinds, self.vertex_ids.row_of, self.edge_ids.row_of)
        return deepcopy(self, {id(one): one for one in same})

    def has_label(self, edges: Index, labels: Sequence[str]) -> NDArray[np.bool_]:
        """Return whether each of some edges is of one of these classes, (n,); a GraphSlamError where one is missing."""
        wanted = np.array([label in labels for label in self.labels], dtype=bool)
        rows = np.ascontiguousarray(self.edge_ids.existing(edges))  # compiled code does not look
        return np.asarray(wanted[labels_of(self.pointers, rows)])

    def edges_of(self, label: str) -> Index:
        """Ids of the edges of a class, in order."""
        if label not in self.labels:
            return np.empty(0, dtype=np.int64)
        found = [table.edge_row.values[table.label.values == self.labels.index(label)] for table in self._in_order]
        return self.edge_ids.of_all(np.sort(np.concatenate(found)))

    def keep(self, vertices: Index, edges: Index, values: Array) -> None:
        """Remove all but some vertices and edges, given in order. These vertices begin with other stored ``values``."""
        kept, kept_edges = self.vertex_ids.existing(vertices), self.edge_ids.existing(edges)
        self.vertex_ids.put(vertices, self.vertex_ids.next)
        self.edge_ids.put(edges, self.edge_ids.next)
        kinds = self.kind.values[kept]
        sizes = np.array([kind.size for kind in self.kinds], dtype=np.int64)[kinds]
        ends = np.cumsum(sizes)
        numbers = np.repeat(self.offset.values[kept] - (ends - sizes), sizes) + np.arange(int(sizes.sum()))
        self.kind.values, self.offset.values, self.initial.values = kinds, ends - sizes, values[numbers]
        rows_of = ((table, np.flatnonzero(np.isin(table.edge_row.values, kept_edges))) for table in self._in_order)
        found = sorted((int(table.edge_row.values[rows[0]]), table, rows) for table, rows in rows_of if len(rows))
        self.table_of_edge.values, self.row_of_edge.values = np.empty((2, len(edges)), dtype=np.int64)
        for code, (_, table, rows) in enumerate(found):  # as if it was added edge by edge
            for column in table.columns:
                column.values = column.values[rows]
            table.code, table.edge_row.values = code, np.searchsorted(kept_edges, table.edge_row.values)
            table.vertex_rows.values = np.searchsorted(kept, table.vertex_rows.values)
            self.table_of_edge.values[table.edge_row.values] = code
            self.row_of_edge.values[table.edge_row.values] = np.arange(len(rows))
            table.locate()
        self._in_order = [table for _, table, _ in found]
        self.tables = {table.type: table for table in self._in_order}
        self.locate()

    def _register(self, table: EdgeTable, label: str, source: str) -> None:
        if table.code == len(self.tables):
            self._in_order[table.code :] = [table]  # also where this was interrupted before
            self.tables[table.type] = table
            self.locate()
        for names, name in ((self.labels, label), (self.sources, source)):
            if name not in names:
                names.append(name)

    def _lengthen(self, *columns: tuple[Column, int]) -> None:
        try:
            for column, rows in columns:
                column.lengthen(rows)
        finally:
            self.locate()

    def locate(self) -> None:
        """Note where all columns are, after they moved in memory or a table was added."""
        columns = self.kind, self.offset, self.initial, self.table_of_edge, self.row_of_edge
        room = min(self.table_of_edge.room, self.row_of_edge.room)
        tables = (address_of(table.pointers) for table in self.tables.values())
        self.pointers = np.array([*(column.address for column in columns), room, *tables], dtype=np.int64)

    @staticmethod
    def _refuse_shapes(edge: EdgeType, at: Index, measured: Array) -> None:
        for what, given, size in (("vertices", at, len(edge.accepts)), ("measurements", measured, edge.measured_size)):
            if given.ndim != 2 or given.shape[1] != size:
                raise GraphSlamError(f"{edge.name}: {what} of shape {given.shape}, not (n, {size})")
        raise GraphSlamError(f"{edge.name}: {len(at)} edges but {len(measured)} measurements")

    def _refuse_unfit(self, edge: EdgeType, at: Index, measured: Array, fault: int, row: int, slot: int) -> None:
        vertex = int(at[row, slot])
        if fault == NOT_FINITE:
            seen = f"measurement {measured[row].tolist()} at vertices {at[row].tolist()}"
            raise GraphSlamError(f"{edge.name}: {seen} is not finite")
        if fault == MISSING:
            raise GraphSlamError(f"{edge.name}: vertex {vertex} does not exist")
        if fault == ITSELF:
            raise GraphSlamError(f"{edge.name}: edge from vertex {vertex} to itself")
        kind = edge.accepts[slot][0].name
        raise GraphSlamError(f"{edge.name}: vertex {vertex} is {self.kind_of(vertex).name}, not {kind}")

    def _accepted_by(self, edge: EdgeType) -> Mask:
        """Return whether each slot of an edge takes each kind, (slots, kinds)."""
        found = self._accepted.get(edge)
        if found is None or found.shape[1] != len(self.kinds):
            rows = [[kind in kinds for kind in self.kinds] for kinds in edge.accepts]
            found = self._accepted[edge] = np.array(rows, dtype=bool)
        return found


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array as kernels are compiled for it: one block of memory, writable."""
    return array if array.flags.carray else array.copy()


def _code(names: list[Any], name: Any) -> int:
    """Its place among the names, that behind the last if it is new."""
    return names.index(name) if name in names else len(names)
