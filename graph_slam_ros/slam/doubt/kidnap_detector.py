"""The landmarks say that the robot is elsewhere: an alarm, which protects the map until that is decided.

While the evidence is weak, what does not fit stays held back and verdicts on the past are not changed: nothing of it
moves. When the evidence is strong, odometry's link to where the robot was moved is replaced by a loose one: a segment
begins there, at the pose that the landmarks show, and the path before it stays as it is.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.association.anonymous import AnonymousLandmarks
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.displacement import SAME_M, SAME_RAD, DisplacementSearch
from graph_slam_ros.slam.doubt.record import DOUBT, Alarm, Displacement, DisplacementHypothesis
from graph_slam_ros.slam.doubt.slip_detector import SlipDetector
from graph_slam_ros.slam.doubt.window import Window
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.revision import Replacement, Revision
from graph_slam_ros.slam.robust.connections import moved_values
from graph_slam_ros.slam.robust.ledger import Reason
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.typing import Numbers

_ALARM = 4  # sightings more for another pose than for odometry's
_ALARM_LANDMARKS, _ALARM_KEYFRAMES = 2, 2
_DECIDED = 10
_DECIDED_LANDMARKS, _DECIDED_KEYFRAMES = 3, 4  # two landmarks with headings tell as much as three without
_TRIED = 5  # sightings that are compared with odometry's noise
_MOST = 0.8  # part of the sightings since then that fit the other pose
_DRIFT = 3.0  # sigmas of odometry since a displacement
_CALM_S = 5.0  # after the decision the alarm goes on for so long at least


class KidnapDetector:
    """Detects displacements of the robot that odometry has not noticed, after each solve.

    Parameters
    ----------
    anonymous : the association of landmarks without identities

    Attributes
    ----------
    alarms : in order; the last may go on
    earlier : those of the map that it began in, as records of files
    slip_detector : detects stretches in which odometry slipped
    """

    def __init__(
        self, config: Config, backend: Backend, counters: Counters, anonymous: AnonymousLandmarks, start: MapSnapshot
    ) -> None:
        self._space, self._backend, self._counters = config.space, backend, counters
        self._path, self._anonymous, self._decides = backend.path, anonymous, config.robust.decide
        self.alarms: list[Alarm] = []
        self.earlier: list[dict[str, Any]] = start.displacements
        self._window = Window(config.space, backend)
        self._search = DisplacementSearch(config.space, backend, self._window)
        self.slip_detector = SlipDetector(config, backend, counters, self._window, anonymous.doubt)
        self._next = backend.graph.edge_ids.next
        self._decided: list[Displacement] = []  # since odometry's frame began
        self._refuted: list[Numbers] = []  # where that frame does not lie: it was decided and taken back
        self._was_doubtful = False  # the association, when the present alarm began: it is no evidence then

    @property
    def is_quiet(self) -> bool:
        """Return whether no alarm goes on."""
        return self.now is None and self.slip_detector.now is None

    def forget_before(self, first: int) -> None:
        """Forget what has left the graph with the keyframes before one, by its vertex.

        New edges took the place of others then. Of these, closures are noted.
        """
        graph = self._backend.graph
        self._window.forget_before(first)
        has = graph.edge_ids.has
        self._decided = [one for one in self._decided if one.first > first and has(one.link) and has(one.replacement)]
        for edge in graph.edge_ids.since(self._next).tolist():
            if (one := graph.edge(edge)).label == "closures":
                self._window.add_seen(edge, max(one.vertices), one.label, self._window.newest_ns)
        self._next = graph.edge_ids.next

    @property
    def now(self) -> Alarm | None:
        """The alarm that goes on."""
        return self.alarms[-1] if self.alarms and self.alarms[-1].ended_ns is None else None

    def begin_segment(self, vertex: int, stamp_ns: int) -> None:
        """A segment begins at a keyframe, by a jump or a given pose: sightings before tell nothing of where it is."""
        self._begin_anew(vertex, stamp_ns)
        self._decided.clear()
        self._refuted.clear()
        self._anonymous.keep_displacements()
        if (now := self.now) is not None:
            outcome = "then a segment began" if now.segment is None else now.outcome
            self.alarms[-1] = replace(now, ended_ns=max(stamp_ns, now.began_ns), outcome=outcome)
            self._protect()

    def add(self, end: int, stamp_ns: int) -> None:
        """Note the edges that are new, up to an id, in order, at the stamp of the newest odometry."""
        edges, self._next = range(self._next, end), end
        for edge in edges:
            self._add(edge, stamp_ns)

    def _add(self, edge: int, stamp_ns: int) -> None:
        one, window = self._backend.graph.edge(edge), self._window
        vertices, keyframes = one.vertices, self._path.keyframes
        match one.label:
            case "odometry":
                first, last = keyframes.stamps_ns[np.searchsorted(keyframes.ids, vertices)].tolist()
                if (link := window.add_odometry(edge, vertices, (first, last))) is not None:
                    self.slip_detector.add_odometry(link)
            case "surveyed":
                window.history.add_survey(vertices[0])
            case "landmarks":
                window.history.add(edge, vertices[0], vertices[1])
                window.add_seen(edge, vertices[0], vertices[1], stamp_ns)
            case "fixes":
                window.add_seen(edge, vertices[0], one.label, stamp_ns)
            case "closures":
                window.add_seen(edge, max(vertices), one.label, stamp_ns)

    def check(self, stamp_ns: int) -> None:
        """Look at the evidence after a solve.

        Parameters
        ----------
        stamp_ns : of the newest odometry
        """
        newest = int(self._path.keyframes.ids[-1])
        self._window.note_solved()
        if not self._decides:
            return
        if self.rejoin(stamp_ns):
            self._backend.decisions.reclassify(self._backend.keyframe)
        found = self._significant(newest)
        found = self._search.begun_at(found, self._anonymous.elsewhere.fits_from) if found else None
        is_decided = found is not None and self._is_decided(found)
        if self.slip_detector.check(stamp_ns, found, is_decided=is_decided):
            is_decided = False
            found = found if self.slip_detector.now is None else None  # too few landmarks say so yet: an alarm
        if found is not None and is_decided:
            if (wrong := self._refuted_by(found, newest)) is not None:
                found = found if not self._revoke(wrong, found, stamp_ns) else None
            elif not self._was_doubtful:
                found = found if not self._decide(found, stamp_ns) else None
        self._note(found, stamp_ns)
        self._protect()

    def _protect(self) -> None:
        """Keep the map as it is while it is not decided; ranges or bearings fit a wrong pose by chance, too."""
        undecided = self.now if self.now and self.now.segment is None else None
        self._backend.holds_back = undecided is not None
        self._backend.trusts_sightings = undecided is None or undecided.determines_pose

    def _significant(self, newest: int) -> DisplacementHypothesis | None:
        """Another pose for which more sightings are than chance and noise explain."""
        if self._search.held_back_count < _ALARM:
            return None
        found = self._search.hypothesis()
        if found and not all(self._search.are_apart(one, found.T_map_chain, newest) for one in self._refuted):
            return None
        return found if found and self._is_doubtful(found) and self._is_beyond_noise(found) else None

    def _note(self, found: DisplacementHypothesis | None, stamp_ns: int) -> None:
        """Begin an alarm, go on with it, or end it."""
        now, sum_of = self.now, self._window.contradiction()
        is_elsewhere = self._anonymous.elsewhere.since is not None
        is_contradicted = is_elsewhere or (sum_of is not None and sum_of.is_significant)
        evidence = found.evidence if found else 0
        if now is None and (found or is_contradicted):
            counts = (sum_of.held_back, sum_of.count) if sum_of else (0, 0)
            determines_pose = found is not None or is_elsewhere or self._search.held_back_count > 0
            self.alarms.append(Alarm(stamp_ns, evidence, None, None, 0.0, 0.0, *counts, determines_pose))
            self._was_doubtful = self._anonymous.hindsight.is_doubtful
        elif now is not None and evidence > now.evidence:
            self.alarms[-1] = replace(now, evidence=evidence)
        elif now is not None and not found and not is_contradicted and self._is_calm(now, stamp_ns):
            self.alarms[-1] = replace(now, ended_ns=stamp_ns)

    @staticmethod
    def _is_doubtful(found: DisplacementHypothesis) -> bool:
        return found.evidence >= _ALARM and found.landmarks >= _ALARM_LANDMARKS and found.keyframes >= _ALARM_KEYFRAMES

    def _is_beyond_noise(self, found: DisplacementHypothesis) -> bool:
        """Return whether it is beyond noise: else it is a loop closure that odometry's noise explains."""
        held_back = [edge for edge in found.fitting if not self._backend.ledger.is_inside(edge)]
        return self._backend.decisions.are_beyond_noise(held_back[-_TRIED:])

    @staticmethod
    def _is_decided(found: DisplacementHypothesis) -> bool:
        return (
            found.evidence >= max(_DECIDED, 2 * found.rival)
            and len(found.fitting) >= _MOST * (len(found.fitting) + len(found.contradicting))
            and found.landmarks + found.has_headings >= _DECIDED_LANDMARKS
            and found.keyframes >= _DECIDED_KEYFRAMES
        )

    def _is_calm(self, now: Alarm, stamp_ns: int) -> bool:
        """Return whether the alarm may end: where it was decided, the landmarks must have agreed for a while."""
        is_early = now.segment is not None and (stamp_ns - now.began_ns) * 1e-9 < _CALM_S
        return self._window.is_calm and not is_early

    def _decide(self, found: DisplacementHypothesis, stamp_ns: int) -> bool:
        """Begin a segment where the landmarks say that the robot is. Returns whether that can be solved."""
        keyframes, segments = self._path.keyframes, self._path.segments
        index = keyframes.first + int(np.searchsorted(keyframes.ids, found.first))
        group, before = self._space.group, self._estimate(found.first)
        motions = self._motions(found)
        there = group.compose(motions[found.first], before)
        moved = group.between(before, there)
        distance_m = float(np.linalg.norm(moved[: self._space.dimensions]))
        angle_rad = float(self._space.angle(moved))
        T_map_chain_before = group.compose(before, group.inverse(self._window.links[found.first].pose))
        graph = self._backend.graph
        given = [e for e in graph.edges_of("initialpose").tolist() if graph.edge(e).vertices[0] >= found.first]
        applied = self._backend.apply(
            DOUBT,
            lambda: Revision(
                replaced=[self._replacement(found.first, there)],
                values=moved_values(self._space, self._backend.solver, motions),
                accepted=found.fitting,
                rejected=(*found.contradicting, *given),
                reason=Reason.DISPLACED,
                evidence=found.evidence,
            ),
        )
        if applied is None:
            return False
        ((link, replacement),) = applied.replaced
        self._counters.count("odometry", "displaced")
        is_new = index not in segments  # where a pose was given, one begins already
        if is_new:
            segments.append(index)
        self._begin_anew(found.first, stamp_ns)
        self._anonymous.displaced(found.first)
        now, alarm = self.now, Alarm(stamp_ns, found.evidence, None, index, distance_m, angle_rad)
        if now is not None and now.segment is None:
            self.alarms[-1] = replace(alarm, began_ns=now.began_ns)
        else:
            if now is not None:
                self.alarms[-1] = replace(now, ended_ns=stamp_ns)
            self.alarms.append(alarm)
        self._decided.append(
            Displacement(
                found.first,
                index if is_new else None,
                link,
                replacement,
                T_map_chain_before,
                found.T_map_chain,
                self._window.links[found.first],
                len(self.alarms) - 1,
            )
        )
        return True

    def _refuted_by(self, found: DisplacementHypothesis, newest: int) -> Displacement | None:
        """The last one if the robot is where it would be without it, but for odometry's drift since it began."""
        if not self._decided or self._decided[-1].link < self._backend.first_free_edge:
            return None
        one, search = self._decided[-1], self._search
        before_m, before_rad = search.difference(one.T_map_chain_before, found.T_map_chain, newest)
        after_m, _ = search.difference(one.T_map_chain, found.T_map_chain, newest)
        drift_m, drift_rad = self._window.drift_since(one.to_first.drift, one.to_first.pose, newest)
        is_back = before_m < min(after_m, SAME_M + _DRIFT * drift_m) and before_rad < SAME_RAD + _DRIFT * drift_rad
        return one if is_back else None

    def _revoke(self, wrong: Displacement, found: DisplacementHypothesis, stamp_ns: int) -> bool:
        """Believe odometry again where the last segment begins: the landmarks show that it was right."""
        group = self._space.group
        back = group.compose(wrong.T_map_chain_before, group.inverse(wrong.T_map_chain))
        revision = Revision(
            restored=((wrong.link, wrong.replacement),),
            values=moved_values(self._space, self._backend.solver, {wrong.first: back}),
            is_judged_anew=True,
            accepted=found.fitting,
            rejected=found.contradicting,
            evidence=found.evidence,
        )
        if self._backend.apply(DOUBT, lambda: revision) is None:
            return False
        self._note_taken_back(wrong, "taken back: later sightings contradict it", stamp_ns)
        self._begin_anew(found.first, stamp_ns)
        if self.now is not None:
            self.alarms[-1] = replace(self.now, ended_ns=stamp_ns, outcome="the displacement before is taken back")
        return True

    def rejoin(self, stamp_ns: int) -> bool:
        """Believe odometry again where the explanation of all scans has no displacement. Returns whether it has one.

        The estimate is as without them already.
        """
        firsts = self._anonymous.pop_rejoined()
        free = self._backend.first_free_edge
        wrong = [one for one in self._decided if one.first in firsts and one.link >= free]
        pairs = [(one.link, one.replacement) for one in wrong]
        if not wrong or self._backend.apply(DOUBT, lambda: Revision(restored=pairs, solves="nothing")) is None:
            return False
        for one in wrong:
            self._note_taken_back(one, "taken back: without it all sightings are explained better", stamp_ns)
        self._begin_anew(self._path.keyframes[-1].vertex, stamp_ns)
        return True

    def _note_taken_back(self, one: Displacement, outcome: str, stamp_ns: int) -> None:
        self._counters.count("odometry", "displacement_taken_back")
        if one.index is not None:
            self._path.segments.remove(one.index)
        alarm = self.alarms[one.alarm]
        self.alarms[one.alarm] = replace(alarm, ended_ns=alarm.ended_ns or stamp_ns, outcome=outcome)
        self._decided.remove(one)
        one.to_first.edge = one.link
        self._refuted.append(one.T_map_chain)
        self._anonymous.rejoined(one.first)

    def _begin_anew(self, vertex: int, stamp_ns: int) -> None:
        """Compare no sighting from before a keyframe, by its vertex, with where the robot is."""
        self.slip_detector.begin(stamp_ns)
        self._window.begin(vertex)
        self._search.begin()

    def _estimate(self, vertex: int) -> Numbers:
        return tuple(self._backend.solver.estimate([vertex])[0].tolist())

    def _replacement(self, first: int, there: Numbers) -> Replacement:
        """Odometry's edge to a keyframe, the motion that the landmarks show instead, and next to no trust in it."""
        link = self._window.links[first].edge
        before = self._estimate(self._backend.graph.edge(link).vertices[0])
        motion = tuple(map(float, self._space.group.between(before, there)))
        return Replacement(link, motion, Gaussian.from_sigmas(*self._space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD)))

    def _motions(self, found: DisplacementHypothesis) -> dict[int, Numbers]:
        """Return how each keyframe from the first displaced one on is moved in map, by its vertex.

        Those before the oldest sighting that was compared stay as they are to it, which landmarks may have measured.
        """
        group, links, motions = self._space.group, self._window.links, dict[int, Numbers]()
        vertices = [vertex for vertex in links if vertex >= found.first]
        oldest = next(vertex for vertex in vertices if vertex >= found.seen_from)
        for vertex in vertices:
            at = max(vertex, oldest)
            there = group.compose(found.T_map_chain, links[at].pose)
            motions[vertex] = group.compose(there, group.inverse(self._estimate(at)))
        return motions
