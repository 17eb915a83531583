"""The memory of the process."""

import os
from pathlib import Path

_STATM = Path("/proc/self/statm")
_ENOUGH = 0.95  # of the limit: less, and there is room again


def resident_mib() -> float:
    """The resident memory of this process in MiB; 0 if there is no /proc."""
    try:
        pages = int(_STATM.read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def is_short(limit_mib: float, *, was_short: bool) -> bool:
    """Return whether the process has more memory than the limit; a limit of 0 means none."""
    return 0.0 < (_ENOUGH if was_short else 1.0) * limit_mib < resident_mib()
