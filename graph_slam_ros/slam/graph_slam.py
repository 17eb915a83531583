"""The pipeline: one object, one door. Node, replay and tests all call ``GraphSlam.process``.

Its state is a function of the configuration and the sequence of accepted measurements, nothing else.
"""

import math
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import DivergedError, GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import (
    Closure,
    Control,
    Fix,
    InitialPose,
    Measurement,
    Observation,
    Odometry,
    Sighting,
    Sightings,
)
from graph_slam_ros.slam.anchor import Anchor
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.edits import Edits
from graph_slam_ros.slam.failure_guard import FailureGuard
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.keyframes import KeyframeList, SightingPose
from graph_slam_ros.slam.frontend.max_distance import MaxDistance, off_the_pole
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.odometry_integration import IntegratedOdometry, OdometryNoise
from graph_slam_ros.slam.frontend.odometry_selector import OdometrySelector, Step
from graph_slam_ros.slam.frontend.pose_edges import PoseEdges
from graph_slam_ros.slam.frontend.stamp_order import StampOrder
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.frontend.thinning import ObservationThinning
from graph_slam_ros.slam.kidnap_detector import Alarm, KidnapDetector
from graph_slam_ros.slam.landmarks.anonymous import AnonymousLandmarks
from graph_slam_ros.slam.landmarks.landmark_map import Landmark, Landmarks
from graph_slam_ros.slam.robust.background import Executor, run_when_asked
from graph_slam_ros.slam.robust.ledger import VerdictChange
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver import Report, Settings
from graph_slam_ros.typing import Array, Numbers


@dataclass(frozen=True, slots=True)
class Correction:
    """The correction of a solve: how far it moved map -> odom, and what new edges, odometry apart, it had to reconcile.

    Attributes
    ----------
    distance_m, angle_rad : of the robot's newest keyframe, the jump that a user sees
    edges : ids, the one that fitted least before first
    chi2 : of each, per number measured, before the solve
    """

    distance_m: float = 0.0
    angle_rad: float = 0.0
    edges: tuple[int, ...] = ()
    chi2: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Update:
    """The changes that ``process`` made.

    Attributes
    ----------
    keyframes : indices of new ones
    edges : ids of new ones that the solver has
    solved : whether it solved
    report : of a solve of everything
    correction : of the last solve
    changes : of verdicts, since the last update that told any
    alarms : that began, were decided or ended since then: the landmarks say that the robot is elsewhere
    """

    keyframes: tuple[int, ...] = ()
    edges: range = range(0)
    solved: bool = False
    report: Report | None = None
    correction: Correction = Correction()
    changes: tuple[VerdictChange, ...] = ()
    alarms: tuple[Alarm, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.keyframes) or self.solved

    def __repr__(self) -> str:
        parts = [_counted(len(self.keyframes), "keyframe")] if self.keyframes else []
        parts += [_counted(len(self.edges), "edge")] if self.edges else []
        if self.solved:
            moved = f", map -> odom moved {self.correction.distance_m:.3g} m"
            parts.append(("solved everything" if self.report else "solved") + moved)
        parts += [_counted(len(self.changes), "changed verdict")] if self.changes else []
        return f"Update({', '.join(parts) or 'nothing'})"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


_NOTHING = Update()
_UNCERTAIN, _MAX_UNCERTAIN_M = 10.0, 1e5  # times as far as a given pose is away: so little odometry is trusted there
_BLAMED = 5  # edges that are named as the cause of a correction
_SHARED_WHEN_SOON = 1.0  # of a variance: with more, what comes fast would seem better than it is


