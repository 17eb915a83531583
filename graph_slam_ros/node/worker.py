"""The one thread that changes the estimate, one job at a time, in order.

Callbacks only queue jobs, so that long work never delays them.
"""

import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeVar

Job = Callable[[], Any]

URGENT_S = 2.0  # for queued jobs when the node is stopped
_POLL_S = 0.05


class Worker:
    """A thread with a queue of jobs: up to ``most`` are offered, those that are called always have room.

    ``on_fault`` is called in the thread with what an offered job has raised, ``on_exit`` after a job that would have
    ended it, as ``SystemExit`` does. The next job follows.
    """

    def __init__(
        self, most: int, on_fault: Callable[[Exception], None], on_exit: Callable[[], None] = lambda: None
    ) -> None:
        self._most, self._on_fault, self._on_exit = most, on_fault, on_exit
        self._jobs: queue.SimpleQueue[tuple[Sequence[Job], Future[Any] | None, float] | None] = queue.SimpleQueue()
        self._since = self._begun = math.inf  # when the present job was queued, and when it started
        self._is_left = False
        self._thread = threading.Thread(target=self._run, name="graph_slam_worker", daemon=True)
        self._thread.start()

    def offer(self, *jobs: Job) -> bool:
        """Queue jobs that follow one another, even if the first one raises; False if the queue is full."""
        if not self.has_room:
            return False
        self._jobs.put((jobs, None, time.monotonic()))
        return True

    def call(self, job: Job) -> "Future[Any]":
        """Queue a job. The future has its result or exception."""
        future: Future[Any] = Future()
        self._jobs.put(([job], future, time.monotonic()))
        return future

    @property
    def waiting(self) -> int:
        """The number of queued jobs."""
        return self._jobs.qsize()

    @property
    def lag_s(self) -> float:
        """The time since the present job was queued."""
        return max(0.0, time.monotonic() - self._since)

    @property
    def busy_s(self) -> float:
        """The time since the present job started."""
        return max(0.0, time.monotonic() - self._begun)

    @property
    def is_alive(self) -> bool:
        """Return whether the thread runs."""
        return self._thread.is_alive()

    @property
    def has_room(self) -> bool:
        """Return whether ``offer`` would accept another job."""
        return self._jobs.qsize() < self._most

    def leave(self) -> None:
        """Start no further job. Queued jobs are dropped."""
        self._is_left = True

    def stop(self, timeout_s: float | None = None, is_urgent: Callable[[], bool] = lambda: False) -> bool:
        """Do the queued jobs, then end. False if that takes too long; then no further job is started.

        Without a timeout it may take as long as it takes, and ``URGENT_S`` once ``is_urgent``.
        """
        self._jobs.put(None)
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while self._thread.is_alive() and time.monotonic() < deadline:
            self._thread.join(min(_POLL_S, max(0.0, deadline - time.monotonic())))
            if deadline == math.inf and is_urgent():
                deadline = time.monotonic() + URGENT_S
        self._is_left |= self._thread.is_alive()
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (item := self._jobs.get()) is not None and not self._is_left:
            jobs, future, self._since = item
            self._begun = time.monotonic()
            for job in jobs:
                self._do(job, future)
            self._since = self._begun = math.inf

    def _do(self, job: Job, future: "Future[Any] | None") -> None:
        error = _failure(job, future)
        if not isinstance(error, Exception | None):
            _failure(self._on_exit, None)
        elif error is not None and future is None and not self._is_left:  # else publishers may be gone
            _failure(partial(self._on_fault, error), None)


def _failure(job: Job, future: "Future[Any] | None") -> BaseException | None:
    """Run a job. Its exception does not end the thread, and goes to its future if it has one."""
    try:
        result = job()
    except BaseException as error:
        if future is not None:
            future.set_exception(error if isinstance(error, Exception) else RuntimeError(f"it ended with {error!r}"))
        return error
    if future is not None:
        future.set_result(result)
    return None


Result = TypeVar("Result")


def run_in_thread(work: Callable[[], Result]) -> Callable[[], Result]:
    """Start work in a daemon thread. Returns a function that waits for its result or raises its exception."""
    future: Future[Result] = Future()
    threading.Thread(target=_failure, args=(work, future), name="second look", daemon=True).start()
    return future.result
