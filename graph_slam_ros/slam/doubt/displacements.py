"""The displacements that were decided in the present frame of odometry, and how one is taken back."""

from collections.abc import Container
from dataclasses import replace

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.displacement import SAME_M, SAME_RAD, DisplacementSearch
from graph_slam_ros.slam.doubt.record import Alarm, Displacement, DisplacementHypothesis
from graph_slam_ros.slam.landmarks.anonymous import AnonymousLandmarks
from graph_slam_ros.slam.robust.connections import moved_values
from graph_slam_ros.typing import Numbers

_DRIFT = 3.0  # sigmas
_CONTRADICTED = "taken back: later sightings contradict it"
_EXPLAINED = "taken back: without it all sightings are explained better"


class Displacements:
    """Displacements in order, since odometry's frame began.

    Parameters
    ----------
    segments : indices of the keyframes at which segments begin; one that is taken back is removed
    alarms : the outcome of one that is taken back is noted
    anonymous : told of one that is taken back, before the next solve
    """

    def __init__(
        self,
        space: Geometry,
        backend: Backend,
        search: DisplacementSearch,
        counters: Counters,
        segments: list[int],
        alarms: list[Alarm],
        anonymous: AnonymousLandmarks,
    ) -> None:
        self._space, self._backend, self._search, self._counters = space, backend, search, counters
        self._segments, self._alarms, self._anonymous = segments, alarms, anonymous
        self._decided: list[Displacement] = []
        self._refuted: list[Numbers] = []  # where the frame does not lie: it was decided and taken back

    def append(self, one: Displacement) -> None:
        """Note one that was decided."""
        self._decided.append(one)

    def clear(self) -> None:
        """Forget all: another frame of odometry begins."""
        self._decided.clear()
        self._refuted.clear()

    def forget_before(self, first: int) -> None:
        """Forget those up to a keyframe, by its vertex, and those whose edges have left the graph."""
        has = self._backend.graph.edge_ids.has
        self._decided = [one for one in self._decided if one.first > first and has(one.link) and has(one.replacement)]

    def was_refuted(self, found: DisplacementHypothesis, newest: int) -> bool:
        """Return whether a displacement to there was decided and taken back."""
        return not all(self._search.are_apart(one, found.T_map_chain, newest) for one in self._refuted)

    def refuted_by(self, found: DisplacementHypothesis, newest: int) -> Displacement | None:
        """The last one if the robot is where it would be without it, but for odometry's drift since it began."""
        if not self._decided:
            return None
        one, search = self._decided[-1], self._search
        before_m, before_rad = search.difference(one.T_map_chain_before, found.T_map_chain, newest)
        after_m, _ = search.difference(one.T_map_chain, found.T_map_chain, newest)
        drift_m, drift_rad = search.window.drift_since(one.to_first.drift, one.to_first.pose, newest)
        is_back = before_m < min(after_m, SAME_M + _DRIFT * drift_m) and before_rad < SAME_RAD + _DRIFT * drift_rad
        return one if is_back else None

    def revoke(self, one: Displacement, found: DisplacementHypothesis, keyframe: int, stamp_ns: int) -> None:
        """Believe odometry again where one begins, and sightings that show that it was right."""
        group = self._space.group
        back = group.compose(one.T_map_chain_before, group.inverse(one.T_map_chain))
        values = moved_values(self._space, self._backend.solver, {one.first: back})
        self._backend.rejoin(one.link, one.replacement, keyframe, found.evidence)
        self._backend.judge_anew(values, found, keyframe)
        self._note(one, _CONTRADICTED, stamp_ns)

    def rejoin(self, firsts: Container[int], keyframe: int, stamp_ns: int) -> bool:
        """Believe odometry again where some begin, by their vertices; the estimate is as without them already."""
        wrong = [one for one in self._decided if one.first in firsts]
        for one in wrong:
            self._backend.rejoin(one.link, one.replacement, keyframe)
            self._note(one, _EXPLAINED, stamp_ns)
        return bool(wrong)

    def _note(self, one: Displacement, outcome: str, stamp_ns: int) -> None:
        self._counters.count("odometry", "displacement_taken_back")
        if one.index is not None:
            self._segments.remove(one.index)
        alarm = self._alarms[one.alarm]
        self._alarms[one.alarm] = replace(alarm, ended_ns=alarm.ended_ns or stamp_ns, outcome=outcome)
        self._decided.remove(one)
        one.to_first.edge = one.link
        self._refuted.append(one.T_map_chain)
        self._anonymous.rejoined(one.first)
