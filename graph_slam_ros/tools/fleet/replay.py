"""The product of recordings and settings, replayed into one folder on the workers of Dask.

They are processes of this machine, or those of a scheduler that is there already.
"""

import contextlib
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import dask
from distributed import Client, as_completed

from graph_slam_ros import __version__
from graph_slam_ros.config import Config
from graph_slam_ros.config.config import flatten
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import parse_setting, read_parameters
from graph_slam_ros.tools.fleet.job import Job, failed
from graph_slam_ros.tools.fleet.recordings import Source, find_sources
from graph_slam_ros.tools.fleet.store import JOBS, REPORT, Row, Store, job_key, write_table

DEFAULTS = "defaults"
Progress = Callable[[Iterable[Any], int], Iterable[Any]]
MOST_ATTEMPTS = 3
_MODULE = "graph_slam_ros.tools.fleet.job"
_SETTINGS = {
    "distributed.scheduler.allowed-failures": MOST_ATTEMPTS - 1,  # ends of a worker's process that a task survives
    "distributed.scheduler.worker-saturation": 1.0,  # tasks wait at the scheduler, in their order
    "distributed.worker.memory.target": False,  # nothing is held in memory that could be written to a disk
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,  # a job has its own limit
    "distributed.scheduler.work-stealing": False,
    "distributed.scheduler.no-workers-timeout": "300s",  # jobs fail then, instead of waiting for ever
    "distributed.admin.log-format": "%(message)s",
    "logging.distributed": "critical",
}


@dataclass(frozen=True, slots=True)
class Fleet:
    """The work of a fleet.

    Attributes
    ----------
    recordings : files, folders, addresses
    out : the folder for the results
    configs : files of parameters; each recording is replayed with each
    settings : ``KEY=VALUE`` or ``KEY=V1,V2``: with each value
    truth : as ``evaluate --truth``, with ``{path}``, ``{folder}`` and ``{stem}`` of the recording; empty without
    limit_s : seconds for a job
    memory : bytes for a job; 0 without limit
    with_report : write a page for each run
    """

    recordings: Sequence[str]
    out: Path
    configs: Sequence[Path] = ()
    settings: Sequence[str] = ()
    truth: str = ""
    limit_s: float = 3600.0
    memory: int = 0
    with_report: bool = False


def settings_of(configs: Sequence[Path], settings: Sequence[str]) -> dict[str, Mapping[str, Any]]:
    """Return the parameters of each configuration by its name: all files with all combinations of settings."""
    files: dict[str, dict[str, Any]] = {}
    for file in configs:
        if file.stem in files:
            raise GraphSlamError(f"--config: two files are named {file.stem}: rename one: the table has this name")
        files[file.stem] = dict(flatten(read_parameters(file)))
    choices = []
    for text in settings:
        key, found, values = text.partition("=")
        if not found:
            raise GraphSlamError(f"--set {text}: is not KEY=VALUE")
        choices.append([(f"{key}={value}", parse_setting(f"{key}={value}")) for value in values.split(",")])
    out: dict[str, Mapping[str, Any]] = {}
    for name, values_of_file in (files or {"": {}}).items():
        for chosen in itertools.product(*choices):
            label = " ".join(part for part in (name, *(text for text, _ in chosen)) if part) or DEFAULTS
            try:
                config = Config.from_mapping(values_of_file | dict(pair for _, pair in chosen))
            except GraphSlamError as error:
                raise GraphSlamError(f"{label}: {error}") from None
            out[label] = dict(flatten(config.as_mapping()))
    return out


def truth_of(pattern: str, source: Source) -> str:
    """Return the truth of a recording: the pattern with the recording's ``{path}``, ``{folder}`` and ``{stem}``."""
    path = Path(source.url) if "://" not in source.url else None
    folder, name = (str(path.parent), path.name) if path else source.url.rsplit("/", 1)
    try:
        return pattern.format(path=source.url, folder=folder, stem=name.split(".")[0])
    except (KeyError, IndexError, ValueError):
        raise GraphSlamError(f"--truth {pattern}: knows {{path}}, {{folder}} and {{stem}} of a recording") from None


def jobs_of(fleet: Fleet) -> list[Job]:
    """Return the jobs, those of the largest recordings first.

    Raises GraphSlamError: nothing to replay, or a setting or a truth that cannot be used.
    """
    jobs, settings, out = list[Job](), settings_of(fleet.configs, fleet.settings), str(fleet.out.absolute())
    limits: dict[str, Any] = {"limit_s": fleet.limit_s, "memory": fleet.memory, "with_report": fleet.with_report}
    for source in find_sources(fleet.recordings):
        truth = truth_of(fleet.truth, source)
        for label, values in settings.items():
            key = job_key(source.identity, values, truth)
            jobs.append(Job(key, source.url, source.name, label, values, truth, out, **limits))
    return jobs


