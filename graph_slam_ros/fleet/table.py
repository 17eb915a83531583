"""The table of a fleet: one row for each job, as Parquet, filtered with SQL by DuckDB."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.fleet.store import TABLE, Row
from graph_slam_ros.formats.durable import write_whole

FIRST = ("recording", "setting", "state", "rmse_m", "rpe_m_per_m", "nees", "keyframes", "cpu_s", "memory_mib", "reason")
_TEXTS = {"key", "recording", "setting", "url", "truth", "state", "reason", "worker", "map_hash"}


def write_table(folder: Path, rows: Sequence[Row]) -> Path:
    """Write the rows as Parquet, by recording and setting; columns that a row lacks are null."""
    names = sorted({name for row in rows for name in row} - {"retry"} - set(FIRST))
    columns = {
        name: pa.array(
            [row.get(name) for row in rows],
            pa.string() if name in _TEXTS else pa.int64() if _is_whole(rows, name) else pa.float64(),
        )
        for name in (*FIRST, *names)
    }
    sink = pa.BufferOutputStream()
    table = pa.table(columns).sort_by([("recording", "ascending"), ("setting", "ascending"), ("key", "ascending")])
    pq.write_table(table, sink)
    write_whole(folder / TABLE, sink.getvalue().to_pybytes())
    return folder / TABLE


def _is_whole(rows: Sequence[Row], name: str) -> bool:
    return all(isinstance(row[name], int) for row in rows if row.get(name) is not None)


def read_table(folder: Path, where: str = "", order: str = "", columns: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return rows of a fleet's table.

    Parameters
    ----------
    where, order : SQL over the columns, as ``rmse_m > 0.1`` and ``rmse_m DESC``
    columns : the columns; default: all

    Raises
    ------
    GraphSlamError
        No table, or a condition that DuckDB refuses.
    """
    file = folder / TABLE
    if not file.is_file():
        raise GraphSlamError(f"{folder}: no {TABLE} in it: graph_slam fleet replay writes it")
    quoted = ", ".join('"' + name.replace('"', '""') + '"' for name in columns) or "*"
    query = (
        f"SELECT {quoted} FROM rows" + (f" WHERE {where}" if where else "") + (f" ORDER BY {order}" if order else "")
    )
    # Nothing but the table is in reach of the condition: no file, no network, no setting.
    settings: dict[str, Any] = {"enable_external_access": "false", "lock_configuration": "true", "threads": "1"}
    try:
        with duckdb.connect(config=settings) as connection:
            connection.register("rows", pq.read_table(file))
            found = connection.execute(query)
            names = [one[0] for one in found.description or ()]
            return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
    except (duckdb.Error, pa.ArrowException, OSError) as error:
        raise GraphSlamError(" ".join(f"{file}: {error}".split())) from None
