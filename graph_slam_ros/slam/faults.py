"""Faults while one measurement is processed: each part is used by itself, and every fault counts."""

from types import TracebackType

from graph_slam_ros.measurements.counters import Counters


class Faults:
    """Context that collects exceptions, so that a fault loses only its own measurement, step or sighting."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._faults: list[Exception] = []

    def __enter__(self) -> None: ...

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, traceback: TracebackType | None
    ) -> bool:
        if isinstance(fault, Exception):
            self._faults.append(fault)
            return True
        return False

    def raise_first(self) -> None:
        """Raise the first exception, which the caller counts. The others are counted here."""
        if self._faults:
            (first, *others), self._faults = self._faults, []
            for error in others:
                self._counters.count("node", type(error).__name__)
            raise first
