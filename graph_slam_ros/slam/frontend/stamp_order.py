"""Puts measurements that arrive nearly in order of stamp into exact order of stamp.

Odometry is the clock: a measurement is released when it is ``window_s`` older than the newest odometry. A landmark
message may come early; then it is kept until odometry has reached its stamp. It may be late within the window. No wall
clock is read.

A sensor whose clock is corrected to an earlier time comes late by that: odometry waits for it, as long as it would
without the correction. Else no keyframe could be made where a sighting was.
"""

from bisect import insort

from graph_slam_ros.config.pipeline import OrderingConfig
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Observation, Odometry
from graph_slam_ros.slam.frontend.ingest_gate import size_of
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector

NS = 1_000_000_000
_REMEMBERED = 100  # messages of each topic, by which one that comes again is known


class StampOrder:
    """A bounded queue that releases measurements by (stamp, odometry first, topic, arrival).

    Parameters
    ----------
    lag_ns : how long after odometry of the same stamp the sightings of a late sensor arrive
    """

    def __init__(self, config: OrderingConfig, counters: Counters, lag_ns: int = 0) -> None:
        self._window_ns = round(config.window_s * NS) + lag_ns
        self._max_pending = config.max_waiting
        self._counters = counters
        self._queue: list[tuple[int, int, str, int, Odometry | Observation]] = []  # ascending
        self._recent: dict[str, dict[Observation, None]] = {}  # in the order they came
        self._arrivals = 0
        self._newest_odometry_ns: int | None = None
        self._released_ns: int | None = None

    def accepts(self, m: Odometry | Observation) -> bool:
        """Return whether a measurement may be queued; if not, count it.

        There must be room. Odometry must not be older than what was released; all else must be new. Odometry that is
        newer than all before always has room: it releases others.
        """
        if not isinstance(m, Odometry):
            reason = "duplicate" if self._is_repeated(m) else "" if self._has_room(m.stamp_ns) else "overflow"
            if reason:
                self._counters.count(m.topic, reason, size_of(m))
            return not reason
        if self._released_ns is not None and m.stamp_ns < self._released_ns:  # it is older than what was released
            self._counters.count(m.source, "late")
            return False
        is_newest = self._newest_odometry_ns is None or m.stamp_ns > self._newest_odometry_ns
        if not is_newest and not self._has_room(m.stamp_ns):
            self._counters.count(m.source, "overflow")
            return False
        return True

    def _has_room(self, stamp_ns: int) -> bool:
        """Return whether the queue has room, or the measurement with the latest stamp of all can make room."""
        if len(self._queue) < self._max_pending:
            return True
        at_ns, _, _, _, m = self._queue[-1]
        if at_ns <= stamp_ns or isinstance(m, Odometry):
            return False
        self._queue.pop()
        self._counters.count(m.topic, "overflow", size_of(m))
        return True

    def _is_repeated(self, m: Observation) -> bool:
        """Return whether the same message has arrived before; if not, remember it."""
        recent = self._recent.setdefault(m.topic, {})
        if m in recent:
            return True
        recent[m] = None
        if len(recent) > _REMEMBERED:
            del recent[next(iter(recent))]
        return False

    def push(self, m: Odometry | Observation) -> list[Odometry | Observation]:
        """Queue one measurement; return those that are released."""
        rank, topic = (0, "") if isinstance(m, Odometry) else (1, m.topic)
        insort(self._queue, (m.stamp_ns, rank, topic, self._arrivals, m))
        self._arrivals += 1
        if isinstance(m, Odometry):
            self._newest_odometry_ns = max(m.stamp_ns, self._newest_odometry_ns or m.stamp_ns)
        if self._newest_odometry_ns is None:
            return []
        return self._release(self._newest_odometry_ns - self._window_ns)

    def flush(self) -> list[Odometry | Observation]:
        """Release all that is queued."""
        return self._release(self._queue[-1][0] if self._queue else 0)

    def forget(self) -> None:
        """Start over, for stamps of another time."""
        self._queue.clear()
        self._recent.clear()
        self._newest_odometry_ns = self._released_ns = None

    def go_on(self, used_ns: int) -> None:
        """Go on after odometry of this stamp."""
        self._newest_odometry_ns = self._released_ns = used_ns

    def _release(self, until_ns: int) -> list[Odometry | Observation]:
        count = next((k for k, entry in enumerate(self._queue) if entry[0] > until_ns), len(self._queue))
        out, self._queue = self._queue[:count], self._queue[count:]
        if out and self._newest_odometry_ns is not None:  # what is of the future is not what others are late for
            self._released_ns = max(self._released_ns or 0, min(out[-1][0], self._newest_odometry_ns))
        return [entry[-1] for entry in out]


class PendingObservations:
    """Observations newer than all odometry. Each is pending until odometry reaches its stamp.

    Parameters
    ----------
    path : tells how far back odometry is remembered
    odometry : tells how far odometry has come
    """

    def __init__(
        self, config: OrderingConfig, path: KeyframeList, odometry: OdometrySelector, counters: Counters
    ) -> None:
        self._path, self._odometry, self._counters = path, odometry, counters
        self._max_pending = config.max_waiting
        self._pending: list[Observation] = []

    def is_reached(self, m: Observation) -> bool:
        """Return whether there is odometry before and after an observation. If not, it is pending, or it is counted."""
        newest_ns, reason = self._odometry.newest_ns, ""
        if newest_ns is None or m.stamp_ns < self._path.oldest_ns:
            reason = "before_odometry"
        elif m.stamp_ns < self._path.remembered_ns:
            reason = "late"
        elif m.stamp_ns <= newest_ns:
            if self._path.reaches(m.stamp_ns):
                return True
            reason = "odometry_gap"
        elif len(self._pending) >= self._max_pending:
            reason = "overflow"
        if reason:
            self._counters.count(m.topic, reason, size_of(m))
        else:
            self._pending.append(m)
        return False

    def reached(self, until_ns: int) -> list[Observation]:
        """Return the pending observations that odometry has reached."""
        if not self._pending:
            return []
        reached = [m for m in self._pending if m.stamp_ns <= until_ns]
        self._pending = [m for m in self._pending if m.stamp_ns > until_ns]
        return reached

    def drop(self) -> None:
        """Drop the pending observations, because no odometry follows."""
        for m in self._pending:
            self._counters.count(m.topic, "after_odometry", size_of(m))
        self._pending.clear()
