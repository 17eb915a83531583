"""The memory of the process."""

from graph_slam_ros.runs.resource_log import resident_mib

_ENOUGH = 0.95  # of the limit: less, and there is room again


def is_short(limit_mib: float, *, was_short: bool) -> bool:
    """Return whether the process has more memory than the limit; a limit of 0 means none."""
    return 0.0 < (_ENOUGH if was_short else 1.0) * limit_mib < resident_mib()
