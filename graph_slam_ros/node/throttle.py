"""A limit on the rate of log messages."""

import time


class Throttle:
    """Lets pass what comes first and then no more than one in so many seconds.

    Parameters
    ----------
    period_s : between two that pass
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._passed_s = -float("inf")
        self._left_out = 0

    def next(self) -> int | None:
        """The number left out since the last that passed; None where this one is left out, too."""
        now_s = time.monotonic()
        if now_s - self._passed_s < self._period_s:
            self._left_out += 1
            return None
        self._passed_s, left_out, self._left_out = now_s, self._left_out, 0
        return left_out
