"""Runs jobs on the workers of Dask: processes of this machine, or those of a scheduler that is there already."""

import contextlib
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from typing import Any

import dask
from distributed import Client, LocalCluster, as_completed

from graph_slam_ros import __version__
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.fleet.job import Job, failed
from graph_slam_ros.tools.fleet.store import Row

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
            cluster = LocalCluster(
                n_workers=count or None,
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
