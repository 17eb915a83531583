"""Landmarks whose sightings have no id: several explanations are kept, and each decision can be revised.

Sightings are collected into scans (``scans.py``). A beam of hypotheses explains the scans (``beam.py``). The graph
follows the leading hypothesis: when the leader changes, sightings are moved to other landmarks. From time to time all
scans are explained at once, in the background on a copy (``explanation.py``, ``moves.py``, ``constellation.py``). The
result is used a fixed number of keyframes later.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Sightings
from graph_slam_ros.slam.association.assignments import Assigned, Assignments
from graph_slam_ros.slam.association.beam import NOTHING, Beam, BeamSettings
from graph_slam_ros.slam.association.belief import SolverBelief
from graph_slam_ros.slam.association.elsewhere import Elsewhere
from graph_slam_ros.slam.association.hindsight import Found, FrozenScans, Hindsight
from graph_slam_ros.slam.association.scan_history import ScanHistory
from graph_slam_ros.slam.association.scans import SCAN_NS, DeadReckoning, Motion, Scan, ScanBuilder
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.background import guarded
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.levels import GATE
from graph_slam_ros.slam.revision import Revision
from graph_slam_ros.typing import Array, Executor

_REVIEWED_EVERY = 10  # keyframes, some seconds: landmarks are confirmed and given up
_POSITIONED = ("position", "pose", "range_bearing")


class AnonymousLandmarks:
    """Association of sightings without id with landmarks, by hypotheses over a lag.

    Parameters
    ----------
    executor : begins work in the background

    Attributes
    ----------
    clusters : with their landmarks
    hindsight : explains all scans at once
    elsewhere : whether the newest scans contradict the pose
    rejoins : keyframes at which the last explanation believes odometry again, by their vertices
    """

    def __init__(
        self, config: Config, landmarks: Landmarks, backend: Backend, counters: Counters, executor: Executor
    ) -> None:
        c, space = config.landmarks, config.space
        self._space = space
        self._landmarks, self._backend, self._counters = landmarks, backend, counters
        self._solver = backend.solver
        self._noise = OdometryNoise(config.odometry, space)
        self._reckoning = DeadReckoning(space, config.ordering.late_s + 2.0)
        self._history = ScanHistory(space, config.odometry, self._reckoning)
        self._builder = ScanBuilder(space, c.unnamed_sigma_m, c.added_sigma_m)
        self._settings = BeamSettings(
            quantile(GATE, space.dimensions),
            space.dimensions * float(np.log(c.density_per_m)),
            hypotheses=40,
        )
        self._belief = SolverBelief(space, backend.solver, landmarks)
        self.hindsight = Hindsight(config, self._settings, executor, counters)
        self.clusters = Assignments(landmarks, counters, backend)
        self._beam: Beam | None = None
        self._same: dict[int, int] = {}  # landmarks of the beam that are others in the graph
        self._compared = 0  # scans
        self.rejoins = frozenset[int]()
        self._displaced: int | None = None  # the scan from which on all are explained anew
        self.elsewhere = Elsewhere(space, landmarks, self._history, self.clusters)

    def restore(self) -> None:
        """Continue with the landmarks of a map."""
        self.hindsight.is_on = not self.clusters.restore()

    # -- odometry and sightings become scans -------------------------------------------------------------------------

    def travel(self, step: Step) -> list[Assigned]:
        """Add a step of odometry. Returns the sightings of a scan that ended long before it."""
        stands = step.broken or self._noise.stands(step.T_last_base, self._reckoning.since_s(step.stamp_ns))
        self._reckoning.step(step, stands=stands)
        self._history.note_motion(step.stamp_ns)
        began_ns = self._builder.began_ns
        return self.end_scan() if began_ns is not None and began_ns < step.stamp_ns - 2 * SCAN_NS else []

    def forget_belief(self) -> None:
        """Restart the beam from the solver's estimate, because the map has moved."""
        self._beam = None

    def rescale(self, factors: tuple[float, float]) -> None:
        """Take over that odometry's distance and turn were multiplied."""
        self._reckoning.rescale(factors)
        self._history.rescale(factors)
        self._builder.reckon_anew(self._reckoning.at)
        self.hindsight.rescale(factors)
        self.forget_belief()

    def see(self, m: Sightings, where: PoseAtStamp) -> list[Assigned]:
        """Add the sightings without id to a scan. Returns those of the previous scan if it has ended."""
        at = self._reckoning.at(m.stamp_ns)
        out = self.end_scan() if self._builder.is_full(at) else []
        for s in m.sightings:
            self._builder.add(at, m.topic, s, where)
        return out

    def identified(self, m: Sightings, where: PoseAtStamp) -> list[Assigned]:
        """The sightings that can be used now, each with its landmark. Refused ones are counted."""
        known = self._landmarks.known
        named = [s for s in m.sightings if s.id]
        out = [Assigned(m.topic, s.id, s, where) for s in named if s.id not in known or not known[s.id].is_unnamed]
        if len(out) < len(named):  # whoever gives such names, an unnamed landmark cannot be taken back any more
            self._counters.count(m.topic, "id_of_an_unnamed", len(named) - len(out))
        unnamed = tuple(s for s in m.sightings if not s.id and s.kind in _POSITIONED)
        if len(named) + len(unnamed) < len(m.sightings):
            self._counters.count(m.topic, "no_id", len(m.sightings) - len(named) - len(unnamed))
        return out + (self.see(replace(m, sightings=unnamed), where) if unnamed else [])

    # -- scans are explained -----------------------------------------------------------------------------------------

    def end_scan(self) -> list[Assigned]:
        """End the scan. Returns its sightings with their landmarks."""
        scan = self._builder.close()
        if scan is None:
            return []
        first = self.clusters.append(scan.clusters)
        motion = self._history.append(scan, first)
        try:
            changed = self._explained(scan, first, motion)
        except (GraphSlamError, np.linalg.LinAlgError):  # no covariance now: the solve that failed is counted
            self._beam, changed = None, {}
        self.clusters.give({c: landmark for c, landmark in changed.items() if c < first})
        return self.clusters.begin(first, changed)

    def _explained(self, scan: Scan, first: int, motion: Motion | None) -> dict[int, int]:
        """Explain the scan after a motion. Returns the landmarks of its clusters, and of others that have changed."""
        self._backend.hand_over()
        beam, names = self._beam, self.clusters.names
        if beam is None or motion is None or motion.is_broken:
            scales, sigma = self.hindsight.scales
            scales = scales if beam is None else beam.scales[0]
            beam = self._belief.begin(self._settings, scan, names, scales, sigma)
        else:
            beam.advance(motion)
            self._belief.recall(beam, scan, names)
        changed = beam.explain(scan, first)
        if not beam.is_sound:
            raise GraphSlamError("the hypotheses are not finite")
        self._beam = beam
        return {c: self._same.get(landmark, landmark) for c, landmark in changed.items()}

    def doubt(self, since_ns: int, added: Callable[[float], Array] | None) -> None:
        """Use odometry with more noise, or as stated again. In the first case the scans since then are explained anew.

        Parameters
        ----------
        added : variances (dof,) that so many seconds of motion add; None from now on
        """
        since = self._history.doubt(since_ns, added)
        if since is not None:
            self.explain_since(since)

    def displaced(self, first: int) -> None:
        """Begin anew at a keyframe, by its vertex: the robot was moved there."""
        self._beam = None
        self.hindsight.restart()
        k = self._history.split(first)
        if k is not None and (since := self.elsewhere.since) is not None:  # what was begun at the wrong place
            lost = [c for c in range(since, self.clusters.count) if c not in self.elsewhere.proposed]
            self.clusters.give(dict.fromkeys((c for c in lost if self.clusters.given[c] >= since), NOTHING))
            self._displaced = k
        self.elsewhere.end()

    def rejoined(self, first: int) -> None:
        """Believe odometry again at a keyframe, by its vertex, at which the robot was thought to be moved."""
        self._beam = None
        self.hindsight.restart()
        self.elsewhere.end()
        self._history.rejoin(first)

    def keep_displacements(self) -> None:
        """Note that another frame of odometry begins: displacements in the last one are taken back no more."""
        self._history.keep_displacements()
        self.rejoins = frozenset()

    def explain_since(self, first: int) -> None:
        """Explain the scans anew from one on: what they were thought to be is forgotten."""
        self.clusters.give(dict.fromkeys(range(self._history.firsts[first], self.clusters.count), NOTHING))
        self._solver.update()
        self._explain_from(first)

    def _explain_from(self, first: int) -> None:
        """Explain the scans anew from one on, by the map and the path as they are."""
        history = self._history
        changed = dict[int, int]()
        self.hindsight.restart()
        self._beam = None
        try:
            for k in range(first, len(history.scans)):
                changed |= self._explained(history.scans[k], history.firsts[k], history.motions[k - 1] if k else None)
        except (GraphSlamError, np.linalg.LinAlgError):  # as when they were new
            self._beam = None
        self.clusters.give(changed)

    # -- keyframes leave ---------------------------------------------------------------------------------------------

    def may_forget_before(self, keyframe: int) -> bool:
        """Return whether keyframes before a number may leave the graph: all was explained that was seen from them.

        If that was not explained yet, it will be soon.
        """
        oldest = self._builder.oldest_keyframe
        if self.elsewhere.since is not None or self._displaced is not None or (oldest or keyframe) < keyframe:
            return False
        scans = self._history.scans
        if not self.hindsight.is_on or not scans:
            return True
        return self.hindsight.covers(self._history.since(keyframe)) and not self.hindsight.is_doubtful

    def forget_before(self, keyframe: int) -> None:
        """Forget the scans from keyframes before a number, which have left the graph: their landmarks are final."""
        history = self._history
        k = history.since(keyframe)
        self.hindsight.forget(k)
        first = history.firsts[k] if k < len(history.scans) else self.clusters.count
        history.forget(k)
        self.clusters.forget_before(first)
        self._compared -= k

    # -- afterwards --------------------------------------------------------------------------------------------------

    def review(self, *, everything: bool) -> None:
        """Accept and remove landmarks, and explain all scans anew: at once, or in the background if that is due."""
        keyframes = self._backend.path.keyframes
        count = len(keyframes)
        if not self._landmarks.begins_new:
            self.clusters.finish()
            return
        if everything:
            if self._history.scans:
                self._adopt(guarded(self._counters, "second_look", lambda: self.hindsight.found(self._frozen)))
                self.clusters.judge(keyframes[-1].stamp_ns)
            return
        if self._displaced is not None:  # it is solved now
            self._explain_from(self._displaced)
            self._displaced = None
        if len(self._history.scans) not in (0, self._compared):
            self._compared = len(self._history.scans)
            self.clusters.give(self.elsewhere.look())
        self._adopt(self.hindsight.outcome(count))
        if self.hindsight.is_due(len(self._history.scans)):
            self.hindsight.start(self._frozen, count)
        if count % _REVIEWED_EVERY == 0:
            self.clusters.judge(keyframes[-1].stamp_ns)

    def _frozen(self) -> FrozenScans:
        self._backend.hand_over()
        group, scans = self._space.group, self._history.scans
        moved = np.array([scan.where.T_keyframe_base for scan in scans])
        at = self._solver.estimate([scan.where.vertex for scan in scans])
        poses = np.stack(group.compose(tuple(at.T), tuple(moved.T)), axis=-1)
        scales = self._beam.scales[0] if self._beam else self.hindsight.scales[0]
        given = np.array(list(self.clusters.given.values()))
        history = self._history
        motions = tuple(history.motions)
        frozen = FrozenScans(tuple(scans), motions, history.nearby(), poses, scales.copy(), given)
        if history.displacements:
            frozen = replace(frozen, displaced=history.displacements, undisplaced=history.undisplaced())
        return frozen.after_map(self._belief, self.clusters.final)

    def _adopt(self, found: Found | None) -> None:
        """Use an explanation of all scans up to one."""
        if found is None:
            return
        if found.undecided:
            self._counters.count("landmarks", "undecided", found.undecided)
        if not found.is_whole:
            self._counters.count("landmarks", "moves_left")
        self.rejoins |= found.rejoined
        numbers = found.numbers(self.clusters.given, self.clusters.fresh)
        values = found.carried_to(self._space, self._solver, self._backend.path.keyframes)
        changed, gone = found.changes(self.clusters.given, numbers)
        self._same = {k: gone.get(one, one) for k, one in (gone | self._same).items()}
        if self.clusters.give(changed):
            names, places = self.clusters.names, zip(numbers.tolist(), found.estimate.landmarks.tolist(), strict=True)
            with_new = np.concatenate([values, self._solver.values[len(values) :]])
            values = self._landmarks.placed(with_new, {names[k]: place for k, place in places if k in names})
            self._backend.apply("second_look", lambda: Revision(values=values, solves="all"))
        self.hindsight.note(self.clusters.given)
