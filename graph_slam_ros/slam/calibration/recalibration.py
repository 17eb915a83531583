"""Corrections of measurements that are in the graph."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from graph_slam_ros.graph import Graph
from graph_slam_ros.typing import Array, Index


@dataclass(frozen=True, slots=True)
class Recalibration:
    """A correction of measurements that are in the graph already.

    Attributes
    ----------
    table : the name of the edge type
    rows : (n,) rows of its table
    measured, roots : (n, p), (n, m, m) what they are from now on
    """

    table: str
    rows: Index
    measured: Array
    roots: Array

    def present(self, graph: Graph) -> "Recalibration":
        """Return these edges as they are in a graph now, as far as it has them."""
        z, roots = self._columns(graph)
        rows = self.rows[self.rows < len(z)]
        return Recalibration(self.table, rows, z[rows], roots[rows])

    def only_changed(self, graph: Graph) -> "Recalibration":
        """The rows that differ from those of a graph."""
        now = self.present(graph)
        same = (now.measured == self.measured).all(axis=1) & (now.roots == self.roots).all(axis=(1, 2))
        return Recalibration(self.table, self.rows[~same], self.measured[~same], self.roots[~same])

    def apply(self, graph: Graph) -> "Recalibration":
        """Correct these edges of a graph, as far as it has them. Returns the change that undoes it."""
        z, roots = self._columns(graph)
        there, before = self.rows < len(z), self.present(graph)
        z[before.rows], roots[before.rows] = self.measured[there], self.roots[there]
        return before

    def _columns(self, graph: Graph) -> tuple[Array, Array]:
        for table in graph.tables.values():
            if table.type.name == self.table:
                return table.measured.values, table.sqrt_information.values
        return self.measured[:0], self.roots[:0]


Totals = dict[tuple[str, str], float]


def totals_record(totals: Totals) -> list[list[Any]]:
    """Plain lists of corrected values by input and name."""
    return [[*key, value] for key, value in totals.items()]


def read_totals(record: Sequence[Any]) -> Totals:
    """Inverse of ``totals_record``. Raises ValueError if a value is not finite."""
    totals = {(str(source), str(name)): float(value) for source, name, value in record}
    if not all(map(math.isfinite, totals.values())):
        raise ValueError(f"a calibration is not finite: {record}")
    return totals
