"""Record CPU time, memory and backlog over a run, in a bounded number of samples."""

import sys
import time
from resource import RUSAGE_SELF, getrusage
from typing import Any

COLUMNS = ("keyframes", "cpu_s", "memory_mib", "backlog")
_MOST = 200  # samples: then every second one is dropped, and half as many are added
_PER_MIB = 2**20 if sys.platform == "darwin" else 2**10  # of the kernel's unit: bytes on macOS, KiB on Linux


class ResourceLog:
    """Samples at updates, evenly spaced over the run, whatever its length.

    The memory is the most that was resident until then. The backlog of a sample is the largest since the sample
    before: measurements accepted and not processed.
    """

    def __init__(self) -> None:
        self._begun = time.process_time()
        self._every, self._next, self._backlog = 1, 0, 0
        self._rows: list[tuple[int, float, float, int]] = []

    def add(self, keyframes: int, backlog: int) -> None:
        """Add an update, after which there are so many keyframes."""
        self._backlog = max(self._backlog, backlog)
        self._next -= 1
        if self._next > 0:
            return
        memory_mib = round(getrusage(RUSAGE_SELF).ru_maxrss / _PER_MIB, 1)
        self._rows.append((keyframes, round(time.process_time() - self._begun, 3), memory_mib, self._backlog))
        if len(self._rows) >= _MOST:
            self._every *= 2
            kept = self._rows[1::2]
            before = self._rows[::2]
            self._rows = [(*k[:3], max(k[3], b[3])) for k, b in zip(kept, before, strict=True)]
        self._next, self._backlog = self._every, 0

    def as_dict(self) -> dict[str, list[Any]]:
        """A column each for keyframes, CPU seconds since the begin, MiB and backlog; nothing without an update."""
        return {name: [row[k] for row in self._rows] for k, name in enumerate(COLUMNS)} if self._rows else {}
