"""Faults while one measurement is processed: each part is used by itself, and every fault counts."""

from collections.abc import Callable
from typing import ParamSpec

from graph_slam_ros.measurements.counters import Counters

P = ParamSpec("P")


class Faults:
    """Collects faults, so that one of them costs nothing but its own measurement, step or sighting."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._faults: list[Exception] = []

    def collect(self, use: Callable[P, None], *args: P.args, **kwargs: P.kwargs) -> None:
        """Call a function; what it raises is kept."""
        try:
            use(*args, **kwargs)
        except Exception as fault:
            self._faults.append(fault)

    def raise_first(self) -> None:
        """Raise the first fault, which the caller counts; the others are counted here."""
        if self._faults:
            (first, *others), self._faults = self._faults, []
            for error in others:
                self._counters.count("node", type(error).__name__)
            raise first
