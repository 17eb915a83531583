"""The folder of a fleet: one folder for each job, written under another name first, and a table of all, as Parquet.

fleet.json         what this folder is
jobs/KEY/          row.json, and run/ as replay writes it; report.html
table.parquet      the rows of all jobs
"""

import contextlib
import fcntl
import hashlib
import json
import os
import platform
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from graph_slam_ros import __version__
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.durable import write_whole
from graph_slam_ros.formats.files import read_text

MARK, FORMAT = "fleet.json", "graph_slam_ros fleet"
JOBS, ROW, RUN, REPORT, TABLE = "jobs", "row.json", "run", "report.html", "table.parquet"
ERRORS = "errors_m"
"""Errors of parts of a drive, in its order. The page draws them."""
_ERROR = ("rmse_m", "rpe_m_per_m", "nees")
_FIRST = ("recording", "setting", "state", *_ERROR, "keyframes", "cpu_s", "memory_mib", "reason")
_TEXTS = {"key", "recording", "setting", "url", "truth", "state", "reason", "worker", "map_hash", "inputs"}
_NO_COLUMNS = {"retry", ERRORS, *_FIRST}
_ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+:/")  # as Path leaves s3://

Row = dict[str, Any]


def job_key(identity: str, settings: Mapping[str, Any], truth: str) -> str:
    """Return the name of a job: of the recording's identity, all parameters, the truth with its time, the version."""
    changed = 0
    with contextlib.suppress(OSError):
        file = truth if os.path.exists(truth) else truth.rpartition(":")[0]  # BAG:TOPIC
        changed = os.stat(file).st_mtime_ns
    whole = json.dumps([identity, settings, truth, changed, __version__], sort_keys=True)
    return hashlib.sha256(whole.encode()).hexdigest()[:24]


class Store:
    """The folder of a fleet. Raises GraphSlamError: the folder holds something else."""

    def __init__(self, folder: Path, *, new: bool = False) -> None:
        self.folder = folder
        if _ADDRESS.match(str(folder)):
            raise GraphSlamError(f"{folder}: a fleet writes into a folder that all its machines see, not into a store")
        try:
            if new:
                self._begin()
            mark = json.loads(read_text(folder / MARK))
        except FileNotFoundError:
            raise GraphSlamError(f"{folder}: not the folder of a fleet: no {MARK} in it") from None
        except (OSError, ValueError) as error:
            raise GraphSlamError(f"{folder}: {error}") from None
        if not isinstance(mark, dict) or mark.get("format") != FORMAT:
            raise GraphSlamError(f"{folder}: not the folder of a fleet, by its {MARK}")

    def _begin(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        if not (self.folder / MARK).exists():
            if any(one.name != ".lock" for one in self.folder.iterdir()):
                raise GraphSlamError(f"{self.folder}: is not empty and not the folder of a fleet: choose another --out")
            write_whole(self.folder / MARK, json.dumps({"format": FORMAT, "version": __version__}).encode())
        (self.folder / JOBS).mkdir(exist_ok=True)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder against another fleet.

        Raises GraphSlamError: another fleet has it; its machine and process are named.
        """
        fd = os.open(self.folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                who = os.pread(fd, 200, 0).decode(errors="replace").strip() or "another process"
                raise GraphSlamError(f"{self.folder}: another fleet writes into it ({who})") from None
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{platform.node()}, process {os.getpid()}".encode(), 0)
            yield
        finally:
            os.close(fd)

    def result(self, key: str) -> Row | None:
        """The row of a job that is done; None if it is not, or cannot be read."""
        with contextlib.suppress(OSError, ValueError):
            row = json.loads(read_text(self.folder / JOBS / key / ROW))
            return row if isinstance(row, dict) else None
        return None

    def rows(self) -> Iterator[Row]:
        """Yield the rows of all jobs, in order of their keys."""
        keys = sorted(one.name for one in (self.folder / JOBS).iterdir() if not one.name.startswith("."))
        return (row for key in keys if (row := self.result(key)) is not None)

    def clear(self, keys: Iterable[str]) -> None:
        """Remove what a fleet that was stopped left, and the folders of jobs that are run again."""
        for left in (*(self.folder / JOBS).glob(".*"), *(self.folder / JOBS / key for key in keys)):
            shutil.rmtree(left, ignore_errors=True)


def keep(folder: Path, key: str, made: Path, row: Row) -> None:
    """Move the results of a job to its folder, all at once. If another process was faster, its results stay."""
    write_whole(made / ROW, json.dumps(row, indent=1).encode())
    target = folder / JOBS / key
    try:
        made.rename(target)
    except OSError:
        if not (target / ROW).exists():
            raise
        shutil.rmtree(made, ignore_errors=True)


# -- the table ---------------------------------------------------------------------------------------------------------


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


def read_table(folder: Path) -> list[Row]:
    """Return the rows of a fleet's table. Raises GraphSlamError where there is none."""
    file = folder / TABLE
    if not file.is_file():
        raise GraphSlamError(f"{folder}: no {TABLE} in it: graph_slam fleet replay writes it")
    try:
        rows: list[Row] = pq.read_table(file).to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise GraphSlamError(" ".join(f"{file}: {error}".split())) from None
    return rows
