"""Thinning: measurements that come faster than their errors change are used in part, with the noise of all of them."""

from dataclasses import replace

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.types import Fix, Observation, Sightings
from graph_slam_ros.slam.frontend.keyframes import KeyframeList


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
