"""The pipeline. Node, replay, tests and benchmarks all call ``GraphSlam.process``, its only entry.

Measurements are put in order of stamp. Odometry becomes keyframes. Observations pass their gates, landmarks are
associated, and both become edges. Edges are gated, odometry is doubted where it is contradicted, and all is solved. The
state is a function of the configuration and the sequence of accepted measurements, and of nothing else.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NoReturn

from graph_slam_ros.config.config import Config
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edits import aliases
from graph_slam_ros.measurements.types import (
    Closure,
    Control,
    Event,
    Fix,
    InitialPose,
    Measurement,
    Observation,
    Odometry,
    Sightings,
    Value,
    check_space,
)
from graph_slam_ros.slam.anchor import Anchor
from graph_slam_ros.slam.association.assignments import Assigned
from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.background import run_when_asked
from graph_slam_ros.slam.bounded_map import BoundedMap
from graph_slam_ros.slam.doubt.detector import OdometryDoubt
from graph_slam_ros.slam.edits import Edits
from graph_slam_ros.slam.found_factors import FoundFactors
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.frontend.keyframes import KeyframeList
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.map_view import MapView
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.slam.solution import Solution
from graph_slam_ros.slam.trial_fits import TrialFits
from graph_slam_ros.slam.update import Update, UpdateLog
from graph_slam_ros.solver import Settings
from graph_slam_ros.typing import Executor


class GraphSlam:
    """Online pose-graph SLAM, in the plane or in space, from odometry, landmarks, fixes and loop closures.

    Parameters
    ----------
    config : the parameters
    sink : called with every measurement that is handed over, in that order, before it takes effect or is refused
    executor : starts a background job; the function that it returns waits for the result
    start : the map to go on in, which is then this object's; the next odometry begins a segment, unless the map tells
        that the same drive continues

    Attributes
    ----------
    view : what can be read: the path, the landmarks, their covariances, and the health
    counters : counts of what was refused, repaired and used
    settings : parameters that were changed on the way
    processed : the number of processed measurements and control events
    """

    def __init__(
        self,
        config: Config | None = None,
        sink: Callable[[Measurement], None] | None = None,
        executor: Executor = run_when_asked,
        start: MapSnapshot | None = None,
    ) -> None:
        config, start = config or Config(), start or MapSnapshot()
        self.counters = counters = Counters()
        path = KeyframeList(OdometryNoise(config.odometry, config.space), config.space)
        backend = Backend(path, config.robust, config.solver_settings(), start, counters, executor)
        landmarks = LandmarkFrontend(config, backend, counters, executor)
        frontend = KeyframeFrontend(config, path, backend.noise, counters, backend.solver, start.datum)
        doubt = OdometryDoubt(config, backend, counters, landmarks.anonymous, start)
        trials = TrialFits(config, backend, frontend, landmarks, doubt, counters, executor, len(start.keyframes))
        found = FoundFactors(config, backend, frontend, landmarks, start)
        solution = Solution(backend, frontend, landmarks, doubt, trials, found, counters)
        self._backend, self._frontend, self._landmarks = backend, frontend, landmarks
        self._doubt, self._solution, self._anchor = doubt, solution, Anchor(config, backend)
        self.settings = dict[str, Value]()
        self._sink, self._faults = sink or (lambda measurement: None), list[Exception]()
        self._edits = Edits(backend, frontend, landmarks.map, counters)
        landmarks.map.aliases = aliases(backend.edits)
        self.view = MapView(backend, frontend, landmarks, doubt, solution, self.settings)
        if start.keyframes:
            self._restore(start)
        self._bounded = BoundedMap(backend, frontend, landmarks, self._anchor, doubt, solution, counters)
        self._updates, self.processed = UpdateLog(self.view), 0

    def __repr__(self) -> str:
        return f"GraphSlam({self.view})"

    if not TYPE_CHECKING:  # or type checkers would believe in every name

        def __getattr__(self, name: str) -> NoReturn:
            """Say where a name is that was here before."""
            where = f": it is GraphSlam.view.{name}" if hasattr(MapView, name) else ""
            raise AttributeError(f"GraphSlam has no attribute {name!r}{where}", name=name, obj=self)

    def process(self, measurement: Measurement) -> Update:
        """Process one measurement or control event. Returns the changes.

        Of several exceptions the first is raised after everything else was processed; the others are counted. Raises
        FormatError for a measurement of other dimensions: then nothing has changed.
        """
        check_space(measurement, self.view.space.dimensions)
        self._sink(measurement)
        self.processed += 1
        self._updates.begin(self._bounded.condense())
        with self._collected():
            self._process(measurement)
        if self._faults:
            (first, *others), self._faults = self._faults, []
            for error in others:
                self.counters.count("node", type(error).__name__)
            raise first
        return self._updates.update()

    @contextmanager
    def _collected(self) -> Iterator[None]:
        """Collect an exception: a fault loses only its own measurement, step or sighting."""
        try:
            yield
        except Exception as error:
            self._faults.append(error)

    def _process(self, m: Measurement) -> None:
        if isinstance(m, Control):
            self._on_event(m.event, dict(m.values))
        elif isinstance(m, InitialPose):
            self._frontend.initial_pose = m
        elif self._frontend.accepts(m):
            self._use(self._frontend.order.push(m))

    def _use(self, released: Iterable[Odometry | Observation]) -> None:
        for m in released:
            with self._collected():
                if not isinstance(m, Odometry):
                    self._on_observation(self._frontend.corrections.observation(m))
                    continue
                for step in self._frontend.steps(m):
                    with self._collected():
                        self._on_step(step)

    def _on_step(self, step: Step) -> None:
        """Integrate odometry, use the observations that it has reached, and add a keyframe if one is due."""
        frontend = self._frontend
        self._add_assigned(self._landmarks.travel(step))
        if not self.view.keyframes:
            frontend.begin(step)
            first = self.view.keyframes[-1]
            frontend.covariance = self._anchor.begin(first.vertex, frontend.config.start_pose or step.T_odom_base)
            self._solution.begin()
            return
        begins_segment = frontend.begins_segment(step)
        self._use_reached(frontend.integrate(step))
        if begins_segment:
            self._doubt.begin_segment(self.view.graph.vertex_ids.next, step.stamp_ns)
            if frontend.begin_segment(step):
                self._solve()  # at the pose that was given
            self._solve_if_due()
            self._use_reached(step.stamp_ns)
        elif frontend.is_due():
            frontend.add(step)
            self._solve_if_due()

    def _use_reached(self, until_ns: int) -> None:
        for m in self._frontend.pending.reached(until_ns):
            with self._collected():
                self._on_observation(m)

    def _on_observation(self, m: Observation) -> None:
        """Pass an observation through the gates, and add it to the keyframe before it."""
        if not self._frontend.pending.is_reached(m):
            return
        if isinstance(m, Sightings):
            self._frontend.follow_frozen(m)
        admitted = self._frontend.gates.admit(m)
        if admitted is None:
            return
        match admitted:
            case Sightings():
                self._add_sightings(admitted, self._frontend.where(admitted))
            case Fix():
                self._add_fix(admitted, self._frontend.where(admitted))
            case Closure():
                later, earlier = self._frontend.where(admitted), self._frontend.path.where(admitted.from_stamp_ns)
                self._frontend.edges.closure(admitted, earlier, later)
        self._solve_if_due()

    def _add_sightings(self, m: Sightings, where: PoseAtStamp) -> None:
        self._solution.resting += self._frontend.path.rests
        self._frontend.sighting_poses.append(where.keyframe, m.stamp_ns, where.T_keyframe_base)
        self._add_assigned(self._landmarks.identified(m, where))

    def _add_assigned(self, sightings: Iterable[Assigned]) -> None:
        """Add sightings of landmarks. The first one of a surveyed landmark locates the map."""
        for one in sightings:
            with self._collected():
                found = self._landmarks.map.survey_of(one.name, one.sighting, one.where)
                if found is not None and self._anchor.align_to_landmark(*found):
                    self._note_moved(one.topic)
                self._landmarks.map.add(one.topic, one.name, one.sighting, one.where)

    def _add_fix(self, m: Fix, where: PoseAtStamp) -> None:
        pose_of, compose = self._solution.pose, self.view.space.group.compose
        if self._anchor.align_to_fix(m, compose(pose_of(where.vertex), where.T_keyframe_base)):
            self._note_moved(m.topic)
        self._frontend.edges.fix(m, where, pose_of(where.vertex))

    def _note_moved(self, topic: str) -> None:
        self.counters.count(topic, "map_moved")
        self._landmarks.anonymous.forget_belief()
        self._solution.guard.note_moved()

    def _solve_if_due(self) -> None:
        if self._solution.is_due:
            self._solve()

    def _solve(self, everything: Settings | None = None) -> None:
        if self.view.keyframes:
            self._solution.solve(everything)

    def _on_event(self, event: Event, values: dict[str, Value]) -> None:
        match event:
            case "flush" | "end" | "time_jump" | "clock_step":
                self._use(self._frontend.order.flush())
                if event != "flush":
                    self._frontend.drop_pending()
                    self._add_assigned(self._landmarks.end_scan())
                if event in ("time_jump", "clock_step"):
                    self._frontend.forget_time(goes_on=event == "clock_step")
            case "optimize":
                self._add_assigned(self._landmarks.end_scan())
                self._solve(self._frontend.config.solver_settings())
            case "clear_closures":
                if self._edits.clear_closures():
                    self._solve()
            case "remove":
                if self._edits.remove(values):
                    self._solve(self._frontend.config.solver_settings())
            case "set":
                self._set(values)
            case "restart":
                self.restart()

    def restart(self) -> None:
        """Return to the last good estimate after an exception outside."""
        self._solution.go_back()

    def _set(self, values: dict[str, Value]) -> None:
        before = self._frontend.config
        self._frontend.config = config = before.changed(values)
        self.settings |= values
        self._backend.solver.settings = config.solver_settings()
        if config.map.localize != before.map.localize:
            self._hold_map(config.map.localize)

    def _hold_map(self, is_held: bool) -> None:
        """Begin or end localization: the map is fixed, and the pose's covariance adds to the next odometry edge."""
        if is_held:
            self._solve(self._frontend.config.solver_settings())
            self._frontend.held_covariance = self.view.pose_covariance if self.view.keyframes else None
            self._backend.hold_map()
        else:
            self._frontend.held_covariance = None
            self._backend.release_map()
        self._landmarks.map.begins_new = not is_held
        self._solution.guard.note_good()

    def _restore(self, start: MapSnapshot) -> None:
        """Solve a loaded map. The robot's pose in it is not known yet."""
        if self.view.graph.kind_of(int(start.keyframes.ids[0])) is not self.view.space.pose:
            raise GraphSlamError(f"the map is not in {self.view.space.dimensions} dimensions")
        path = start.keyframes, start.segments, start.drives, start.sighting_poses
        self._frontend.restore(*path, start.drive if start.continues else {}, start.gyro_bias)
        self._anchor.restore()
        self._landmarks.map.restore(start.landmarks)
        self._landmarks.anonymous.restore()
        localizes = self._frontend.config.map.localize
        report = self._backend.restore(start.vertices, start.values, start.held if localizes else (0, 0))
        self._solution.restore(report)
        (self._frontend.covariance,) = self._backend.solver.marginal([self.view.keyframes[-1].vertex])
        if localizes:
            self._backend.hold_map()
            self._backend.solver.update()
            self._landmarks.map.begins_new = False
