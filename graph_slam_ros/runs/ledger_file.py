"""The ledger of a saved run: ``ledger.csv``, a row for each edge, and ``ledger_changes.csv``, of each changed verdict.

Rows are in order of the edges' ids. A list of numbers is one field, with spaces between them.
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from reprlib import repr as shortened
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.edge_tags import tag_of
from graph_slam_ros.errors import FormatError
from graph_slam_ros.formats.files import read_text
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.runs.journal import LEDGER
from graph_slam_ros.slam import MapView
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.typing import Index, Numbers

Ids = tuple[int, ...]
_VERDICTS, _REASONS = tuple(Verdict), {int(one): one for one in Reason}


@dataclass(frozen=True, slots=True)
class Entry:
    """An edge: its measurement, the decision on it, and its present state.

    Attributes
    ----------
    edge : id, the same in events
    label : its class
    tag : its type, as ``graph.g2o`` calls it
    source : the input that told it; empty where nobody did
    landmark : the name of the landmark it is about; empty where there is none
    vertices : as ``graph.g2o`` numbers them
    keyframe : at which it was judged first
    stamp_ns : of the newest keyframe that it is attached to: when it was measured, not when it was judged
    measured : with the sensor's place on the robot where the type has one
    information : of the measurement, the upper triangle row by row
    residual : how the measurement differed from what was expected when it was judged first, in its units
    statistic, threshold : chi2 that was last judged, and what it was held against
    dof : how many numbers were measured
    chi2 : how it fits now, without loss
    weight : what is left of its information now, by its loss; 0 where it is out
    """

    edge: int
    label: str
    tag: str
    source: str
    landmark: str
    vertices: Ids
    keyframe: int
    stamp_ns: int
    measured: Numbers
    information: Numbers
    residual: Numbers
    statistic: float
    dof: int
    threshold: float
    chi2: float
    weight: float
    verdict: Verdict
    reason: Reason

    @property
    def is_in(self) -> bool:
        """Return whether it is part of the problem."""
        return self.verdict not in (Verdict.PENDING, Verdict.REJECTED)

    @property
    def about(self) -> str:
        """The class of the edge, and the landmark that it observes."""
        return f"{self.label} {self.landmark}".strip()

    @property
    def stamp_s(self) -> float:
        """The stamp [s]."""
        return self.stamp_ns / 1e9

    @property
    def percent(self) -> float:
        """The weight [%]."""
        return 100.0 * self.weight

    @property
    def sigma_factor(self) -> float:
        """The factor of all sigmas with which it would just have passed its gate."""
        return float((self.statistic / self.threshold) ** 0.5)

    @property
    def information_matrix(self) -> NDArray[np.float64]:
        """The full information matrix, (dof, dof)."""
        upper = np.zeros((self.dof, self.dof))
        upper[np.triu_indices(self.dof)] = self.information
        return upper + np.triu(upper, 1).T


def read_ledger(folder: Path) -> list[Entry]:
    """The entries of a run, by edge. Raises FormatError naming the line."""
    file, hints = folder / LEDGER, get_type_hints(Entry)
    try:
        rows = csv.DictReader(io.StringIO(read_text(file), newline=""))
    except OSError as error:
        raise FormatError(f"{file}: {error.strerror}: is it a run, and saved by this version?") from None
    except UnicodeDecodeError as error:
        raise FormatError(f"{file}: not a ledger: {error}") from None
    try:
        return [Entry(**{name: _PARSED[kind](row[name]) for name, kind in hints.items()}) for row in rows]
    except (KeyError, TypeError, ValueError, AttributeError, csv.Error) as error:
        raise FormatError(f"{file}:{rows.line_num}: not a ledger: {shortened(str(error))}") from None


def ledger_entries(view: MapView, ids: Sequence[int]) -> Iterator[Entry]:
    """Each edge of the solver; ``ids`` are the numbers of vertices in the file, at their ids."""
    graph, ledger = view.graph, view.ledger
    stamps_ns: list[int] = view.keyframes.stamps_ns.tolist()
    judged = {change.edge: change.threshold for change in ledger.history}
    last_loss, edges = cache(view.solver.settings.last_loss), ledger.ids.since()
    rows_of = {table.code: _rows(view, table, np.asarray(ids, dtype=np.int64)) for table in graph.tables.values()}
    residuals, ends = ledger.residuals.values.tolist(), np.cumsum(ledger.numbers.values).tolist()
    chi2, _ = view.solver.chi2_of(edges)
    columns = (ledger.keyframe, ledger.statistic, ledger.numbers, ledger.threshold, ledger.verdict, ledger.reason)
    of_graph = (edges, *graph.places(edges), chi2)
    numbered = zip(*(column.tolist() for column in of_graph), ends, *(c.values.tolist() for c in columns), strict=True)
    for edge, code, row, now, end, keyframe, statistic, dof, threshold, verdict, reason in numbered:
        tag, rows = rows_of[code]
        vertices, landmark, newest_ns, measured, information, label_code, source_code, factor = rows[row]
        label, source = graph.labels[label_code], graph.sources[source_code]
        loss = last_loss(label, source)
        yield Entry(
            edge,
            label,
            tag,
            source,
            landmark,
            vertices,
            keyframe,
            newest_ns or stamps_ns[max(keyframe - view.keyframes.first, 0)],
            measured,
            information,
            tuple(residuals[end - dof : end]),
            statistic,
            dof,
            judged.get(edge, threshold),
            now,
            float(weight_and_cost(loss.kind, loss.scale, now)[0] * factor),
            _VERDICTS[verdict],
            _REASONS[reason],
        )


def _rows(view: MapView, table: EdgeTable, ids: Index) -> tuple[str, list[Any]]:
    """The tag of a table, and what an entry has of each row: all rows at once, as one by one is slow."""
    stamp_of, names = np.zeros(view.graph.vertex_ids.next, dtype=np.int64), [""] * view.graph.vertex_ids.next
    stamp_of[view.keyframes.ids] = view.keyframes.stamps_ns
    for one in view.bounded.old.values() if view.bounded else ():
        stamp_of[one.vertex] = one.stamp_ns
    for name, mark in view.landmarks.items():
        names[mark.vertex] = name
    vertices, roots = table.vertices, table.sqrt_information.values
    upper = np.triu_indices(roots.shape[1])
    rows = zip(
        map(tuple, ids[vertices].tolist()),
        [next((names[v] for v in several if names[v]), "") for several in vertices.tolist()],
        stamp_of[vertices].max(axis=1).tolist(),
        map(tuple, table.measured.values.tolist()),
        map(tuple, (roots.transpose(0, 2, 1) @ roots)[:, upper[0], upper[1]].tolist()),
        *(column.values.tolist() for column in (table.label, table.source, table.weight)),
        strict=True,
    )
    return tag_of(table.type), list(rows)


_PARSED: dict[Any, Callable[[str], Any]] = {
    int: int,
    float: float,
    str: str,
    Ids: lambda text: tuple(map(int, text.split())),
    Numbers: lambda text: tuple(map(float, text.split())),
    Verdict: lambda text: Verdict[text.upper()],
    Reason: lambda text: Reason[text.upper()],
}
