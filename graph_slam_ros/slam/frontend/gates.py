"""Gates: each refuses a part of the measurements, counts it under its reason, and passes the rest to the next."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Protocol

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Closure, Fix, Observation, Sighting, Sightings
from graph_slam_ros.slam.frontend.ingest_gate import size_of
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector

_MOST_M = 1e5  # of an input without a limit: farther than from any sensor to its horizon


class Gate(Protocol):
    """A check of what arrives."""

    @property
    def reason(self) -> str:
        """The reason under which refused measurements are counted."""

    def admit(self, m: Observation) -> Observation | None:
        """Return the part that passes, or None."""


class GateChain:
    """Several gates, applied in order."""

    def __init__(self, gates: Sequence[Gate], counters: Counters) -> None:
        self._gates, self._counters = gates, counters

    def admit(self, m: Observation) -> Observation | None:
        """Return the part that passes all gates, or None."""
        for gate in self._gates:
            passed = gate.admit(m)
            refused = size_of(m) - (size_of(passed) if passed is not None else 0)
            if refused or passed is None:
                self._counters.count(m.topic, gate.reason, refused)
            if passed is None:
                return None
            m = passed
        return m


class DatumGate:
    """Refuses fixes that are far away on earth from all other fixes of the map.

    Parameters
    ----------
    datum : latitude, longitude and height that the fixes of the map are from; empty: the first fix tells
    """

    reason = "other_datum"

    def __init__(self, datum: tuple[float, ...] = ()) -> None:
        self.datum = datum

    def admit(self, m: Observation) -> Observation | None:
        """Return the observation, or None for such a fix."""
        if isinstance(m, Fix):
            self.datum = self.datum or m.datum
            if m.datum and m.datum != self.datum:
                return None
        return m


class ClosureStart:
    """Refuses a loop closure from a stamp outside the time that odometry covers."""

    def __init__(self, path: KeyframeList, odometry: OdometrySelector) -> None:
        self._path, self._odometry = path, odometry
        self.reason = ""

    def admit(self, m: Observation) -> Observation | None:
        """Return the observation, or None for such a closure."""
        if not isinstance(m, Closure):
            return m
        oldest_ns = self._path.oldest_ns
        is_left = self._path.keyframes.first > 0 and m.from_stamp_ns < oldest_ns
        reason = "from_condensed_keyframe" if is_left else "from_where_there_was_no_odometry"
        self.reason = reason
        return m if oldest_ns <= m.from_stamp_ns <= (self._odometry.newest_ns or 0) else None


class MaxDistance:
    """Gate for the largest distance [m] of each input.

    A bearing has no distance. A fix has one only from the map's origin, which may be anywhere.
    """

    reason = "beyond_max_distance"

    def __init__(self, space: Geometry, inputs: Iterable[InputConfig]) -> None:
        self._space = space
        self._limit_m = {one.name: one.max_distance_m for one in inputs if one.max_distance_m > 0.0}

    def admit(self, m: Observation) -> Observation | None:
        """Return the part of an observation within the limit, or None."""
        match m:
            case Sightings():
                within = tuple(s for s in m.sightings if self._is_within(m.topic, self._distance(s)))
                if len(within) == len(m.sightings):
                    return m
                return replace(m, sightings=within) if within else None
            case Closure():
                return m if self._is_within(m.topic, math.hypot(*m.T_from_base[: self._space.dimensions])) else None
            case _:
                return m

    def _distance(self, s: Sighting) -> float | None:
        """Return the distance from the sensor; of a position or pose, from the base."""
        if s.kind in ("position", "pose"):
            return math.hypot(*s.measured[: self._space.dimensions])
        return None if s.kind == "bearing" else abs(s.measured[0])

    def _is_within(self, topic: str, distance_m: float | None) -> bool:
        return distance_m is None or distance_m <= self._limit_m.get(topic, _MOST_M)


class ObservationThinning:
    """Gate that thins out fixes, and what a robot at rest sees, by their stamps, for each input.

    Errors that are correlated over tau (exponentially) leave n fixes over a long time T with the information of
    T / (2 tau) independent ones. So one fix every 2 tau has as much information as all. Fixes d < 2 tau apart have as
    much if each has 2 tau / d times the variance.

    Parameters
    ----------
    path : tells whether the robot rests
    """

    reason = "thinned"

    def __init__(self, config: Config, path: KeyframeList) -> None:
        self._lasting_ns = {one.name: round(2e9 * one.correlation_s) for one in config.sources}
        self._most_ns = round(1e9 * config.keyframes.max_interval_s)
        self._path = path
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

    def admit(self, m: Observation) -> Observation | None:
        """Return the observation as it is to be used; None if an earlier one has its information."""
        match m:
            case Sightings():
                return None if self._is_repeated(m) else m
            case Fix():
                return self._thinned(m)
            case _:
                return m

    def _is_repeated(self, m: Sightings) -> bool:
        """Return whether the robot rests and has just observed: another observation would have the same errors."""
        before_ns = self._observed_ns.get(m.topic)
        if self._path.rests and before_ns is not None and 0 <= m.stamp_ns - before_ns < self._most_ns:
            return True
        self._observed_ns[m.topic] = m.stamp_ns
        return False

    def _thinned(self, m: Fix) -> Fix | None:
        lasting_ns, before_ns = self._lasting_ns.get(m.topic, 0), self._used_ns.get(m.topic)
        interval_ns = lasting_ns if before_ns is None else abs(m.stamp_ns - before_ns)
        if interval_ns < min(lasting_ns, self._most_ns):
            return None
        self._used_ns[m.topic] = max(m.stamp_ns, before_ns or 0)
        if interval_ns >= lasting_ns:
            return m
        return replace(m, covariance=tuple(variance * (lasting_ns / interval_ns) for variance in m.covariance))