class GraphSlam:
    """Online pose-graph SLAM, in the plane or in space, from odometry, landmarks, fixes and loop closures.

    Parameters
    ----------
    config : the parameters
    sink : called with every measurement that is handed over, in that order, before it takes effect or is refused
    executor : starts a background job; the function that it returns waits for the result
    start : the map to go on in, which is then this object's; the next odometry begins a segment, unless the map tells
        that the same drive continues
    """

    def __init__(
        self,
        config: Config | None = None,
        sink: Callable[[Measurement], None] | None = None,
        executor: Executor = run_when_asked,
        start: MapSnapshot | None = None,
    ) -> None:
        self.config = config or Config()
        self.space = self.config.space
        self.counters = Counters()
        self.backend = Backend(self.config.robust, self.config.solver_settings(), executor, start, self.counters)
        self.graph, self.solver, self.ledger = self.backend.graph, self.backend.solver, self.backend.ledger
        self.sighting_poses = StampedPoses(SightingPose, self.space.pose.size)
        self.processed = 0  # measurements and control events that were handed over
        self.solves = 0
        self.report: Report | None = None  # of the last solve of everything
        self.correction = Correction()  # of the last solve
        self.datum = start.datum if start is not None else ()  # where on earth the map begins, by the first fix
        self.settings: dict[str, bool | int | float | str] = {}  # parameters that were changed on the way
        self._sink = sink
        self._order = StampOrder(self.config.ordering, self.counters)
        self._odometry = OdometrySelector(
            self.config.odometry, self.config.inputs.names.split(), self.space, self.counters
        )
        self._noise = OdometryNoise(self.config.odometry, self.space)
        self._keyframe_list = KeyframeList(self._noise, self.space)
        self.keyframes, self.segments = self._keyframe_list.keyframes, self._keyframe_list.segments
        self.drives = self._keyframe_list.drives  # the first keyframe of each; the last drive is the present one
        self._reach = MaxDistance(self.space, self.config.sources)
        self._thinning = ObservationThinning(self.config)
        self._anchor = Anchor(self.config, self.backend)
        self._edges = PoseEdges(self.space, self.graph, self.counters)
        self._landmarks = Landmarks(self.config, self.graph, self.solver, self.counters, self._withdraw)
        self._anonymous = AnonymousLandmarks(
            self.config, self._landmarks, self.solver, self.counters, self.backend.hand_over
        )
        self._kidnaps = KidnapDetector(self.space, self.config.odometry, self.backend, self.counters, self.segments)
        self._failure_guard = FailureGuard(self.backend, self.counters, self._landmarks.forget)
        self._edits = Edits(self.backend, self._landmarks, self.counters)
        self._held_covariance: Array | None = None  # of the newest pose when the map was held, for the next odometry
        self._pending: list[Observation] = []
        self._initial_pose: InitialPose | None = None  # for the next odometry
        self._covariance = np.zeros((self.space.dof, self.space.dof))
        self._solved_edges = 0  # edges, by the last solve that succeeded
        self._reported_changes = 0  # changes of verdicts that updates have told
        self._reported_alarms: tuple[Alarm, ...] = ()
        self._solved_T_map_odom = self.space.identity  # to see how far a solve moves it
        self._solved_vertices = 0  # that the last solve took in: none where it failed
        self._unsolved_keyframes = self._unsolved_sightings = 0
        if start is not None and start.keyframes:
            self._restore(start)
        self.first_edge = self.graph.edge_count  # of this run: those before are of the map it began in

    def __repr__(self) -> str:
        counts = f"{len(self.keyframes)} keyframes, {len(self.landmarks)} landmarks, {self.graph.edge_count} edges"
        return f"GraphSlam({counts}, {self.solves} solves)"

    # -- the door ------------------------------------------------------------------------------------------------

    def process(self, measurement: Measurement) -> Update:
        """Take one measurement or control event; returns what it changed."""
        if self._sink is not None:
            self._sink(measurement)
        self.processed += 1
        if not isinstance(measurement, Control | InitialPose) and not self._order.accepts(measurement):
            return _NOTHING
        if isinstance(measurement, Fix) and not self._is_of_this_map(measurement):
            return _NOTHING
        first_new, solves, report = len(self.keyframes), self.solves, self.report
        first_edge = self.backend.handed_over[1]
        match measurement:
            case Odometry() | Sightings() | Fix() | Closure():
                self._use(self._order.push(measurement))
            case Control("flush"):
                self._use(self._order.flush())
            case Control("end"):
                self._use(self._order.flush())
                self._drop_unreached()
            case InitialPose():
                self._initial_pose = measurement
            case Control("optimize"):
                self._solve(self.config.solver_settings())
            case Control("clear_closures"):
                self._clear_closures()
            case Control("time_jump"):
                self._forget_time()
            case Control("restart"):
                self.restart()
            case Control("memory", values):
                self.backend.spares_memory = bool(dict(values)["is_short"])
            case Control("set", values):
                before, self.config = self.config, self.config.changed(dict(values))
                self.settings |= dict(values)
                self.solver.settings = self.config.solver_settings()
                if self.config.map.localize != before.map.localize:
                    self._hold_map(self.config.map.localize)
            case Control("remove", values):
                self._remove(dict(values))
        if len(self.keyframes) == first_new and self.solves == solves:
            return _NOTHING
        new = self.report if self.report is not report else None
        solved = self.solves > solves
        correction = self.correction if solved else Correction()
        edges = range(first_edge, self.backend.handed_over[1])
        changes, self._reported_changes = tuple(self.ledger.history[self._reported_changes :]), len(self.ledger.history)
        keyframes, alarms = tuple(range(first_new, len(self.keyframes))), self._changed_alarms()
        return Update(keyframes, edges, solved, new, correction, changes, alarms)

    def _changed_alarms(self) -> tuple[Alarm, ...]:
        """Alarms that began, were decided or ended since they were told."""
        before, self._reported_alarms = self._reported_alarms, self.alarms
        known = {(one.began_ns, one.segment, one.ended_ns, one.outcome) for one in before}
        now = [((one.began_ns, one.segment, one.ended_ns, one.outcome), one) for one in self.alarms]
        return tuple(one for key, one in now if key not in known)

    def restart(self) -> None:
        """Go back to the last good estimate, after a fault outside."""
        self._failure_guard.go_back()
        self._solved_vertices = 0

    # -- what is known now ---------------------------------------------------------------------------------------

    @property
    def landmarks(self) -> dict[str, Landmark]:
        """Landmarks of the graph, by identity; but for tentative ones."""
        return {name: mark for name, mark in self._landmarks.known.items() if not mark.is_tentative}

    @property
    def waiting(self) -> dict[str, str]:
        """Return why each landmark waits that was seen but is not among ``landmarks`` yet, by identity."""
        tentative = {
            name: f"seen {mark.sightings} times, without an identity: not believed yet"
            for name, mark in self._landmarks.known.items()
            if mark.is_tentative
        }
        return {name: mark.reason for name, mark in self._landmarks.undetermined.items()} | tentative

    def trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` of all keyframes, (n, 3) or (n, 7)."""
        return self.solver.estimate(self.keyframes.ids).reshape(-1, self.space.pose.size)

    def sighting_trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` at the stamps of the sightings, (n, 3) or (n, 7)."""
        return self._at_sightings(self.trajectory())

    def sighting_odometry(self) -> Array:
        """Return what odometry alone says, ``T_odom_base`` at the stamps of the sightings, (n, 3) or (n, 7)."""
        return self._at_sightings(self.keyframes.poses)

    def _at_sightings(self, keyframe_poses: Array) -> Array:
        keyframes = keyframe_poses[self.sighting_poses.ids]
        return np.stack(self.space.group.compose(tuple(keyframes.T), tuple(self.sighting_poses.poses.T)), axis=-1)

    @property
    def T_map_odom(self) -> Numbers:
        """The correction: odometry's drift at the newest keyframe."""
        if not self.keyframes:
            return self.space.identity
        newest, group = self.keyframes[-1], self.space.group
        out: Numbers = group.compose(self._pose(newest.vertex), group.inverse(newest.T_odom_base))
        return out

    @property
    def pose_covariance(self) -> Array:
        """Covariance (3, 3) or (6, 6) of the newest keyframe's pose in its tangent space.

        The marginal of the last solve, lengthened by the odometry since.
        """
        return self._covariance.copy()

    def landmark_covariances(self) -> list[Array]:
        """Marginal of each landmark, in the map's axes, or of a pose in its tangent space; NaN where unknown."""
        return self._marginals([landmark.vertex for landmark in self.landmarks.values()])

    def keyframe_covariances(self) -> Array:
        """Marginal of every keyframe in its tangent space, (n, 3, 3) or (n, 6, 6); NaN where unknown."""
        dof = self.space.dof
        return np.array(self._marginals(self.keyframes.ids.tolist())).reshape(-1, dof, dof)

    def _marginals(self, vertices: list[int]) -> list[Array]:
        """Looking changes nothing.

        What came in after the last solve is unknown until the next, and all is where that failed.
        """
        out = [np.full((dof, dof), np.nan) for dof in (self.graph.kind_of(vertex).dof for vertex in vertices)]
        solved = self._solved_vertices if self.is_solved else 0
        known = [k for k, vertex in enumerate(vertices) if vertex < solved]
        for k, marginal in zip(known, self.solver.marginal([vertices[k] for k in known]), strict=True):
            out[k] = marginal
        return out

    @property
    def is_solved(self) -> bool:
        """Return whether the last solve succeeded and the solver has all edges since: covariances exist."""
        return self._solved_vertices > 0 and self.solver.is_current

    @property
    def failing(self) -> str:
        """Return why the last solve failed; empty where it did not."""
        return self._failure_guard.failing

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Alarms: when the landmarks said that the robot was elsewhere than odometry, in order; the last may go on."""
        return tuple(self._kidnaps.alarms)

    @property
    def displaced(self) -> Alarm | None:
        """The alarm that goes on: the landmarks say that the robot is elsewhere."""
        return self._kidnaps.now

    @property
    def newest_odometry_ns(self) -> int | None:
        """Stamp of the last odometry that was used."""
        return self._odometry.newest_ns

    @property
    def odometry_source(self) -> str:
        """The odometry in use, by the name of its input; empty before the first."""
        return self._odometry.used.source if self._odometry.used else ""

    @property
    def odometry_sources(self) -> Set[str]:
        """Sources of odometry that have been used."""
        return self._odometry.sources

    @property
    def frozen(self) -> int:
        """The number of first vertices that are of a frozen map: they stay where they are."""
        return self.backend.frozen

    @property
    def frozen_edges(self) -> int:
        """Verdicts on so many edges, the first, are of that map: they stay."""
        return self.backend.frozen_edges

    @property
    def held(self) -> tuple[int, int]:
        """The number of vertices and edges that stay as they are while ``map.localize`` is true; zeros otherwise."""
        return self.backend.held

    @property
    def range_offsets(self) -> dict[str, int]:
        """The vertex of the offset of all ranges of an input, by input."""
        return self._landmarks.offsets

    def touched_landmarks(self, first: int) -> dict[str, Landmark | None]:
        """The landmarks that changed after the first so many changes, tentative ones included; None: removed."""
        return {name: self._landmarks.known.get(name) for name in self._landmarks.touched[first:]}

    @property
    def landmark_changes(self) -> int:
        """The number of changes of landmarks."""
        return len(self._landmarks.touched)

    @property
    def _now_ns(self) -> int:
        """Stamp of the newest odometry, or keyframe."""
        return max(self.newest_odometry_ns or 0, self.keyframes[-1].stamp_ns)

    def _is_of_this_map(self, fix: Fix) -> bool:
        """Return whether its numbers are from where all others of the map are."""
        self.datum = self.datum or fix.datum
        if fix.datum and fix.datum != self.datum:
            self.counters.count(fix.topic, "other_datum")
            return False
        return True

    def _restore(self, start: MapSnapshot) -> None:
        """Solve a map anew, and be nowhere in it yet."""
        if self.graph.kind_of(start.keyframes[0].vertex) is not self.space.pose:
            raise GraphSlamError(f"the map is not in {self.space.dimensions} dimensions")
        self._keyframe_list.restore(start.keyframes, start.segments, start.drives)
        if start.continues_with:
            self._keyframe_list.continue_drive()
            self._odometry.continue_drive(
                self.keyframes[-1].stamp_ns, self.keyframes[-1].T_odom_base, start.continues_with
            )
        for pose in start.sighting_poses:
            self.sighting_poses.append(pose.keyframe, pose.stamp_ns, pose.T_keyframe_base)
        self._anchor.restore()
        self._landmarks.restore(start.landmarks, start.range_offsets)
        self._anonymous.restore()
        localizes = self.config.map.localize
        self.report = self.backend.restore(start.vertices, start.values, start.held if localizes else (0, 0))
        self._failure_guard.note_good()
        (self._covariance,) = self.solver.marginal([self.keyframes[-1].vertex])
        self._solved_vertices, self._solved_edges = self.backend.handed_over
        if localizes:
            self.backend.hold_map()
            self._landmarks.begins_new = False
        self._reported_changes = len(self.ledger.history)
        self._solved_T_map_odom = self.T_map_odom

    # -- the map is held, or edited by hand ------------------------------------------------------------------------

    def _hold_map(self, is_held: bool) -> None:
        """Begin or end localization: the map of now stays where it is, and nothing is added to it but the drive.

        How uncertain the robot's pose is when it begins is kept as noise of the next odometry edge.
        """
        if is_held:
            self._solve(self.config.solver_settings())
            self._held_covariance = self._covariance.copy() if self.keyframes else None
            self.backend.hold_map()
        else:
            self._held_covariance = None
            self.backend.release_map()
        self._landmarks.begins_new = not is_held
        self._failure_guard.note_good()

    def _begin_in_held_map(self, step: Step) -> None:
        """The first keyframe that is free: as uncertain as the pose was when the map began to be held."""
        T_last_now, covariance = self._motion_into(step)
        held, self._held_covariance = self._held_covariance, None
        if held is not None:
            covariance = self.space.group.propagate(held, T_last_now, covariance)
        self._add_keyframe(step, T_last_now, covariance)
        self._solve_if_due()
        self._use_pending(step.stamp_ns)

    def _remove(self, what: dict[str, bool | int | float | str]) -> None:
        keyframe, is_removed = len(self.keyframes) - 1, False
        if "edge" in what:
            is_removed = self._edits.remove_edge(int(what["edge"]), keyframe)
        if "landmark" in what:
            is_removed |= self._edits.remove_landmark(str(what["landmark"]), keyframe)
        if is_removed:
            self._solve(self.config.solver_settings())

    # -- odometry ------------------------------------------------------------------------------------------------

    def _use(self, released: list[Odometry | Observation]) -> None:
        """Use each by itself: a fault of one costs none of the others; the first is raised in the end, all count."""
        faults = []
        for m in released:
            try:
                if isinstance(m, Odometry):
                    for step in self._odometry.steps(m):
                        self._on_step(step)
                else:
                    self._on_observation(m)
            except Exception as fault:
                faults.append(fault)
        for error in faults[1:]:  # whoever called counts the one that is raised
            self.counters.count("node", type(error).__name__)
        if faults:
            raise faults[0]

    def _on_step(self, step: Step) -> None:
        if not self.keyframes:
            self._first_keyframe(step)
        elif (motion := self._keyframe_list.motion) is None or step.broken or self._initial_pose:
            self._begin_segment(step)
        elif self._held_covariance is not None:
            self._begin_in_held_map(step)
        else:
            motion.step(step)
            self._use_pending(step.stamp_ns)
            motion = self._keyframe_list.motion or motion  # since another keyframe, where something seen deserved one
            if self._keyframe_due(motion):
                self._add_keyframe(step, motion.now.T_keyframe_base, motion.now.covariance)
                self._solve_if_due()

    def _keyframe_due(self, motion: IntegratedOdometry) -> bool:
        due, n = self.config.keyframes, self.space.dimensions
        at = motion.now.T_keyframe_base
        far = sum(x * x for x in at[:n]) >= due.min_distance_m**2 or self.space.angle(at) >= due.min_angle_rad
        return far or motion.is_long or (motion.moving_ns >= due.max_interval_s * 1e9 and not self._noise.is_jitter(at))

    def _first_keyframe(self, step: Step) -> None:
        """Map begins where odom begins, or the robot where it is said to: there the first pose is anchored."""
        T_map_base = self.config.start_pose or step.T_odom_base
        vertex = self.graph.add_vertex(self.space.pose, T_map_base)
        self._covariance = self._anchor.begin(vertex, T_map_base)
        self.segments.append(0)
        self._keyframe_list.append(vertex, step, self.config.ordering.late_s)
        self._solved_T_map_odom = self.T_map_odom

    def _add_keyframe(self, step: Step, T_last_now: Numbers, covariance: Array, at: Numbers | None = None) -> None:
        """A vertex where odometry is now, or where it is said to be, and the motion to it from the last as an edge."""
        group, last = self.space.group, self.keyframes[-1].vertex
        vertex = self.graph.add_vertex(self.space.pose, at or group.compose(self._pose(last), T_last_now))
        self._edges.odometry([last, vertex], T_last_now, covariance, self.odometry_source)
        self._covariance = group.propagate(self._covariance, T_last_now, covariance)
        self._keyframe_list.append(vertex, step, self.config.ordering.late_s)
        self._unsolved_keyframes += 1

    def _begin_segment(self, step: Step) -> None:
        """Begin a segment: across a jump of odometry or time nearly nothing is known of the motion.

        Or somebody tells: an initial pose.
        """
        given, self._initial_pose, self._held_covariance = self._initial_pose, None, None
        has_motion = (
            self._keyframe_list.motion is not None
        )  # none of a loaded map: its odometry was that of another drive
        is_prior = given is not None and has_motion and self.config.initialpose.use == "prior"
        T_last_now, covariance = self._motion_into(step)
        if not is_prior:
            self.segments.append(len(self.keyframes))
        self._kidnaps.begin_segment(self.graph.vertex_count, step.stamp_ns)
        added_sigmas = self._added_sigmas(given, T_last_now, is_prior=is_prior)
        covariance = covariance + np.diag(np.square(self.space.sigmas(*added_sigmas)))
        self._add_keyframe(step, T_last_now, covariance, given.T_map_base if given else None)
        if given:
            self._edges.initial_pose(self.keyframes[-1].vertex, given)
            self._solve()
        self._solve_if_due()
        self._use_pending(step.stamp_ns)

    def _motion_into(self, step: Step) -> tuple[Numbers, Array]:
        """The motion since the last keyframe by odometry; after a jump of time by its poses alone."""
        motion = self._keyframe_list.motion
        if motion is None:
            T_last_now = self.space.group.between(self.keyframes[-1].T_odom_base, step.T_odom_base)
            return T_last_now, np.zeros((self.space.dof, self.space.dof))
        if not step.broken:
            motion.step(step)
        self._use_pending(motion.now.stamp_ns)
        now = (self._keyframe_list.motion or motion).now  # of another keyframe, where one of these deserved it
        return now.T_keyframe_base, now.covariance

    def _added_sigmas(self, given: InitialPose | None, T_last_now: Numbers, *, is_prior: bool) -> tuple[float, float]:
        """The noise added to the motion into a new segment: sigmas in metres and in radians.

        A pose that is given far away must not pull on the path before: it may be wrong.
        """
        jump_m, jump_rad = self.config.odometry.jump_sigma_m, self.config.odometry.jump_sigma_rad
        if given is None:
            return jump_m, jump_rad
        if is_prior:
            return self.config.initialpose.loosen_m, self.config.initialpose.loosen_rad
        group, last = self.space.group, self._pose(self.keyframes[-1].vertex)
        away = group.between(group.compose(last, T_last_now), given.T_map_base)
        far_m = math.hypot(*away[: self.space.dimensions])
        return max(jump_m, min(_UNCERTAIN * far_m, _MAX_UNCERTAIN_M)), max(jump_rad, _UNCERTAIN * math.pi)

    def _forget_time(self) -> None:
        """Stamps begin anew, the map stays: the next odometry begins a segment."""
        self._use(self._order.flush())
        self._drop_unreached()
        self._order.forget()
        self._odometry.forget()
        self._keyframe_list.forget_time()
        self._thinning.forget_time()

    # -- observations --------------------------------------------------------------------------------------------

    def _on_observation(self, m: Observation) -> None:
        """Use what is not too late; what is newer than all odometry waits for the next."""
        newest_ns = self.newest_odometry_ns
        if newest_ns is None or m.stamp_ns < self._keyframe_list.oldest_ns:
            self._count(m, "before_odometry")
        elif m.stamp_ns < self._keyframe_list.remembered_ns:
            self._count(m, "late")
        elif m.stamp_ns <= newest_ns:
            self._observe(m)
        elif len(self._pending) >= self.config.ordering.max_waiting:
            self._count(m, "overflow")
        else:
            self._pending.append(m)

    def _use_pending(self, until_ns: int) -> None:
        """Use what waited for the odometry that has come."""
        if self._pending:
            ready = [m for m in self._pending if m.stamp_ns <= until_ns]
            self._pending = [m for m in self._pending if m.stamp_ns > until_ns]
            for m in ready:
                self._on_observation(m)

    def _drop_unreached(self) -> None:
        for m in self._pending:
            self._count(m, "after_odometry")
        self._pending.clear()

    def _count(self, m: Observation, reason: str) -> None:
        self.counters.count(m.topic, reason, len(m.sightings) if isinstance(m, Sightings) else 1)

    def _observe(self, observed: Observation) -> None:
        within = self._within_reach(observed)
        m = self._thinned(within) if within else None
        if m is None:
            return
        where = self._keyframe_list.where(m.stamp_ns)
        motion = self._keyframe_list.motion
        if motion is not None and self._deserves_keyframe(m, where, motion):
            where = self._keyframe_at(where, motion)
        match m:
            case Sightings():
                self._unsolved_sightings += self._keyframe_list.rests
                self.sighting_poses.append(where.keyframe, m.stamp_ns, where.T_keyframe_base)
                m = replace(m, sightings=tuple(off_the_pole(self.space, s) for s in m.sightings))
                for name, sighting in self._of_known_while_lost(m.topic, self._identified(m, where)):
                    self._align_to_survey(m.topic, name, sighting, where)
                    self._landmarks.add(m.topic, name, sighting, where)
            case Fix():
                self._align_to_fix(m, where)
                self._edges.fix(m, where, self._pose(where.vertex))
            case Closure():
                self._add_closure(m, where)
        self._solve_if_due()

    def _within_reach(self, m: Observation) -> Observation | None:
        """The part of an observation that is within the reach of its sensor."""
        within, beyond = self._reach.split(m)
        if beyond:
            self.counters.count(m.topic, "beyond_max_distance", beyond)
        return within

    def _thinned(self, m: Observation) -> Observation | None:
        """The observation as it is to be used; None where that before it says the same."""
        used: Observation | None = m
        if isinstance(m, Sightings) and self._thinning.is_repeated(m, self._keyframe_list.rests):
            used = None
        elif isinstance(m, Fix):
            used = self._thinning.thinned(m)
        if used is None:
            self._count(m, "thinned")
        return used

    def _align_to_fix(self, m: Fix, where: PoseAtStamp) -> None:
        """The first fix of its kind tells where the map lies."""
        T_map_base = self.space.group.compose(self._pose(where.vertex), where.T_keyframe_base)
        if self._anchor.align_to_fix(m, T_map_base, len(self.keyframes) - 1):
            self._note_moved(m.topic)

    def _align_to_survey(self, topic: str, name: str, s: Sighting, where: PoseAtStamp) -> None:
        """The first sighting of a surveyed landmark does."""
        found = self._landmarks.survey_of(name, s, where)
        if found is not None and self._anchor.align_to_landmark(*found, len(self.keyframes) - 1):
            self._note_moved(topic)

    def _note_moved(self, topic: str) -> None:
        self.counters.count(topic, "map_moved")
        self._failure_guard.note_moved()

    def _deserves_keyframe(self, m: Observation, where: PoseAtStamp, newest: IntegratedOdometry) -> bool:
        """Return whether the motion since the keyframe would be too much of the noise of what was measured."""
        if where.keyframe != newest.keyframe or not newest.before_last_ns < where.stamp_ns:
            return False
        is_soon = where.stamp_ns - newest.start_ns < self.config.keyframes.min_interval_s * 1e9
        if self._noise.is_jitter(where.T_keyframe_base):
            return False
        most, added_sigma_m = self.config.keyframes.shared_noise, self.config.landmarks.added_sigma_m
        if is_soon:
            most = max(most, _SHARED_WHEN_SOON)
        return motion_compensation.motion_noise_dominates(self.space, m, where, most, added_sigma_m)

    def _keyframe_at(self, where: PoseAtStamp, motion: IntegratedOdometry) -> PoseAtStamp:
        """A keyframe at a stamp within the last step of odometry, which is cut in two."""
        group, size = self.space.group, self.space.dof
        T_odom_base = group.compose(self.keyframes[where.keyframe].T_odom_base, where.T_keyframe_base)
        stood = motion.now.stands
        rest = motion.cut(where.stamp_ns)
        step = Step(where.stamp_ns, self.space.identity, T_odom_base)
        self._add_keyframe(step, motion.now.T_keyframe_base, where.covariance)
        begun = self._keyframe_list.motion
        if rest is not None and begun is not None:
            begun.resume_after_cut(rest, stood)
        vertex = self.keyframes[-1].vertex
        return PoseAtStamp(len(self.keyframes) - 1, vertex, where.stamp_ns, self.space.identity, np.zeros((size, size)))

    def _identified(self, m: Sightings, where: PoseAtStamp) -> list[tuple[str, Sighting]]:
        """The sightings to be used, each with the landmark it is of."""
        how = self.config.landmarks.association
        if how == "none":
            self._count(m, "not_used")
            return []
        if how == "id":
            named = [(s.id, s) for s in m.sightings if s.id]
            if len(named) < len(m.sightings):
                self.counters.count(m.topic, "no_id", len(m.sightings) - len(named))
            return named
        return self._anonymous.identified(m, where)

    def _of_known_while_lost(self, topic: str, found: list[tuple[str, Sighting]]) -> list[tuple[str, Sighting]]:
        """All; but while an alarm cannot be decided, those of landmarks that are in the map."""
        if self.backend.trusts_sightings:
            return found
        known = [(name, sighting) for name, sighting in found if name in self._landmarks.known]
        if len(known) < len(found):
            self.counters.count(topic, "new_while_elsewhere", len(found) - len(known))
        return known

    def _add_closure(self, m: Closure, where: PoseAtStamp) -> None:
        if not self._keyframe_list.oldest_ns <= m.from_stamp_ns <= (self.newest_odometry_ns or 0):
            self.counters.count(m.topic, "from_where_there_was_no_odometry")
            return
        self._edges.closure(m, self._keyframe_list.where(m.from_stamp_ns), where)

    # -- solving -------------------------------------------------------------------------------------------------

    def _solve_if_due(self) -> None:
        if self._unsolved_keyframes + self._unsolved_sightings >= self.config.solve.every_keyframes:
            self._solve()

    def _solve(self, everything: Settings | None = None) -> None:
        """Take in what is new, or solve everything; where that fails the last estimate stays, and it is counted."""
        self._unsolved_keyframes = self._unsolved_sightings = self._solved_vertices = 0
        if not self.keyframes:
            return
        keyframe = len(self.keyframes) - 1
        solved = self._failure_guard.solve(lambda: self._solved(keyframe, everything), keyframe)
        if solved is None:
            return
        fits, report, self._covariance = solved
        self.report = report or self.report
        self.solves += 1
        self._solved_vertices, self._solved_edges = self.backend.handed_over
        self._note_correction(fits)

    def _solved(
        self, keyframe: int, everything: Settings | None
    ) -> tuple[list[tuple[float, int]], Report | None, Array]:
        """Solve; returns the fit of new edges before, the report of a full solve, and the newest pose's covariance."""
        self.backend.hand_over()
        self._kidnaps.add(self.backend.handed_over[1], self._now_ns)
        fits, report = self._fit_of(range(self._solved_edges, self.backend.handed_over[1])), None
        if everything is None:
            self._review_if_due()
            self.backend.update(keyframe)
            self._kidnaps.check(self.keyframes.ids, self._now_ns)
        else:
            report = self.backend.optimize(keyframe, everything)
        (covariance,) = self.solver.marginal([self.keyframes[keyframe].vertex])
        if not np.isfinite(covariance).all():
            raise DivergedError("the covariance is not finite")
        return fits, report, covariance

    def _withdraw(self, edges: Sequence[int]) -> None:
        self.backend.withdraw(edges, len(self.keyframes) - 1)

    def _fit_of(self, edges: range) -> list[tuple[float, int]]:
        """(chi2 per number measured, edge) of the new edges that fit least: what may move the map."""
        chi2, numbers = self.solver.chi2_of(edges)
        fit = chi2 / numbers
        return [(float(fit[k]), edges[k]) for k in np.argsort(-fit, kind="stable")[:_BLAMED].tolist()]

    def _note_correction(self, fits: list[tuple[float, int]]) -> None:
        """Against where the robot would be by the last solve and its odometry."""
        group, newest = self.space.group, self.keyframes[-1]
        before, self._solved_T_map_odom = self._solved_T_map_odom, self.T_map_odom
        moved = group.between(group.compose(before, newest.T_odom_base), self._pose(newest.vertex))
        distance_m = math.hypot(*moved[: self.space.dimensions])
        chi2, edges = zip(*fits, strict=True) if fits else ((), ())
        self.correction = Correction(distance_m, float(self.space.angle(moved)), edges, chi2)

    def _clear_closures(self) -> None:
        """Take all loop closures out, but for those of a frozen map; the next solve goes without them."""
        self.backend.hand_over()
        closures = [edge for edge in self.graph.edges_of("closures").tolist() if edge >= self.ledger.final]
        self._withdraw(closures)
        if closures:
            self.counters.count("closures", "cleared", len(closures))
            self._solve()

    def _review_if_due(self) -> None:
        """Look at the unnamed landmarks again now and then; what that changes is part of the solve that follows."""
        due = self.config.landmarks.review_every_keyframes
        if (
            self._landmarks.begins_new
            and self.config.landmarks.association in ("nearest", "joint")
            and len(self.keyframes) % due == 0
        ):
            self._anonymous.review(self.keyframes[-1].stamp_ns)

    def _pose(self, vertex: int) -> Numbers:
        return tuple(self.solver.estimate([vertex])[0].tolist())
