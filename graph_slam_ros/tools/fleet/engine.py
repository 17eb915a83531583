"""Runs jobs on the workers of Dask: processes of this machine, or those of a scheduler that is there already."""

import contextlib
import itertools
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster, as_completed

from graph_slam_ros import __version__
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.isolation import run_isolated
from graph_slam_ros.tools.fleet.job import Job, failed, why_it_died
from graph_slam_ros.tools.fleet.recordings import Source, fingerprint
from graph_slam_ros.tools.fleet.store import MOST_ATTEMPTS, Row, Store

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

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Workers:
    """The workers that run the jobs.

    Attributes
    ----------
    scheduler : address of a Dask scheduler; empty: processes of this machine
    count : how many of them; 0: one for each core
    """

    scheduler: str = ""
    count: int = 0


@contextlib.contextmanager
def connected(workers: Workers) -> Iterator[Client]:
    """Connect to the workers, and end those that were started.

    Raises
    ------
    GraphSlamError
        The scheduler cannot be reached, has no worker, or its workers have another version of this package.
    """
    with dask.config.set(_SETTINGS), contextlib.ExitStack() as stack:
        if workers.scheduler:
            try:
                client = stack.enter_context(Client(workers.scheduler, timeout="10s", set_as_default=False))
            except (OSError, ValueError, TimeoutError) as error:
                raise GraphSlamError(f"{workers.scheduler}: no Dask scheduler answers: {error}") from None
            _check_versions(client, workers.scheduler)
        else:
            scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="graph_slam_dask_"))
            cluster = LocalCluster(
                n_workers=workers.count or None,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                local_directory=scratch,
                silence_logs="CRITICAL",
            )
            stack.enter_context(cluster)
            client = stack.enter_context(Client(cluster, set_as_default=False))
        yield client


def _check_versions(client: Client, address: str) -> None:
    found = client.run(_version)
    if not found:
        raise GraphSlamError(f"{address}: the scheduler has no worker: start some with dask worker {address}")
    for worker, version in sorted(found.items()):
        if version != __version__:
            raise GraphSlamError(f"{worker}: has graph_slam_ros {version}, and this is {__version__}")


def _version() -> str:
    try:
        from graph_slam_ros import __version__ as here
    except ImportError:
        return "not installed"
    return here


def fingerprints(client: Client, store: Store, sources: Sequence[Source], progress: Progress) -> dict[str, str]:
    """Return the fingerprint of each recording by its address. Those of unchanged files are not computed again.

    A recording that cannot be read has none.
    """
    known = store.fingerprints()
    unknown = [one for one in sources if one.identity not in known]
    futures = client.map(fingerprint, [one.url for one in unknown], pure=False)
    by_future = dict(zip(futures, unknown, strict=True))
    for future in progress(as_completed(futures, loop=client.loop), len(unknown)):
        if future.status == "finished":
            known[by_future[future].identity] = future.result()
    store.keep_fingerprints(known)
    return {one.url: known[one.identity] for one in sources if one.identity in known}


def run_jobs(
    client: Client, jobs: Sequence[Job], progress: Progress, function: Callable[[Job], Row] = run_isolated
) -> Iterator[Row]:
    """Run jobs in their order, and yield the row of each when it is done.

    A job whose process ends, or whose worker does, is begun again, three times in all. Then its row has the reason.
    """
    yield from progress(_rows(client, jobs, function), len(jobs))


def _rows(client: Client, jobs: Sequence[Job], function: Callable[[Job], Row]) -> Iterator[Row]:
    """The rows of jobs. The scheduler has one job for each thread of a worker.

    So a worker that ends takes no job with it that it has not begun, and a million jobs need no memory there.
    """
    left, at_work, done = iter(jobs), dict[Any, Job](), as_completed(loop=client.loop)

    def fill() -> None:
        room = max(sum(client.nthreads().values()), 1) - len(at_work)
        for job in itertools.islice(left, max(room, 0)):
            future = client.submit(function, job, key=f"{job.recording} {job.key}", pure=False, retries=2)
            at_work[future] = job
            done.add(future)

    fill()
    for future in done:
        job = at_work.pop(future)
        row = future.result() if future.status == "finished" else _lost(job, future.exception())
        future.release()
        fill()
        yield row


def _lost(job: Job, error: BaseException) -> Row:
    """The row of a job that no worker could finish."""
    if type(error).__name__ in ("KilledWorker", "ProcessEndedError"):
        return failed(job, why_it_died(Path(job.out), job.key))
    return failed(job, str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}")
