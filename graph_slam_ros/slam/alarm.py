"""The alarm: the landmarks say that the robot is elsewhere. It protects the map until that is decided, and decides.

While the evidence is weak, what does not fit stays held back and verdicts on the past are not changed: nothing of it
moves. When the evidence is strong, odometry's link to where the robot was moved is replaced by a loose one: a segment
begins there, at the pose that the landmarks show, and the path before it stays as it is.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.graph import Gaussian
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.config import OdometryConfig
from graph_slam_ros.slam.counters import Counters
from graph_slam_ros.slam.displacement import Elsewhere, Evidence
from graph_slam_ros.slam.space import Numbers, Space

Array = NDArray[np.float64]

_ALARM = 4  # sightings more for another pose than for odometry's
_ALARM_LANDMARKS, _ALARM_KEYFRAMES = 2, 2
_DECIDED = 10
_DECIDED_LANDMARKS, _DECIDED_KEYFRAMES = 3, 4  # two landmarks with headings tell as much as three without
_TRIED = 5  # sightings that are compared with odometry's noise
_MOST = 0.8  # part of the sightings since then that fit the other pose
_MANY, _RECENT = 20, 8  # held back, of the window and in a row: an alarm whether or not they tell a pose
_CALM_S = 5.0  # after the decision the alarm goes on for so long at least


@dataclass(frozen=True, slots=True)
class Alarm:
    """A time when the landmarks said that the robot was elsewhere than odometry.

    Attributes
    ----------
    began_ns, ended_ns : stamps of keyframes; None while it goes on
    evidence : sightings more for another pose than for odometry's, at most
    segment : the keyframe, by its index, at which a segment begins since it was decided so; None where it was not
    distance_m, angle_rad : how far the robot was moved there, against odometry
    """

    began_ns: int
    evidence: int
    ended_ns: int | None = None
    segment: int | None = None
    distance_m: float = 0.0
    angle_rad: float = 0.0

    def __str__(self) -> str:
        at = f"{self.began_ns * 1e-9:.1f} s"
        if self.segment is None:
            why = f"{self.evidence} sightings more than not" if self.evidence else "most are held back"
            if self.ended_ns is None:
                return f"the landmarks say since {at} that the robot is elsewhere ({why})"
            until = f"{self.ended_ns * 1e-9:.1f} s"
            return f"from {at} to {until} the landmarks said that the robot is elsewhere ({why}); it was not so"
        moved = f"{self.distance_m:.2f} m and {np.rad2deg(self.angle_rad):.1f} degrees"
        return (
            f"the landmarks said at {at} that the robot is elsewhere, {moved} from where odometry had it: "
            f"a segment begins at keyframe {self.segment}"
        )


class Watch:
    """Watches for displacements of the robot after each solve.

    Parameters
    ----------
    segments : indices of the keyframes at which segments begin; one that begins in the past is appended

    Attributes
    ----------
    alarms : in order; the last may go on
    """

    def __init__(
        self,
        space: Space,
        odometry: OdometryConfig,
        backend: Backend,
        counters: Counters,
        segments: list[int],
    ) -> None:
        self._space, self._odometry, self._backend, self._counters = space, odometry, backend, counters
        self._segments = segments
        self.evidence = Evidence(space, backend.graph, backend.solver, backend.ledger)
        self.alarms: list[Alarm] = []

    @property
    def now(self) -> Alarm | None:
        """The alarm that goes on."""
        return self.alarms[-1] if self.alarms and self.alarms[-1].ended_ns is None else None

    def look(self, keyframe: int, vertices: NDArray[np.int64], stamps_ns: NDArray[np.int64]) -> None:
        """Look at the evidence after a solve.

        Parameters
        ----------
        keyframe : index of the newest one
        vertices, stamps_ns : of all keyframes
        """
        if not self._backend.decides:
            return
        held_back = self.evidence.held_back()
        found = self.evidence.elsewhere() if np.count_nonzero(held_back) >= _ALARM else None
        found = found if found and self._is_doubtful(found) and self._is_beyond_noise(found) else None
        if found is not None and self._is_decided(found):
            self._decide(found, keyframe, vertices, stamps_ns)
            found = None
        is_doubtful = found is not None
        is_doubtful |= sum(held_back) >= _MANY and all(held_back[-_RECENT:])
        now, stamp_ns = self.now, int(stamps_ns[keyframe])
        evidence = found.evidence if found else 0
        if is_doubtful and now is None:
            self.alarms.append(Alarm(stamp_ns, evidence))
        elif is_doubtful and now is not None:
            self.alarms[-1] = replace(now, evidence=max(now.evidence, evidence))
        elif now is not None and self._is_calm(now, stamp_ns, held_back):
            self.alarms[-1] = replace(now, ended_ns=stamp_ns)
        self._backend.holds_back = bool(is_doubtful)

    @staticmethod
    def _is_doubtful(found: Elsewhere) -> bool:
        return found.evidence >= _ALARM and found.landmarks >= _ALARM_LANDMARKS and found.keyframes >= _ALARM_KEYFRAMES

    def _is_beyond_noise(self, found: Elsewhere) -> bool:
        """Else it is a loop closure that odometry's noise explains."""
        held_back = [edge for edge in found.fitting if not self._backend.ledger.is_inside(edge)]
        return self._backend.decisions.are_beyond_noise(held_back[-_TRIED:])

    @staticmethod
    def _is_decided(found: Elsewhere) -> bool:
        return (
            found.evidence >= max(_DECIDED, 2 * found.rival)
            and len(found.fitting) >= _MOST * (len(found.fitting) + len(found.contradicting))
            and found.landmarks + found.has_headings >= _DECIDED_LANDMARKS
            and found.keyframes >= _DECIDED_KEYFRAMES
        )

    @staticmethod
    def _is_calm(now: Alarm, stamp_ns: int, held_back: list[bool]) -> bool:
        """Where it was decided, the landmarks must have agreed for a while."""
        if now.segment is None:
            return True
        return (stamp_ns - now.began_ns) * 1e-9 >= _CALM_S and not any(held_back[-_RECENT:])

    def _decide(
        self, found: Elsewhere, keyframe: int, vertices: NDArray[np.int64], stamps_ns: NDArray[np.int64]
    ) -> None:
        """Begin a segment where the landmarks say that the robot is."""
        index = int(np.searchsorted(vertices, found.first))
        group, before = self._space.group, self._estimate(found.first)
        there = group.compose(found.T_map_chain, self.evidence.chain(found.first))
        moved = group.between(before, there)
        distance_m = float(np.linalg.norm(moved[: self._space.dimensions]))
        angle_rad = float(self._space.angle(moved))
        self._backend.part(
            self._loose(found.first, there),
            self.evidence.initial_poses(found.first),
            self._moved(found),
            found,
            keyframe,
        )
        self._counters.count("odometry", "displaced")
        if index not in self._segments:  # where a pose was given, one begins already
            self._segments.append(index)
        self.evidence.begin(found.first)
        stamp_ns = int(stamps_ns[keyframe])
        now = self.now
        began_ns = now.began_ns if now is not None else stamp_ns
        alarm = Alarm(began_ns, found.evidence, None, index, distance_m, angle_rad)
        if now is not None and now.segment is None:
            self.alarms[-1] = alarm
        else:
            if now is not None:
                self.alarms[-1] = replace(now, ended_ns=stamp_ns)
            self.alarms.append(replace(alarm, began_ns=stamp_ns))

    def _estimate(self, vertex: int) -> Numbers:
        return tuple(self._backend.solver.estimate([vertex])[0].tolist())

    def _loose(self, first: int, there: Numbers) -> tuple[int, Numbers, Gaussian]:
        """Odometry's edge to a keyframe, the motion that the landmarks show instead, and next to no trust in it."""
        link, c = self.evidence.link(first), self._odometry
        table, row = self._backend.graph.row(link)
        before = self._estimate(int(table.vertices.values[row, 0]))
        motion = tuple(map(float, self._space.group.between(before, there)))
        return link, motion, Gaussian.from_sigmas(*self._space.sigmas(c.jump_sigma_m, c.jump_sigma_rad))

    def _moved(self, found: Elsewhere) -> Array:
        """The stored numbers of all vertices, with the robot and what it saw first since then where it is now."""
        graph, solver, space = self._backend.graph, self._backend.solver, self._space
        values, keyframes = solver.values, self.evidence.chained(found.first)
        motions = {}
        for vertex in keyframes:
            at = int(graph.offset.values[vertex])
            before = tuple(values[at : at + space.pose.size].tolist())
            there = space.group.compose(found.T_map_chain, self.evidence.chain(vertex))
            motions[vertex] = space.group.compose(there, space.group.inverse(before))
            values[at : at + space.pose.size] = there
        newest = found.first
        for vertex in range(found.first, graph.vertex_count):
            newest = vertex if vertex in motions else newest
            at, kind = int(graph.offset.values[vertex]), graph.kind_of(vertex)
            numbers = tuple(values[at : at + kind.size].tolist())
            if vertex in motions:
                continue
            if kind is space.pose:
                values[at : at + kind.size] = space.group.compose(motions[newest], numbers)
            elif kind is space.point:
                values[at : at + kind.size] = space.group.act(motions[newest], numbers)
        return values
