"""Time alignment: measurements in order of stamp, and each observation once odometry has reached its stamp."""

from graph_slam_ros.config.frontend import OrderingConfig
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Closure, Observation, Odometry
from graph_slam_ros.slam.frontend.ingest_gate import size_of
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector
from graph_slam_ros.slam.frontend.stamp_order import StampOrder


class TimeAlignment:
    """Releases measurements in order of stamp; an observation newer than all odometry waits for the next.

    Parameters
    ----------
    path : tells how far back odometry is remembered
    odometry : tells how far odometry has come
    """

    def __init__(
        self, config: OrderingConfig, path: KeyframeList, odometry: OdometrySelector, counters: Counters
    ) -> None:
        self._order = StampOrder(config, counters)
        self._path, self._odometry, self._counters = path, odometry, counters
        self._max_pending = config.max_waiting
        self._pending: list[Observation] = []

    def accepts(self, m: Odometry | Observation) -> bool:
        """Return whether a measurement may be pushed; else it is counted."""
        return self._order.accepts(m)

    def push(self, m: Odometry | Observation) -> list[Odometry | Observation]:
        """Add one measurement; returns those whose turn has come."""
        return self._order.push(m)

    def flush(self) -> list[Odometry | Observation]:
        """Release everything that waits for its turn."""
        return self._order.flush()

    def is_reached(self, m: Observation) -> bool:
        """Return whether odometry surrounds an observation; else it waits for the next, or is counted."""
        newest_ns, reason = self._odometry.newest_ns, ""
        if newest_ns is None or m.stamp_ns < self._path.oldest_ns:
            reason = "before_odometry"
        elif m.stamp_ns < self._path.remembered_ns:
            reason = "late"
        elif m.stamp_ns <= newest_ns:
            return True
        elif len(self._pending) >= self._max_pending:
            reason = "overflow"
        if reason:
            self._counters.count(m.topic, reason, size_of(m))
        else:
            self._pending.append(m)
        return False

    def reached(self, until_ns: int) -> list[Observation]:
        """The observations that waited for odometry to come so far."""
        if not self._pending:
            return []
        reached = [m for m in self._pending if m.stamp_ns <= until_ns]
        self._pending = [m for m in self._pending if m.stamp_ns > until_ns]
        return reached

    def drop_pending(self) -> None:
        """No odometry comes any more for those that wait."""
        for m in self._pending:
            self._counters.count(m.topic, "after_odometry", size_of(m))
        self._pending.clear()

    def forget(self) -> None:
        """Begin anew with stamps of another time."""
        self._order.forget()


class ClosureStart:
    """Refuses a loop closure whose earlier stamp lies before or after all odometry."""

    reason = "from_where_there_was_no_odometry"

    def __init__(self, path: KeyframeList, odometry: OdometrySelector) -> None:
        self._path, self._odometry = path, odometry

    def admit(self, m: Observation) -> Observation | None:
        """The observation, unless it is such a closure."""
        if isinstance(m, Closure) and not self._path.oldest_ns <= m.from_stamp_ns <= (self._odometry.newest_ns or 0):
            return None
        return m
