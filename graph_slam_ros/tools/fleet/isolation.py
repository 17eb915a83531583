"""Runs jobs in a process beside the worker, so that a limit, a crash or a kill ends the job and never the worker.

A worker of Dask that dies just after its start is not started again by Dask, and a limit of memory would hit its event
loop. The process serves one job after another. It ends with its worker.
"""

import json
import os
import queue
import select
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from graph_slam_ros.tools.fleet.job import Job, head, report_on, run_job
from graph_slam_ros.tools.fleet.store import Row

_TASKS: dict[str, Callable[[Job], Row]] = {"run": run_job, "report": report_on, "nothing": head}
_GRACE_S = 60.0  # to start, to copy traces: after the limit of time a process that does not answer is killed


class ProcessEndedError(OSError):
    """The process of a job ended before the job did."""


class _Process:
    """A process that runs jobs: one line in, one line out."""

    def __init__(self) -> None:
        self._popen = subprocess.Popen([sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    @property
    def is_alive(self) -> bool:
        return self._popen.poll() is None

    def run(self, task: str, job: Job) -> Row:
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        try:
            self._popen.stdin.write(json.dumps([task, asdict(job)]).encode() + b"\n")
            self._popen.stdin.flush()
            answers, _, _ = select.select([self._popen.stdout], [], [], job.limit_s + _GRACE_S)
            line = self._popen.stdout.readline() if answers else b""
        except BrokenPipeError:
            line = b""
        if not line.endswith(b"\n"):
            self.end()
            raise ProcessEndedError(f"{job.recording}: its process ended")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise OSError(answer["error"])
        row: Row = answer["row"]
        return row

    def end(self) -> None:
        self._popen.kill()
        self._popen.communicate()


_of_this_thread = threading.local()


def run_isolated(job: Job, task: str = "run") -> Row:
    """Run a job in the process beside this one; returns its row.

    Parameters
    ----------
    task : ``run`` it, write the ``report`` on its run, or ``nothing``: what remains is the cost of jobs

    Raises
    ------
    ProcessEndedError
        The process ended: begin the job again.
    OSError
        The disk or the store fails.
    """
    process = getattr(_of_this_thread, "process", None)
    if process is None or not process.is_alive:
        process = _of_this_thread.process = _Process()
    row = process.run(task, job)
    if row.get("state") == "failed":
        process.end()  # nothing of what went wrong reaches the next job
    return row


def _serve() -> None:
    """Run the jobs of standard input; what they print goes to standard error."""
    # Now: imports under a limit of memory fail in ways of their own.
    import graph_slam_ros.analysis.evaluation
    import graph_slam_ros.runs.replay  # noqa: F401

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    while True:
        task, job = json.loads(lines.get())
        try:
            answer: dict[str, Any] = {"row": _TASKS[task](Job(**job))}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _read(lines: "queue.SimpleQueue[bytes]") -> None:
    """Hand on lines; the worker has ended when there are no more: nobody needs the job then."""
    for line in sys.stdin.buffer:
        lines.put(line)
    os._exit(1)


if __name__ == "__main__":
    _serve()
