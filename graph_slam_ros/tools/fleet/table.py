"""The table of a fleet: one row for each job, as Parquet, filtered with SQL by DuckDB."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.tools.fleet.store import ERRORS, TABLE, Row

FIRST = ("recording", "setting", "state", "rmse_m", "rpe_m_per_m", "nees", "keyframes", "cpu_s", "memory_mib", "reason")
_TEXTS = {"key", "recording", "setting", "url", "truth", "state", "reason", "worker", "map_hash", "inputs"}
_NO_COLUMNS = {"retry", ERRORS}
_TOGETHER = 10_000


def write_table(folder: Path, rows: Iterable[Row]) -> Path:
    """Write the rows as Parquet, by recording and setting; columns that a row lacks are null."""
    left, parts = iter(rows), [_part([])]
    while some := list(itertools.islice(left, _TOGETHER)):
        parts.append(_part(some))
    table = pa.concat_tables(parts, promote_options="permissive")
    names = [*FIRST, *sorted(set(table.column_names) - set(FIRST))]
    known = pa.schema([(n, pa.float64() if pa.types.is_null(t := table.field(n).type) else t) for n in names])
    sink = pa.BufferOutputStream()
    table = (
        table.select(names)
        .cast(known)
        .sort_by([("recording", "ascending"), ("setting", "ascending"), ("key", "ascending")])
    )
    pq.write_table(table, sink)
    write_whole(folder / TABLE, sink.getvalue().to_pybytes())
    return folder / TABLE


def _part(rows: Sequence[Row]) -> pa.Table:
    names = {name for row in rows for name in row}.difference(_NO_COLUMNS).union(FIRST)
    return pa.table({name: pa.array([row.get(name) for row in rows], _type(rows, name)) for name in names})


def _type(rows: Sequence[Row], name: str) -> pa.DataType:
    """The type of a column; that of one without values depends on other rows."""
    if name in _TEXTS:
        return pa.string()
    values = [row[name] for row in rows if row.get(name) is not None]
    return pa.null() if not values else pa.int64() if all(isinstance(v, int) for v in values) else pa.float64()


def read_table(
    folder: Path, where: str = "", order: str = "", columns: Sequence[str] = (), most: int | None = None
) -> list[dict[str, Any]]:
    """Return rows of a fleet's table.

    Parameters
    ----------
    where, order : SQL over the columns, as ``rmse_m > 0.1`` and ``rmse_m DESC``
    columns : the columns; default: all
    most : rows; default: all

    Raises
    ------
    GraphSlamError
        No table, or a condition that DuckDB refuses.
    """
    import duckdb  # a tenth of a second, and replays need none

    file = folder / TABLE
    if not file.is_file():
        raise GraphSlamError(f"{folder}: no {TABLE} in it: graph_slam fleet replay writes it")
    quoted = ", ".join('"' + name.replace('"', '""') + '"' for name in columns) or "*"
    clauses = (("WHERE", where), ("ORDER BY", order), ("LIMIT", "" if most is None else str(most)))
    query = " ".join([f"SELECT {quoted} FROM rows", *(f"{word} {text}" for word, text in clauses if text)])
    # Nothing but the table is in reach of the condition: no file, no network, no setting.
    settings: dict[str, Any] = {"enable_external_access": "false", "lock_configuration": "true", "threads": "1"}
    try:
        with duckdb.connect(config=settings) as connection:
            connection.register("rows", pyarrow.dataset.dataset(file))  # read in parts
            found = connection.execute(query)
            names = [one[0] for one in found.description or ()]
            return [dict(zip(names, row, strict=True)) for row in found.fetchall()]
    except (duckdb.Error, pa.ArrowException, OSError) as error:
        raise GraphSlamError(" ".join(f"{file}: {error}".split())) from None
