"""Record CPU time, memory and backlog over a run, in a bounded number of samples."""

import os
import time
from pathlib import Path
from typing import Any

COLUMNS = ("keyframes", "cpu_s", "memory_mib", "backlog")
_MOST = 200  # samples: then every second one is dropped, and half as many are added
_STATM = Path("/proc/self/statm")


def resident_mib() -> float:
    """The resident memory of this process in MiB; 0 if there is no /proc."""
    try:
        pages = int(_STATM.read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


class ResourceLog:
    """Samples at updates, evenly spaced over the run, whatever its length.

    The backlog of a sample is the largest since the sample before: measurements accepted and not processed.
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
        self._rows.append(
            (keyframes, round(time.process_time() - self._begun, 3), round(resident_mib(), 1), self._backlog)
        )
        if len(self._rows) >= _MOST:
            self._every *= 2
            kept = self._rows[1::2]
            before = self._rows[::2]
            self._rows = [(*k[:3], max(k[3], b[3])) for k, b in zip(kept, before, strict=True)]
        self._next, self._backlog = self._every, 0

    def as_dict(self) -> dict[str, list[Any]]:
        """A column each for keyframes, CPU seconds since the begin, MiB and backlog; nothing without an update."""
        return {name: [row[k] for row in self._rows] for k, name in enumerate(COLUMNS)} if self._rows else {}
