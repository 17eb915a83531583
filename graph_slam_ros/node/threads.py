"""Threads for background work, such as the search for better hypotheses."""

from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import TypeVar

Result = TypeVar("Result")


def run_in_thread(work: Callable[[], Result]) -> Callable[[], Result]:
    """Start work in a daemon thread. Returns a function that waits for its result or raises its exception."""
    future: Future[Result] = Future()
    Thread(target=_run, args=(work, future), name="second look", daemon=True).start()
    return future.result


def _run(work: Callable[[], Result], future: "Future[Result]") -> None:
    try:
        future.set_result(work())
    except BaseException as error:  # whoever waits would wait for ever
        future.set_exception(error)
