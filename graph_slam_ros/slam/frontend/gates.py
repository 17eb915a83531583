"""Gates: each refuses a part of the measurements, counts it under its reason, and passes the rest to the next."""

from collections.abc import Sequence
from typing import Protocol

from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Closure, Fix, Observation
from graph_slam_ros.slam.frontend.ingest_gate import size_of
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector


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
