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
from dataclasses import asdict

from graph_slam_ros.tools.fleet.job import Job, failed, run_job
from graph_slam_ros.tools.fleet.store import Row

MOST_ATTEMPTS = 3
_START_S = 300.0  # for the imports of the process
_KILLED = f"its process ended {MOST_ATTEMPTS} times: killed, out of memory, or a crash"
_HUNG = f"took longer than the limit of time, {MOST_ATTEMPTS} times"


class _Process:
    """A process that runs jobs: one line in, one line out, after an empty one when it is ready."""

    def __init__(self) -> None:
        self._popen = subprocess.Popen([sys.executable, "-m", __name__], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.wrong = "" if self._line(_START_S) else _KILLED

    def run(self, job: Job) -> Row | None:
        """The row of a job; None, and what is ``wrong``, where there is none. The process is of no more use then."""
        assert self._popen.stdin is not None
        try:
            self._popen.stdin.write(json.dumps(asdict(job)).encode() + b"\n")
            self._popen.stdin.flush()
            line = self._line(job.limit_s)
        except BrokenPipeError:
            line = b""
        if line is None or not line.endswith(b"\n"):
            self.wrong = _HUNG if line is None else _KILLED
            return None
        row: Row = json.loads(line)
        self.wrong = row["reason"] if row["state"] == "failed" else ""
        return None if row.get("retry") else row

    def _line(self, most_s: float) -> bytes | None:
        """The next line; empty where the process has ended, None where there is none in time."""
        assert self._popen.stdout is not None
        answers, _, _ = select.select([self._popen.stdout], [], [], most_s)
        return self._popen.stdout.readline() if answers else None

    def end(self) -> None:
        self._popen.kill()
        self._popen.communicate()


_of_this_thread = threading.local()


def run_isolated(job: Job) -> Row:
    """Run a job in the process beside this one; returns its row.

    A job is begun again where its process ends, or its machine fails: three times in all.
    """
    for _ in range(MOST_ATTEMPTS):
        process = getattr(_of_this_thread, "process", None) or _Process()
        _of_this_thread.process = process
        row = process.run(job)
        if process.wrong:  # nothing of it reaches the next job
            process.end()
            _of_this_thread.process = None
        if row is not None:
            return row
    return failed(job, process.wrong)


def _serve() -> None:
    """Run the jobs of standard input; what they print goes to standard error."""
    # Now: imports under a limit of memory fail in ways of their own.
    import graph_slam_ros.analysis.evaluation
    import graph_slam_ros.runs.replay  # noqa: F401

    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    answer = "\n"
    while True:
        answers.write(answer)
        answers.flush()
        answer = json.dumps(run_job(Job(**json.loads(lines.get())))) + "\n"


def _read(lines: "queue.SimpleQueue[bytes]") -> None:
    """Hand on lines; the worker has ended when there are no more: nobody needs the job then."""
    for line in sys.stdin.buffer:
        lines.put(line)
    os._exit(1)


if __name__ == "__main__":
    _serve()
