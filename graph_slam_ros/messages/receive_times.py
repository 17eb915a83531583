"""Clocks of two topics, compared by the times at which their messages were received."""

from collections.abc import Sequence

import numpy as np

from graph_slam_ros.typing import Array, Index

_SAME_S = 1e-3  # stamps that differ by less are one, by the rounding of lags
_SLOWEST, _FASTEST = 0.1, 10.0  # receive time that passes in a second of stamps; a file that was converted has others


def clock_offset_s(
    received_ns: Sequence[int] | Index,
    lag_s: Sequence[float] | Array,
    other_received_ns: Sequence[int] | Index,
    other_lag_s: Sequence[float] | Array,
) -> float:
    """Return what must be added to the stamps of a topic to have the clock of another [s]; 0 where that is not known.

    Lags are compared that were received at the same time. So a recording that was played fast or slow shows no offset.
    Where receive times do not run with the stamps at all, as in a converted file, or stamps that are all the same, they
    say nothing.

    Parameters
    ----------
    received_ns, lag_s : (n,) receive times, and these less stamps
    other_received_ns, other_lag_s : (m,) of the other topic, in order of receipt
    """
    if not (len(received_ns) and len(other_received_ns)):
        return 0.0
    origin_ns = int(other_received_ns[0])
    received_s, other_s = ((np.asarray(ns) - origin_ns) * 1e-9 for ns in (received_ns, other_received_ns))
    passed_s, stamped_s = float(other_s[-1]), float(other_s[-1] - other_lag_s[-1] + other_lag_s[0])
    if len(other_s) > 1 and not _SLOWEST * stamped_s < passed_s < _FASTEST * stamped_s:
        return 0.0
    if np.ptp(received_s) > _SAME_S > np.ptp(received_s - lag_s):
        return 0.0
    return float(np.median(np.asarray(lag_s) - np.interp(received_s, other_s, np.asarray(other_lag_s))))
