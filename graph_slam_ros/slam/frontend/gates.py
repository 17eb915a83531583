"""Gates: what an observation passes before it is used. Each counts what it refuses, under its reason."""

import math
from dataclasses import replace

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Closure, Fix, Observation, Sighting, Sightings
from graph_slam_ros.slam.frontend.ingest_gate import size_of
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector

_MOST_M = 1e5  # of an input without a limit: farther than from any sensor to its horizon


class Gates:
    """Refuses fixes from elsewhere on earth, closures from unknown stamps, what is too far away, and repetitions.

    Parameters
    ----------
    path : tells whether the robot rests
    datum : latitude, longitude and height that the fixes of the map are from; empty: the first fix tells
    """

    def __init__(
        self,
        config: Config,
        path: KeyframeList,
        odometry: OdometrySelector,
        counters: Counters,
        datum: tuple[float, ...] = (),
    ) -> None:
        self._space, self._path, self._odometry, self._counters = config.space, path, odometry, counters
        self._limit_m = {one.name: one.max_distance_m for one in config.sources if one.max_distance_m > 0.0}
        self._lasting_ns = {one.name: round(2e9 * one.correlation_s) for one in config.sources}
        self._most_ns = round(1e9 * config.keyframes.max_interval_s)
        self.datum = datum
        self._used_ns: dict[str, int] = {}
        self._observed_ns: dict[str, int] = {}

    def forget_time(self) -> None:
        """Start over with the stamps."""
        self._used_ns.clear()
        self._observed_ns.clear()

    @property
    def state(self) -> list[dict[str, int]]:
        """The stamps by input of what was used last, to ``go_on`` with."""
        return [dict(self._used_ns), dict(self._observed_ns)]

    def go_on(self, state: list[dict[str, int]]) -> None:
        """Take over what another one has used."""
        self._used_ns, self._observed_ns = state

    def accepts(self, m: Observation) -> bool:
        """Return whether what arrives may be queued: not a fix that counts from another origin than the map."""
        if isinstance(m, Fix):
            self.datum = self.datum or m.datum
            if m.datum and m.datum != self.datum:
                self._refuse(m, "other_datum")
                return False
        return True

    def admit(self, m: Observation) -> Observation | None:
        """Return the part of an observation that is to be used, or None."""
        match m:
            case Closure():
                return self._closure(m)
            case Sightings():
                return self._sightings(m)
            case Fix():
                return self._thinned(m)

    def _refuse(self, m: Observation, reason: str) -> None:
        self._counters.count(m.topic, reason, size_of(m))

    def _closure(self, m: Closure) -> Closure | None:
        """Refuse a loop closure from a stamp outside the time that odometry covers, or from too far away."""
        oldest_ns, newest_ns = self._path.oldest_ns, self._odometry.newest_ns or 0
        if not oldest_ns <= m.from_stamp_ns <= newest_ns:
            is_left = self._path.keyframes.first > 0 and m.from_stamp_ns < oldest_ns
            self._refuse(m, "from_condensed_keyframe" if is_left else "from_where_there_was_no_odometry")
            return None
        if not self._is_within(m.topic, math.hypot(*m.T_from_base[: self._space.dimensions])):
            self._refuse(m, "beyond_max_distance")
            return None
        return m

    def _sightings(self, m: Sightings) -> Sightings | None:
        within = tuple(s for s in m.sightings if self._is_within(m.topic, self._distance(s)))
        if refused := len(m.sightings) - len(within):
            self._counters.count(m.topic, "beyond_max_distance", refused)
            if not within:
                return None
            m = replace(m, sightings=within)
        if self._is_repeated(m):
            self._refuse(m, "thinned")
            return None
        return m

    def _distance(self, s: Sighting) -> float:
        """Return the distance from the sensor; of a position or pose, from the base; a bearing has none."""
        if s.kind in ("position", "pose"):
            return math.hypot(*s.measured[: self._space.dimensions])
        return 0.0 if s.kind == "bearing" else abs(s.measured[0])

    def _is_within(self, topic: str, distance_m: float) -> bool:
        return distance_m <= self._limit_m.get(topic, _MOST_M)

    def _is_repeated(self, m: Sightings) -> bool:
        """Return whether the robot rests and has just observed: another observation would have the same errors."""
        before_ns = self._observed_ns.get(m.topic)
        if self._path.rests and before_ns is not None and 0 <= m.stamp_ns - before_ns < self._most_ns:
            return True
        self._observed_ns[m.topic] = m.stamp_ns
        return False

    def _thinned(self, m: Fix) -> Fix | None:
        """Return a fix as it is to be used; None if an earlier one has its information.

        Errors that are correlated over tau (exponentially) leave n fixes over a long time T with the information of
        T / (2 tau) independent ones. So one fix every 2 tau has as much information as all. Fixes d < 2 tau apart have
        as much if each has 2 tau / d times the variance.
        """
        lasting_ns, before_ns = self._lasting_ns.get(m.topic, 0), self._used_ns.get(m.topic)
        interval_ns = lasting_ns if before_ns is None else abs(m.stamp_ns - before_ns)
        if interval_ns < min(lasting_ns, self._most_ns):
            self._refuse(m, "thinned")
            return None
        self._used_ns[m.topic] = max(m.stamp_ns, before_ns or 0)
        if interval_ns >= lasting_ns:
            return m
        return replace(m, covariance=tuple(variance * (lasting_ns / interval_ns) for variance in m.covariance))
