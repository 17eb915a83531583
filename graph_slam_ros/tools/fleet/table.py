"""The table of a fleet: one row for each job, as Parquet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.tools.fleet.store import ERRORS, TABLE, Row

_FIRST = (
    *("recording", "setting", "state", "rmse_m", "rpe_m_per_m", "nees", "keyframes", "cpu_s", "memory_mib", "reason"),
)
_TEXTS = {"key", "recording", "setting", "url", "truth", "state", "reason", "worker", "map_hash", "inputs"}
_NO_COLUMNS = {"retry", ERRORS, *_FIRST}


def write_table(folder: Path, rows: Sequence[Row]) -> None:
    """Write the rows as Parquet, by recording and setting; columns that a row lacks are null."""
    names = [*_FIRST, *sorted({name for row in rows for name in row} - _NO_COLUMNS)]
    table = pa.table({name: pa.array([row.get(name) for row in rows], _type(rows, name)) for name in names})
    sink = pa.BufferOutputStream()
    pq.write_table(table.sort_by([(name, "ascending") for name in ("recording", "setting")]), sink)
    write_whole(folder / TABLE, sink.getvalue().to_pybytes())


def _type(rows: Sequence[Row], name: str) -> pa.DataType:
    if name in _TEXTS:
        return pa.string()
    values = [row[name] for row in rows if row.get(name) is not None]
    return pa.int64() if values and all(isinstance(v, int) for v in values) else pa.float64()


def read_table(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a fleet's table. Raises GraphSlamError where there is none."""
    file = folder / TABLE
    if not file.is_file():
        raise GraphSlamError(f"{folder}: no {TABLE} in it: graph_slam fleet replay writes it")
    try:
        rows: list[dict[str, Any]] = pq.read_table(file).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise GraphSlamError(" ".join(f"{file}: {error}".split())) from None
    return rows
