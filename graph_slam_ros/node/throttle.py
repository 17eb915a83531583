"""A limit on the rate of log messages."""

import time


class Throttle:
    """Passes the first item, and then at most one in a given time.

    Parameters
    ----------
    period_s : between two that pass
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._passed_s = -float("inf")
        self._left_out = 0

    def next(self) -> int | None:
        """The number left out since the last that passed; None if this one is left out, too."""
        now_s = time.monotonic()
        if now_s - self._passed_s < self._period_s:
            self._left_out += 1
            return None
        self._passed_s, left_out, self._left_out = now_s, self._left_out, 0
        return left_out
