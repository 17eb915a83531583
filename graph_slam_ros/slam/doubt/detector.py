"""What was seen doubts odometry: the robot slipped, or is elsewhere.

Each solve is followed by a look at the newest views, where a view is all that was measured from one keyframe. If they
contradict odometry, hypotheses are compared: odometry is as stated; its way or its turning has larger errors from a
keyframe on; the robot was moved at one, to the pose that the landmarks show. A slip must be likelier than none without
any one landmark, too. Then edges with more noise replace those of the stretch, until odometry as stated is as likely
again. A robot that was moved needs enough landmarks that agree. Then a loose edge replaces odometry's to where it was
moved: a segment begins there, and the path before it stays as it is. Until that is decided, what does not fit stays
held back, and nothing of the past moves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.association.anonymous import AnonymousLandmarks
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.connections import moved_values
from graph_slam_ros.slam.doubt.displacement import DisplacementSearch
from graph_slam_ros.slam.doubt.evidence import (
    LOG_ODDS,
    LOG_ODDS_MOVED,
    Hypothesis,
    Stretch,
    covariance_of,
    measured_noise,
)
from graph_slam_ros.slam.doubt.odometry_errors import OdometryErrors, between
from graph_slam_ros.slam.doubt.record import (
    DOUBT,
    ELSEWHERE,
    SLIPS,
    Displacement,
    DisplacementHypothesis,
    Doubt,
    Link,
)
from graph_slam_ros.slam.doubt.window import View, Window
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.slam.levels import ENOUGH, SAME_M, SAME_RAD
from graph_slam_ros.slam.revision import Replacement, Revision
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.typing import Array, Numbers

_SINCE = (1, 2, 4, 6, 8, 12, 16)  # views before which a slip may have begun; before the last three, ended
_VIEWS, _MOST_EDGES = _SINCE[-1] + 1, 60  # newest ones that are compared
_PART = 0.05  # of the views cause a comparison at most, but for so many that follow one another:
_BURST = 20.0  # comparisons one after the other, as at the begin of a slip
_EVERY, _MORE = 100, 0.2  # keyframes since noise was measured, and as a part of those then: all is looked at
_SLIP = 0.35  # m/s, rad/s: sigmas of what odometry does not notice: some of an indoor robot's speeds
_LASTS_S = 0.5  # correlation time of the errors of a slip
_LONGEST_S = 1.0  # of one edge; wheels that stand longer do not slip: the robot was carried
_THRESHOLD = -2.0 * LOG_ODDS  # that the evidence of a slip is compared with
_OTHERS = 1.0 / 3.0  # sigma along the other axes, relative to the first
_ALARM = 4  # sightings more for another pose than for odometry's
_ALARM_FROM = 2  # landmarks, and keyframes: one landmark that moved, or one bad image, is no alarm
_DECIDED = 10  # sightings more, and twice those for a third pose
_DECIDED_KEYFRAMES = 4  # and enough landmarks: two with headings tell as much as three without
_TRIED = 5  # sightings that are compared with odometry's noise
_MOST = 0.8  # part of the sightings since then that fit the other pose
_DRIFT = 3.0  # sigmas of odometry since a displacement
_CALM_S = 5.0  # after the decision the alarm goes on for so long at least

Pair = tuple[int, int]
"""An edge of odometry that slipped, and the one that replaces it."""

SeenOf = Mapping[int, Sequence[tuple[int, int | str]]]


class OdometryDoubt:
    """Doubts odometry by what was seen, after each solve, and changes its edges where that is decided.

    Parameters
    ----------
    anonymous : the association of landmarks without identities

    Attributes
    ----------
    doubts : in the order in which they were noted; the last of each kind may go on
    earlier : those of the map that it began in, as records of files
    """

    def __init__(
        self, config: Config, backend: Backend, counters: Counters, anonymous: AnonymousLandmarks, start: MapSnapshot
    ) -> None:
        self._space, self._backend, self._counters = config.space, backend, counters
        self._path, self._anonymous = backend.path, anonymous
        self._decides, self._finds_slips = config.robust.decide, config.odometry.doubt
        self.doubts: list[Doubt] = []
        self.earlier: list[dict[str, Any]] = start.displacements
        self._window = Window(config.space, backend)
        self._search = DisplacementSearch(config.space, backend, self._window)
        self._next = backend.graph.edge_ids.next
        self._compared: View | None = None  # the newest view that was compared
        self._allowed = _BURST
        self._noise_due, self._noise = 0.0, (np.ones(config.space.dof), 1.0)
        self._wider = dict[int, int]()  # of edges of odometry that slipped: those that replace them
        self._decided: list[Displacement] = []  # since odometry's frame began
        self._refuted: list[Numbers] = []  # where that frame does not lie: it was decided and taken back
        self._was_doubtful = False  # the association, when the present alarm began: it is no evidence then

    # -- what goes on ------------------------------------------------------------------------------------------------

    def _last(self, *kinds: str) -> int | None:
        """The index of the last doubt of some kinds if it goes on."""
        of_kinds = [k for k, one in enumerate(self.doubts) if one.kind in kinds]
        return of_kinds[-1] if of_kinds and self.doubts[of_kinds[-1]].ended_ns is None else None

    @property
    def now(self) -> Doubt | None:
        """The doubt that goes on, that the robot is elsewhere before a slip."""
        going_on = [k for k in (self._last(ELSEWHERE), self._last(*SLIPS)) if k is not None]
        return self.doubts[going_on[0]] if going_on else None

    def _change(self, k: int, **changes: Any) -> None:
        self.doubts[k] = replace(self.doubts[k], **changes)

    def slipped(self) -> tuple[tuple[Pair, ...], ...]:
        """The edges of odometry of each stretch that slipped, each with the one that replaces it."""
        graph, ledger, first = self._backend.graph, self._backend.ledger, self._backend.first_free_edge
        has = graph.edge_ids.has
        there = [(own, used) for own, used in sorted(self._wider.items()) if own >= first and has(own) and has(used)]
        pairs = [pair for pair in there if ledger.verdict_of(pair[1]) is not Verdict.REJECTED]
        begins = {graph.edge(own).vertices[0] for own, _ in pairs} - {graph.edge(own).vertices[1] for own, _ in pairs}
        out = list[list[Pair]]()
        for own, used in pairs:
            if graph.edge(own).vertices[0] in begins:
                out.append([])
            out[-1].append((own, used))
        return tuple(map(tuple, out))

    # -- what came ---------------------------------------------------------------------------------------------------

    def begin_segment(self, vertex: int, stamp_ns: int) -> None:
        """A segment begins at a keyframe, by a jump or a given pose: sightings before tell nothing of where it is."""
        self._begin_anew(vertex, stamp_ns)
        self._decided.clear()
        self._refuted.clear()
        self._anonymous.keep_displacements()
        if (k := self._last(ELSEWHERE)) is not None:
            now = self.doubts[k]
            outcome = "then a segment began" if now.segment is None else now.outcome
            self._change(k, ended_ns=max(stamp_ns, now.began_ns), outcome=outcome)
            self._protect()

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
                link, slip = window.add_odometry(edge, vertices, (first, last)), self._last(*SLIPS)
                if link is not None and slip is not None:
                    self.doubts[slip] = self._widened([link], self.doubts[slip], Revision(solves="nothing"))
            case "surveyed":
                window.add_survey(vertices[0])
            case "landmarks":
                window.add_seen(edge, vertices[0], vertices[1], stamp_ns)
            case "fixes" | "closures":
                window.add_seen(edge, max(vertices), one.label, stamp_ns)

    def _begin_anew(self, vertex: int, stamp_ns: int) -> None:
        """Compare no sighting from before a keyframe, by its vertex, with where the robot is; a slip has ended."""
        if (k := self._last(*SLIPS)) is not None:
            self._change(k, ended_ns=max(stamp_ns, self.doubts[k].began_ns))
            self._anonymous.doubt(stamp_ns, None)
        self._window.begin(vertex)

    # -- what it tells -----------------------------------------------------------------------------------------------

    def check(self, stamp_ns: int) -> None:
        """Look at the evidence after a solve.

        Parameters
        ----------
        stamp_ns : of the newest odometry
        """
        self._window.note_solved()
        if not self._decides:
            return
        if self.rejoin(stamp_ns):
            self._backend.decisions.reclassify(self._backend.keyframe)
        newest = int(self._path.keyframes.ids[-1])
        found = self._significant(newest)
        found = self._search.begun_at(found, self._anonymous.elsewhere.fits_from) if found else None
        is_decided = found is not None and self._is_decided(found)
        if self._finds_slips and self._is_slip(found, stamp_ns, is_decided=is_decided):
            is_decided = False
            found = found if self._last(*SLIPS) is None else None  # too few landmarks say so yet: an alarm
        if found is not None and is_decided:
            if (wrong := self._refuted_by(found, newest)) is not None:
                found = found if not self._revoke(wrong, found, stamp_ns) else None
            elif not self._was_doubtful:
                found = found if not self._move(found, stamp_ns) else None
        self._note(found, stamp_ns)
        self._protect()

    def _protect(self) -> None:
        """Keep the map as it is while it is not decided; ranges or bearings fit a wrong pose by chance, too."""
        k = self._last(ELSEWHERE)
        undecided = self.doubts[k] if k is not None and self.doubts[k].segment is None else None
        self._backend.holds_back = undecided is not None
        self._backend.trusts_sightings = undecided is None or undecided.determines_pose

    def _note(self, found: DisplacementHypothesis | None, stamp_ns: int) -> None:
        """Begin an alarm, go on with it, or end it."""
        k, is_elsewhere = self._last(ELSEWHERE), self._anonymous.elsewhere.since is not None
        held_back, tested, is_contradicted = self._window.contradiction()
        is_contradicted |= is_elsewhere
        evidence = found.evidence if found else 0
        if k is None:
            if found or is_contradicted:
                determines_pose = found is not None or is_elsewhere or self._search.held_back_count > 0
                alarm = Doubt(stamp_ns, evidence, held_back=held_back, tested=tested, determines_pose=determines_pose)
                self.doubts.append(alarm)
                self._was_doubtful = self._anonymous.hindsight.is_doubtful
        elif evidence > self.doubts[k].evidence:
            self._change(k, evidence=evidence)
        elif not found and not is_contradicted and self._is_calm(self.doubts[k], stamp_ns):
            self._change(k, ended_ns=stamp_ns)

    def _is_calm(self, now: Doubt, stamp_ns: int) -> bool:
        """Return whether the alarm may end: where it was decided, the landmarks must have agreed for a while."""
        is_early = now.segment is not None and (stamp_ns - now.began_ns) * 1e-9 < _CALM_S
        return self._window.is_calm and not is_early

    def _significant(self, newest: int) -> DisplacementHypothesis | None:
        """Another pose for which more sightings are than chance and noise explain."""
        if self._search.held_back_count < _ALARM:
            return None
        found = self._search.hypothesis()
        if found and not all(self._search.are_apart(one, found.T_map_chain, newest) for one in self._refuted):
            return None
        return found if found and self._is_doubtful(found) and self._is_beyond_noise(found) else None

    @staticmethod
    def _is_doubtful(found: DisplacementHypothesis) -> bool:
        return found.evidence >= _ALARM and min(found.landmarks, found.keyframes) >= _ALARM_FROM

    def _is_beyond_noise(self, found: DisplacementHypothesis) -> bool:
        """Return whether it is beyond noise: else it is a loop closure that odometry's noise explains."""
        held_back = [edge for edge in found.fitting if not self._backend.ledger.is_inside(edge)]
        return self._backend.decisions.are_beyond_noise(held_back[-_TRIED:])

    @staticmethod
    def _is_decided(found: DisplacementHypothesis) -> bool:
        return (
            found.evidence >= max(_DECIDED, 2 * found.rival)
            and len(found.fitting) >= _MOST * (len(found.fitting) + len(found.contradicting))
            and found.landmarks + found.has_headings >= ENOUGH
            and found.keyframes >= _DECIDED_KEYFRAMES
        )

    # -- hypotheses are compared -------------------------------------------------------------------------------------

    def _is_slip(self, found: DisplacementHypothesis | None, stamp_ns: int, *, is_decided: bool) -> bool:
        """Compare the hypotheses if that is due. Returns whether a slip is likelier than odometry as stated and a move.

        Such a slip begins if it is sure, goes on or ends.
        """
        views, slip = list(self._window.views)[-_VIEWS:], self._last(*SLIPS)
        links = self._window.stretch(_VIEWS, _MOST_EDGES) if len(views) > 1 else []
        if not links:
            return False
        is_new, self._compared = views[-1] is not self._compared, views[-1]
        self._allowed = min(_BURST, self._allowed + _PART * is_new)
        is_alarmed = is_new and (slip is not None or (self._allowed >= 1.0 and self._window.is_alarmed))
        if not (is_alarmed or (is_decided and slip is None)):
            return False
        self._allowed = max(0.0, self._allowed - (slip is None))
        explains = False
        try:
            if slip is None or is_decided:
                stretch = self._stretch(links, self._measured_from(links, views))
                moved = [self._moved(found, links)] if found else []
                best, log_ratio = stretch.likeliest([stretch.as_stated, *self._slips(links, views), *moved])
                explains = bool(best.kind) if slip is None else best.there is None
            if slip is not None:
                self._end_slip(slip, links, views, stamp_ns)
            elif explains and (landmarks := stretch.voters(best, log_ratio)) >= 2:
                self._begin_slip(best.kind, links[best.first :], 2.0 * log_ratio, landmarks, stamp_ns)
        except (GraphSlamError, np.linalg.LinAlgError):  # nothing can be compared: odometry counts as before
            return False
        return explains

    def _slips(self, links: Sequence[Link], views: Sequence[View]) -> list[Hypothesis]:
        """A slip has begun at one of some views, and goes on."""
        seconds, place = np.array([link.seconds for link in links]), np.arange(len(links))
        return [
            Hypothesis(_variances(self._space, kind, seconds) * (place >= first)[:, None], LOG_ODDS, kind, first)
            for kind in SLIPS
            for first in _firsts(links, views, _SINCE)
        ]

    def _moved(self, found: DisplacementHypothesis, links: Sequence[Link]) -> Hypothesis:
        """The robot was moved, with odometry as it is stated otherwise."""
        k = next((k for k, link in enumerate(links) if link.vertices[1] >= found.first), len(links) - 1)
        variances = np.zeros((len(links), self._space.dof))
        variances[k] = np.square(self._space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD))
        there = self._space.group.compose(found.T_map_chain, links[k].pose)
        return Hypothesis(variances, LOG_ODDS + LOG_ODDS_MOVED, first=k, there=there)

    def _stretch(self, links: Sequence[Link], seen: SeenOf) -> Stretch:
        """A stretch of odometry, and its likelihood without what was seen along it; an alarm alone changes nothing."""
        graph = self._backend.graph
        out = [edge for of_view in seen.values() for edge, _ in of_view if self._backend.ledger.is_inside(edge)]
        without = partial(self._backend.solver.joint_marginal_without, edges=out)
        if (keyframes := self._backend.keyframe + 1) >= self._noise_due:
            self._noise_due = keyframes + max(_EVERY, _MORE * keyframes)
            self._noise = measured_noise(self._space, self._backend)
        edges = [graph.edge(link.edge) for link in links]
        return Stretch(self._space, graph, edges, seen, without, *self._noise)

    def _measured_from(self, links: Sequence[Link], views: Sequence[View]) -> SeenOf:
        """Edges by the keyframe at the end of each link, accepted or not, of what was well known before.

        Of landmarks whose place is not given, those that tell a position: others may have nothing else left.
        """
        first, ends, ledger = links[0].vertices[0], {link.vertices[1] for link in links}, self._backend.ledger
        out = dict[int, list[tuple[int, int | str]]]()
        for view in views:
            for one in view.seen if view.vertex in ends else ():
                known_from = self._window.known_from(one.what)
                is_known = known_from < 0 or (known_from < first and one.point is not None)
                if is_known and one.edge < ledger.ids.next and not ledger.is_withdrawn(one.edge):
                    out.setdefault(view.vertex, []).append((one.edge, one.what))
        return out

    # -- a slip ------------------------------------------------------------------------------------------------------

    def _begin_slip(self, kind: str, links: Sequence[Link], evidence: float, landmarks: int, stamp_ns: int) -> None:
        """Let odometry count for less; what was held back since then is judged again with that."""
        vertex, began_ns, ledger = links[0].vertices[0], links[0].stamps_ns[0], self._backend.ledger
        edges = [one.edge for view in list(self._window.views)[-_VIEWS:] if view.vertex >= vertex for one in view.seen]
        compared = [edge for edge in edges if edge < ledger.ids.next and not ledger.is_withdrawn(edge)]
        slip = Doubt(began_ns, evidence, kind=kind, decided_ns=stamp_ns, landmarks=landmarks)
        slip = self._widened(links, slip, Revision(compared=compared))
        if slip.edges:
            self.doubts.append(slip)
            self._counters.count("odometry", "slip")
            self._anonymous.doubt(began_ns, partial(_variances, self._space, kind))

    def _widened(self, links: Sequence[Link], slip: Doubt, so_far: Revision) -> Doubt:
        """Put edges with more noise in place of odometry's. Returns the slip with as many more edges."""
        replaced = []
        for link in links:
            one, added = self._backend.graph.edge(link.own), _variances(self._space, slip.kind, np.array(link.seconds))
            noise = Gaussian.from_covariance(covariance_of(one) + np.diag(added))
            replaced.append(Replacement(link.own, one.measured, noise))
        revision = replace(so_far, replaced=replaced, reason=Reason.SLIP, evidence=slip.evidence, threshold=_THRESHOLD)
        applied = self._backend.apply(DOUBT, lambda: revision)
        pairs = applied.replaced if applied else ()
        for link, (own, used) in zip(links, pairs, strict=False):
            link.edge = self._wider[own] = used
        return replace(slip, edges=slip.edges + len(pairs))

    def _end_slip(self, k: int, links: Sequence[Link], views: Sequence[View], stamp_ns: int) -> None:
        """Use odometry with its own noise again, from where on that is likelier."""
        own, used = [link.own for link in links], [link.edge for link in links]
        if own == used:
            return
        graph, firsts = self._backend.graph, _firsts(links, views, _SINCE[-3:])
        errors, narrower = OdometryErrors(graph, self._backend.solver, used), between(graph, own, used)
        gains = [errors.log_ratio(narrower * (np.arange(len(links)) >= first)[:, None, None]) for first in firsts]
        if not gains or max(gains) <= 0.0:
            return
        narrowed = [link for link in links[firsts[int(np.argmax(gains))] :] if link.edge != link.own]
        pairs = [(link.own, link.edge) for link in narrowed]
        if self._backend.apply(DOUBT, lambda: Revision(restored=pairs)) is None:
            return
        for link in narrowed:
            link.edge = link.own
            self._wider.pop(link.own, None)
        left = self.doubts[k].edges - len(pairs)
        if not left:
            self._counters.count("odometry", "slip_taken_back")
        outcome = "" if left else "taken back: later views agree with odometry"
        self._change(k, edges=left, ended_ns=stamp_ns, outcome=outcome)
        self._anonymous.doubt(stamp_ns, None)

    # -- a robot that was moved --------------------------------------------------------------------------------------

    def _move(self, found: DisplacementHypothesis, stamp_ns: int) -> bool:
        """Begin a segment where the landmarks say that the robot is. Returns whether that can be solved."""
        keyframes, segments = self._path.keyframes, self._path.segments
        index = keyframes.first + int(np.searchsorted(keyframes.ids, found.first))
        group, before = self._space.group, self._estimate(found.first)
        motions = self._motions(found)
        there = group.compose(motions[found.first], before)
        moved = group.between(before, there)
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
        k = self._last(ELSEWHERE)
        if k is not None and self.doubts[k].segment is not None:
            self._change(k, ended_ns=stamp_ns)
            k = None
        if k is None:
            k = len(self.doubts)
            self.doubts.append(Doubt(stamp_ns, found.evidence))
        self.doubts[k] = Doubt(
            self.doubts[k].began_ns,
            found.evidence,
            None,
            index,
            float(np.linalg.norm(moved[: self._space.dimensions])),
            float(self._space.angle(moved)),
        )
        self._decided.append(
            Displacement(
                found.first,
                index if is_new else None,
                link,
                replacement,
                T_map_chain_before,
                found.T_map_chain,
                self._window.links[found.first],
                k,
            )
        )
        return True

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

    def _estimate(self, vertex: int) -> Numbers:
        return tuple(self._backend.solver.estimate([vertex])[0].tolist())

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
        if (k := self._last(ELSEWHERE)) is not None:
            self._change(k, ended_ns=stamp_ns, outcome="the displacement before is taken back")
        return True

    def rejoin(self, stamp_ns: int) -> bool:
        """Believe odometry again where the explanation of all scans has no displacement. Returns whether it has one.

        The estimate is as without them already.
        """
        firsts, free = self._anonymous.rejoins, self._backend.first_free_edge
        wrong = [one for one in self._decided if one.first in firsts and one.link >= free]
        pairs = [(one.link, one.replacement) for one in wrong]
        if wrong and self._backend.apply(DOUBT, lambda: Revision(restored=pairs, solves="nothing")) is None:
            return False
        self._anonymous.rejoins = frozenset()
        if not wrong:
            return False
        for one in wrong:
            self._note_taken_back(one, "taken back: without it all sightings are explained better", stamp_ns)
        self._begin_anew(self._path.keyframes[-1].vertex, stamp_ns)
        return True

    def _note_taken_back(self, one: Displacement, outcome: str, stamp_ns: int) -> None:
        self._counters.count("odometry", "displacement_taken_back")
        if one.index is not None:
            self._path.segments.remove(one.index)
        self._change(one.doubt, ended_ns=self.doubts[one.doubt].ended_ns or stamp_ns, outcome=outcome)
        self._decided.remove(one)
        one.to_first.edge = one.link
        self._refuted.append(one.T_map_chain)
        self._anonymous.rejoined(one.first)


def _firsts(links: Sequence[Link], views: Sequence[View], since: Sequence[int]) -> list[int]:
    """The first links, by their places, after the views that are so many before the newest."""
    begins = [views[-count - 1].vertex for count in since if count < len(views)]
    last = len(links) - 1
    return sorted({next((k for k, link in enumerate(links) if link.vertices[0] >= begin), last) for begin in begins})


def _variances(space: Geometry, kind: str, seconds: float | Array) -> Array:
    """Variances (..., dof) that a kind of slip adds to edges that last so long (...)."""
    n, seconds = space.dimensions, np.minimum(seconds, _LONGEST_S)
    per_s = np.zeros(space.dof)
    if kind == "translation":
        per_s[:n] = _SLIP * _OTHERS
        per_s[0] = _SLIP
    else:
        per_s[n:] = _SLIP * _OTHERS
        per_s[-1] = _SLIP
    independent = np.maximum(1.0, _LASTS_S / np.maximum(seconds, 1e-9))
    return np.asarray((np.asarray(seconds)[..., None] * per_s) ** 2 * independent[..., None])