def replay_all(
    fleet: Fleet, scheduler: str = "", workers: int = 0, progress: Progress = lambda items, _: items
) -> tuple[list[Row], int]:
    """Run all jobs that are not in the folder yet, and write the table.

    Parameters
    ----------
    scheduler, workers : of Dask, as ``connected`` takes them

    Returns
    -------
    the rows of all its jobs, and how many were there before

    Raises
    ------
    GraphSlamError
        Nothing to replay, a setting that cannot be used, or another fleet in the folder.
    """
    jobs = jobs_of(fleet)
    store = Store(fleet.out, new=True)
    with store.locked():
        rows = {job.key: row for job in jobs if (row := store.result(job.key)) and _is_whole(store, job, row)}
        reused, left = len(rows), [job for job in jobs if job.key not in rows]
        store.clear(job.key for job in left)
        try:
            if left:
                with connected(scheduler, workers) as client:
                    rows |= {row["key"]: row for row in progress(run_jobs(client, left), len(left))}
        finally:
            write_table(store.folder, list(store.rows()))
    return list(rows.values()), reused


def _is_whole(store: Store, job: Job, row: Row) -> bool:
    """Return whether nothing is to be added to a run that is there: a machine failed, or it is to have a report."""
    has_report = (store.folder / JOBS / job.key / REPORT).is_file()
    return not row.get("retry") and (has_report or not job.with_report or row["state"] == "failed")


# -- workers -----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def connected(scheduler: str, count: int) -> Iterator[Client]:
    """Connect to the workers of a scheduler; where its address is empty, start some here (0: one a core), and end them.

    Raises GraphSlamError: the scheduler cannot be reached, has no worker, or its workers have another version of this
    package.
    """
    with dask.config.set(_SETTINGS), contextlib.ExitStack() as stack:
        if scheduler:
            try:
                client = stack.enter_context(Client(scheduler, timeout="10s", set_as_default=False))
            except (OSError, ValueError, TimeoutError) as error:
                raise GraphSlamError(f"{scheduler}: no Dask scheduler answers: {error}") from None
            _check_versions(client, scheduler)
        else:
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="graph_slam_dask_"))
            local: dict[str, Any] = {"n_workers": count or None, "threads_per_worker": 1, "processes": True}
            local |= {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "memory_limit": 0}
            local |= {"local_directory": scratch, "silence_logs": "CRITICAL"}
            client = stack.enter_context(Client(set_as_default=False, **local))
        yield client


def _check_versions(client: Client, address: str) -> None:
    found = client.run(version, "graph_slam_ros", on_error="return")
    if not found:
        raise GraphSlamError(f"{address}: the scheduler has no worker: start some with dask worker {address}")
    for worker, there in sorted(found.items()):
        if there != __version__:
            raise GraphSlamError(f"{worker}: has graph_slam_ros {there}, and this is {__version__}")


def run_isolated(job: Job) -> Row:
    """Run a job in a process of its own; returns its row.

    So a limit, a crash or a kill ends the job and never the worker. A job is begun again where its process ends, or its
    machine fails: three times in all.
    """
    reason, given = "", json.dumps(asdict(job)).encode()
    for _ in range(MOST_ATTEMPTS):
        command = [sys.executable, "-m", _MODULE]
        try:
            done = subprocess.run(
                command, input=given, stdout=subprocess.PIPE, timeout=job.limit_s, start_new_session=True, check=False
            )
            row: Row = json.loads(done.stdout)
        except subprocess.TimeoutExpired:
            reason = f"took longer than the limit of time, {MOST_ATTEMPTS} times"
        except ValueError:
            reason = f"its process ended {MOST_ATTEMPTS} times: killed, out of memory, or a crash"
        else:
            if not row.get("retry"):
                return row
            reason = row["reason"]
    return failed(job, reason)


def run_jobs(client: Client, jobs: Iterable[Job], function: Callable[[Job], Row] = run_isolated) -> Iterator[Row]:
    """Run jobs in their order, and yield the row of each when it is done. A worker has one for each of its threads.

    So a worker that ends takes no job with it that it has not begun, and a million jobs need no memory there.
    """
    left, at_work, done = iter(jobs), dict[Any, Job](), as_completed(loop=client.loop)

    def fill() -> None:
        room = max(sum(client.nthreads().values()), 1) - len(at_work)
        for job in itertools.islice(left, max(room, 0)):
            future = client.submit(function, job, key=f"{job.recording} {job.key}", pure=False)
            at_work[future] = job
            done.add(future)

    fill()
    for future in done:
        job = at_work.pop(future)
        error = None if future.status == "finished" else future.exception()
        yield future.result() if error is None else failed(job, f"no worker could finish it: {error}")
        future.release()
        fill()
