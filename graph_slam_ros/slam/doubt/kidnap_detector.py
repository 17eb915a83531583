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
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.displacement import DisplacementSearch
from graph_slam_ros.slam.doubt.displacements import Displacements
from graph_slam_ros.slam.doubt.evidence import Moved
from graph_slam_ros.slam.doubt.record import Alarm, Displacement, DisplacementHypothesis, Slip
from graph_slam_ros.slam.doubt.slip_detector import SlipDetector
from graph_slam_ros.slam.doubt.window import Window
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.anonymous import AnonymousLandmarks
from graph_slam_ros.slam.robust.connections import moved_values
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver import Report, Settings
from graph_slam_ros.typing import Numbers

_ALARM = 4  # sightings more for another pose than for odometry's
_ALARM_LANDMARKS, _ALARM_KEYFRAMES = 2, 2
_DECIDED = 10
_DECIDED_LANDMARKS, _DECIDED_KEYFRAMES = 3, 4  # two landmarks with headings tell as much as three without
_TRIED = 5  # sightings that are compared with odometry's noise
_MOST = 0.8  # part of the sightings since then that fit the other pose
_CALM_S = 5.0  # after the decision the alarm goes on for so long at least


class KidnapDetector:
    """Detects displacements of the robot that odometry has not noticed, after each solve.

    Parameters
    ----------
    segments : indices of the keyframes at which segments begin; one that begins in the past is appended
    anonymous : the association of landmarks without identities

    Attributes
    ----------
    alarms : in order; the last may go on
    earlier : those of the map that it began in, as records of files
    """

    def __init__(
        self,
        config: Config,
        backend: Backend,
        counters: Counters,
        segments: list[int],
        anonymous: AnonymousLandmarks,
        start: MapSnapshot | None = None,
    ) -> None:
        self._space, self._backend, self._counters = config.space, backend, counters
        self._segments, self._anonymous = segments, anonymous
        self.alarms: list[Alarm] = []
        self.earlier: list[dict[str, Any]] = start.displacements if start else []
        self._window = Window(config.space, backend)
        self._search = DisplacementSearch(config.space, backend, self._window)
        self._slips = SlipDetector(config.space, config.odometry, backend, counters, self._window, anonymous.doubt)
        self._next = backend.graph.edge_ids.next
        self._decided = Displacements(config.space, backend, self._search, counters, segments, self.alarms, anonymous)
        self._was_doubtful = False  # the association, when the present alarm began: it is no evidence then

    @property
    def is_quiet(self) -> bool:
        """Return whether no alarm goes on."""
        return self.now is None and self.slips_now is None

    def forget_before(self, first: int) -> None:
        """Forget what has left the graph with the keyframes before one, by its vertex.

        New edges took the place of others then. Of these, closures are noted.
        """
        graph = self._backend.graph
        self._window.forget_before(first)
        self._decided.forget_before(first)
        for edge in graph.edge_ids.since(self._next).tolist():
            if (one := graph.edge(edge)).label == "closures":
                self._window.add_seen(edge, max(one.vertices), one.label, self._window.newest_ns)
        self._next = graph.edge_ids.next

    @property
    def slips(self) -> list[Slip]:
        """The stretches in which odometry slipped, in order; the last may go on."""
        return self._slips.slips

    @property
    def slips_now(self) -> Slip | None:
        """The slip that goes on."""
        return self._slips.now

    @property
    def now(self) -> Alarm | None:
        """The alarm that goes on."""
        return self.alarms[-1] if self.alarms and self.alarms[-1].ended_ns is None else None

    def begin_segment(self, vertex: int, stamp_ns: int) -> None:
        """A segment begins at a keyframe, by a jump or a given pose: sightings before tell nothing of where it is."""
        self._begin_anew(vertex, stamp_ns)
        self._decided.clear()
        self._anonymous.keep_displacements()
        if (now := self.now) is not None:
            outcome = "then a segment began" if now.segment is None else now.outcome
            self.alarms[-1] = replace(now, ended_ns=max(stamp_ns, now.began_ns), outcome=outcome)
            self._protect()

    def add(self, end: int, stamp_ns: int, keyframes: StampedPoses[Keyframe]) -> None:
        """Note the edges that are new, up to an id, in order, at the stamp of the newest odometry."""
        edges, self._next = range(self._next, end), end
        for edge in edges:
            self._add(edge, stamp_ns, keyframes)

    def _add(self, edge: int, stamp_ns: int, keyframes: StampedPoses[Keyframe]) -> None:
        one, window = self._backend.graph.edge(edge), self._window
        vertices = one.vertices
        match one.label:
            case "odometry":
                first, last = keyframes.stamps_ns[np.searchsorted(keyframes.ids, vertices)].tolist()
                if (link := window.add_odometry(edge, vertices, (first, last))) is not None:
                    self._slips.add_odometry(link, len(keyframes) - 1)
            case "surveyed":
                window.history.add_survey(vertices[0])
            case "landmarks":
                window.history.add(edge, vertices[0], vertices[1])
                window.add_seen(edge, vertices[0], vertices[1], stamp_ns)
            case "fixes":
                window.add_seen(edge, vertices[0], one.label, stamp_ns)
            case "closures":
                window.add_seen(edge, max(vertices), one.label, stamp_ns)

    def check(self, keyframes: StampedPoses[Keyframe], stamp_ns: int) -> None:
        """Look at the evidence after a solve.

        Parameters
        ----------
        stamp_ns : of the newest odometry
        """
        vertices = keyframes.ids
        self._window.note_solved()
        if not self._backend.decides:
            return
        if self._rejoin(keyframes, stamp_ns):
            self._backend.decisions.reclassify(len(keyframes) - 1)
        found = self._significant(int(vertices[-1]))
        found = found and self._search.begun_at(found, self._anonymous.elsewhere.fits_from)
        is_decided = found is not None and self._is_decided(found)
        if self._slips.check(keyframes, stamp_ns, self._moved_to(found), is_decided=is_decided):
            is_decided = False
            found = found if self.slips_now is None else None  # too few landmarks say so yet: an alarm
        if found is not None and is_decided:
            if (wrong := self._decided.refuted_by(found, int(vertices[-1]))) is not None:
                self._revoke(wrong, found, len(keyframes) - 1, stamp_ns)
                found = None
            elif not self._was_doubtful:
                self._decide(found, keyframes, stamp_ns)
                found = None
        self._note(found, stamp_ns)
        self._protect()

    def optimize(self, keyframes: StampedPoses[Keyframe], settings: Settings) -> Report:
        """Solve everything, and take back the slips that this contradicts."""
        self._rejoin(keyframes, keyframes[-1].stamp_ns)
        report = self._backend.optimize(len(keyframes) - 1, settings)
        if self._slips.slips and self._slips.review(keyframes):
            report = self._backend.optimize(len(keyframes) - 1, settings)
        return report

    def slipped(self, keyframes: StampedPoses[Keyframe]) -> tuple[tuple[tuple[int, int], ...], ...]:
        """The edges of odometry of each slip, each with the one that replaces it."""
        return self._slips.slipped(keyframes)

    def _moved_to(self, found: DisplacementHypothesis | None) -> Moved | None:
        """The place to which the robot was moved, if it was."""
        if found is None:
            return None
        T_map_chain = found.T_map_chain
        return Moved(
            found.first, lambda vertex: self._space.group.compose(T_map_chain, self._window.links[vertex].pose)
        )

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
        if found and self._decided.was_refuted(found, newest):
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

    def _decide(self, found: DisplacementHypothesis, keyframes: StampedPoses[Keyframe], stamp_ns: int) -> None:
        """Begin a segment where the landmarks say that the robot is."""
        index = keyframes.first + int(np.searchsorted(keyframes.ids, found.first))
        group, before = self._space.group, self._estimate(found.first)
        motions = self._motions(found)
        there = group.compose(motions[found.first], before)
        moved = group.between(before, there)
        distance_m = float(np.linalg.norm(moved[: self._space.dimensions]))
        angle_rad = float(self._space.angle(moved))
        T_map_chain_before = group.compose(before, group.inverse(self._window.links[found.first].pose))
        graph, (link, motion, noise) = self._backend.graph, self._replacement(found.first, there)
        replacement = self._backend.split(
            (link, motion, noise),
            [edge for edge in graph.edges_of("initialpose").tolist() if graph.edge(edge).vertices[0] >= found.first],
            moved_values(self._space, self._backend.solver, motions),
            found,
            len(keyframes) - 1,
        )
        self._counters.count("odometry", "displaced")
        is_new = index not in self._segments  # where a pose was given, one begins already
        if is_new:
            self._segments.append(index)
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

    def _revoke(self, wrong: Displacement, found: DisplacementHypothesis, keyframe: int, stamp_ns: int) -> None:
        """Believe odometry again where the last segment begins: the landmarks show that it was right."""
        self._decided.revoke(wrong, found, keyframe, stamp_ns)
        self._begin_anew(found.first, stamp_ns)
        if self.now is not None:
            self.alarms[-1] = replace(self.now, ended_ns=stamp_ns, outcome="the displacement before is taken back")

    def _rejoin(self, keyframes: StampedPoses[Keyframe], stamp_ns: int) -> bool:
        """Believe odometry again where the explanation of all scans has no displacement. Returns whether it has one."""
        firsts = self._anonymous.pop_rejoined()
        if not firsts or not self._decided.rejoin(firsts, len(keyframes) - 1, stamp_ns):
            return False
        self._begin_anew(keyframes[-1].vertex, stamp_ns)
        return True

    def _begin_anew(self, vertex: int, stamp_ns: int) -> None:
        """Compare no sighting from before a keyframe, by its vertex, with where the robot is."""
        self._slips.begin(stamp_ns)
        self._window.begin(vertex)
        self._search.begin()

    def _estimate(self, vertex: int) -> Numbers:
        return tuple(self._backend.solver.estimate([vertex])[0].tolist())

    def _replacement(self, first: int, there: Numbers) -> tuple[int, Numbers, Gaussian]:
        """Odometry's edge to a keyframe, the motion that the landmarks show instead, and next to no trust in it."""
        link = self._window.links[first].edge
        before = self._estimate(self._backend.graph.edge(link).vertices[0])
        motion = tuple(map(float, self._space.group.between(before, there)))
        return link, motion, Gaussian.from_sigmas(*self._space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD))

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
