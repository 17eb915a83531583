"""The pipeline: one object, one door. Node, replay and tests all call ``GraphSlam.process``.

Its state is a function of the configuration and the sequence of accepted measurements, nothing else.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import GraphSlamError, NoiseError
from graph_slam_ros.graph import (
    LANDMARK_POSITION,
    POSE_PRIOR,
    R2,
    RELATIVE_POSE,
    SE2,
    TAG_POSITION,
    Gaussian,
    Graph,
)
from graph_slam_ros.lie import se2
from graph_slam_ros.slam.config import Config
from graph_slam_ros.slam.counters import Counters
from graph_slam_ros.slam.measurements import Control, Measurement, Odometry, Sighting, Sightings
from graph_slam_ros.slam.motion import Motion, Moved
from graph_slam_ros.slam.stamp_order import StampOrder
from graph_slam_ros.slam.track import Track
from graph_slam_ros.solver import Report, Settings, Solver

Array = NDArray[np.float64]

_LEAST_VARIANCE = np.array([1e-8, 1e-8, 1e-10])  # 0.1 mm, 0.01 mrad: nothing is ever certain
_LEAST_EIGENVALUE = 1e-9  # of the largest, where rounding has left a covariance indefinite


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A selected instant: its vertex, its stamp, and where odometry put it. No estimate: the solver owns that."""

    vertex: int
    stamp_ns: int
    T_odom_base: se2.Pose


@dataclass(slots=True)
class Landmark:
    """A landmark with identity: its vertex and how often and when it was seen."""

    vertex: int
    sightings: int
    last_seen_ns: int


@dataclass(frozen=True, slots=True)
class SightingPose:
    """Where the robot was when it saw something: a keyframe, by its index, and the motion since."""

    keyframe: int
    stamp_ns: int
    T_keyframe_base: se2.Pose


@dataclass(frozen=True, slots=True)
class Update:
    """What ``process`` changed: indices of new keyframes; whether it solved; the report of a solve of everything."""

    keyframes: tuple[int, ...] = ()
    solved: bool = False
    report: Report | None = None

    def __bool__(self) -> bool:
        return bool(self.keyframes) or self.solved


_NOTHING = Update()


class GraphSlam:
    """Online pose-graph SLAM in the plane, from odometry and sightings of landmarks with known identity.

    Parameters
    ----------
    config : the parameters
    sink : called with every measurement that was accepted, in that order, before it takes effect
    """

    def __init__(self, config: Config | None = None, sink: Callable[[Measurement], None] | None = None) -> None:
        self.config = config or Config()
        self.counters = Counters()
        self.graph = Graph()
        self.solver = Solver(self.graph, self.config.solver_settings())
        self.keyframes = Track(Keyframe)
        self.landmarks: dict[str, Landmark] = {}
        self.sighting_poses = Track(SightingPose)
        self.solves = 0
        self.report: Report | None = None  # of the last solve of everything
        self._sink = sink
        self._order = StampOrder(self.config.ordering, self.counters)
        self._odometry: Odometry | None = None
        self._motions: deque[Motion] = deque(maxlen=2)  # since the newest keyframe, and since the one before
        self._waiting: list[Sightings] = []
        self._covariance = np.zeros((3, 3))
        self._handed_over = 0, 0  # vertices and edges the solver has
        self._solved_vertices = 0  # of these, what the last solve took in: none where it failed
        self._unsolved_keyframes = 0

    # -- the door ------------------------------------------------------------------------------------------------

    def process(self, measurement: Measurement) -> Update:
        """Take one measurement or control event; returns what it changed."""
        if not isinstance(measurement, Control) and not self._order.accepts(measurement):
            return _NOTHING
        if self._sink is not None:
            self._sink(measurement)
        first_new, solves, report = len(self.keyframes), self.solves, self.report
        match measurement:
            case Odometry() | Sightings():
                self._use(self._order.push(measurement))
            case Control("flush"):
                self._use(self._order.flush())
            case Control("end"):
                self._use(self._order.flush())
                self._drop_unreached()
            case Control("optimize"):
                self._solve(self.config.solver_settings())
            case _:
                self.counters.count("control", f"unknown event {measurement.event}")
        if len(self.keyframes) == first_new and self.solves == solves:
            return _NOTHING
        new = self.report if self.report is not report else None
        return Update(tuple(range(first_new, len(self.keyframes))), self.solves > solves, new)

    # -- what is known now ---------------------------------------------------------------------------------------

    def trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` of all keyframes, (n, 3)."""
        return self.solver.estimate(self.keyframes.ids).reshape(-1, 3)

    def sighting_trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` at the stamps of the sightings, (n, 3)."""
        return self._at_sightings(self.trajectory())

    def sighting_odometry(self) -> Array:
        """What odometry alone says, ``T_odom_base`` at the stamps of the sightings, (n, 3)."""
        return self._at_sightings(self.keyframes.poses)

    def _at_sightings(self, keyframe_poses: Array) -> Array:
        keyframes = keyframe_poses[self.sighting_poses.ids]
        return np.stack(se2.compose(tuple(keyframes.T), tuple(self.sighting_poses.poses.T)), axis=-1)

    @property
    def T_map_odom(self) -> se2.Pose:
        """The correction: odometry's drift at the newest keyframe."""
        if not self.keyframes:
            return se2.IDENTITY
        newest = self.keyframes[-1]
        return se2.compose(self._pose(newest), se2.inverse(newest.T_odom_base))

    @property
    def pose_covariance(self) -> Array:
        """Covariance (3, 3) of the newest keyframe's pose in its tangent space.

        The marginal of the last solve, lengthened by the odometry since.
        """
        return self._covariance.copy()

    def landmark_covariances(self) -> list[Array]:
        """Marginal of each landmark, (2, 2) in the map's axes or (3, 3) in its tangent space; NaN where unknown.

        Looking changes nothing: a landmark that was first seen after the last solve is unknown until the next, and so
        are all where that failed.
        """
        vertices = [landmark.vertex for landmark in self.landmarks.values()]
        out = [np.full((dof, dof), np.nan) for dof in (self.graph.kind_of(vertex).dof for vertex in vertices)]
        known = [k for k, vertex in enumerate(vertices) if vertex < self._solved_vertices]
        for k, marginal in zip(known, self.solver.marginal([vertices[k] for k in known]), strict=True):
            out[k] = marginal
        return out

    @property
    def newest_odometry_ns(self) -> int | None:
        """Stamp of the last odometry that was used."""
        return None if self._odometry is None else self._odometry.stamp_ns

    # -- odometry ------------------------------------------------------------------------------------------------

    def _use(self, released: list[Odometry | Sightings]) -> None:
        for m in released:
            if isinstance(m, Odometry):
                self._on_odometry(m)
            else:
                self._on_sightings(m)

    def _on_odometry(self, m: Odometry) -> None:
        if self._odometry is None:
            self._odometry = m
            self._first_keyframe(m)
            return
        if m.stamp_ns == self._odometry.stamp_ns:
            self.counters.count("odometry", "duplicate" if m == self._odometry else "duplicate_stamp")
            return
        self._motions[-1].step(m)
        self._odometry = m
        self._see_waiting()
        if self._keyframe_due():
            self._next_keyframe(m)

    def _keyframe_due(self) -> bool:
        due, motion = self.config.keyframes, self._motions[-1]
        x, y, theta = motion.now.T_keyframe_base
        far = x * x + y * y >= due.min_distance_m**2 or abs(theta) >= due.min_angle_rad
        return far or motion.moving_ns / 1e9 >= due.max_interval_s

    def _first_keyframe(self, m: Odometry) -> None:
        """Map begins where odom begins: the first pose is anchored at its odometry pose."""
        vertex = self.graph.add_vertex(SE2, m.T_odom_base)
        anchor = self.config.anchor
        noise = Gaussian.from_sigmas(anchor.sigma_m, anchor.sigma_m, anchor.sigma_rad)
        self._covariance = np.diag([anchor.sigma_m**2, anchor.sigma_m**2, anchor.sigma_rad**2])
        self.graph.add_edge(POSE_PRIOR, [vertex], m.T_odom_base, noise, "anchor")
        self.keyframes.append(vertex, m.stamp_ns, m.T_odom_base)
        self._motions.append(Motion(self.config.odometry, 0, m))

    def _next_keyframe(self, m: Odometry) -> None:
        motion, last = self._motions[-1].now, self.keyframes[-1]
        noise = self._noise("odometry", motion.covariance)
        vertex = self.graph.add_vertex(SE2, se2.compose(self._pose(last), motion.T_keyframe_base))
        self.graph.add_edge(RELATIVE_POSE, [last.vertex, vertex], motion.T_keyframe_base, noise, "odometry")
        self.keyframes.append(vertex, m.stamp_ns, m.T_odom_base)
        self._covariance = se2.propagate(self._covariance, motion.T_keyframe_base, motion.covariance)
        self._motions.append(Motion(self.config.odometry, len(self.keyframes) - 1, m))
        self._unsolved_keyframes += 1
        self._solve_if_due()

    # -- landmarks -----------------------------------------------------------------------------------------------

    def _on_sightings(self, m: Sightings) -> None:
        """Use what was seen since the keyframe before last; what is newer than all odometry waits for the next."""
        if self._odometry is None or m.stamp_ns < self.keyframes[0].stamp_ns:
            self.counters.count(m.topic, "before_odometry", len(m.sightings))
        elif m.stamp_ns < self._motions[0].start_ns:
            self.counters.count(m.topic, "late", len(m.sightings))
        elif m.stamp_ns <= self._odometry.stamp_ns:
            self._see(m)
        elif len(self._waiting) >= self.config.ordering.max_waiting:
            self.counters.count(m.topic, "overflow", len(m.sightings))
        else:
            self._waiting.append(m)

    def _see_waiting(self) -> None:
        """Use what waited for the odometry that has come."""
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            for m in waiting:
                self._on_sightings(m)

    def _drop_unreached(self) -> None:
        for m in self._waiting:
            self.counters.count(m.topic, "after_odometry", len(m.sightings))
        self._waiting.clear()

    def _see(self, m: Sightings) -> None:
        """Carry sightings to the keyframe before them by the odometry in between, whose noise adds to theirs."""
        motion = next(motion for motion in reversed(self._motions) if motion.start_ns <= m.stamp_ns)
        moved, keyframe = motion.at(m.stamp_ns), self.keyframes[motion.keyframe]
        self.sighting_poses.append(motion.keyframe, m.stamp_ns, moved.T_keyframe_base)
        for sighting in m.sightings:
            self._add_sighting(m.topic, sighting, m.stamp_ns, keyframe, moved)
        self._solve_if_due()

    def _add_sighting(self, topic: str, sighting: Sighting, stamp_ns: int, keyframe: Keyframe, moved: Moved) -> None:
        landmark = self.landmarks.get(sighting.id)
        is_point = len(sighting.measured) == 2 or (landmark is not None and self.graph.kind_of(landmark.vertex) is R2)
        carry = _carry_point if is_point else _carry_pose
        measured, covariance = carry(sighting, moved.T_keyframe_base, moved.covariance)
        covariance[:2, :2] += self.config.landmarks.added_sigma_m**2 * np.eye(2)
        noise = self._noise(topic, covariance)
        if landmark is None:
            act = se2.act if is_point else se2.compose
            kind = R2 if is_point else SE2
            vertex = self.graph.add_vertex(kind, act(self._pose(keyframe), measured))
            landmark = self.landmarks[sighting.id] = Landmark(vertex, 0, stamp_ns)
        if not is_point:
            edge_type = RELATIVE_POSE
        else:
            edge_type = LANDMARK_POSITION if self.graph.kind_of(landmark.vertex) is R2 else TAG_POSITION
        self.graph.add_edge(edge_type, [keyframe.vertex, landmark.vertex], measured, noise, "landmarks")
        landmark.sightings += 1
        landmark.last_seen_ns = stamp_ns

    # -- solving -------------------------------------------------------------------------------------------------

    def _solve_if_due(self) -> None:
        if self._unsolved_keyframes >= self.config.solve.every_keyframes:
            self._solve()

    def _solve(self, everything: Settings | None = None) -> None:
        """Take in what is new, or solve everything; where that fails the last estimate stays, and it is counted."""
        self._unsolved_keyframes = self._solved_vertices = 0
        if not self.keyframes:
            return
        self._hand_over()
        try:
            if everything is None:
                self.solver.update()
            else:
                self.report = self.solver.optimize(everything)
            (self._covariance,) = self.solver.marginal([self.keyframes[-1].vertex])
            self.solves += 1
            self._solved_vertices = self._handed_over[0]
        except GraphSlamError as error:
            self.counters.count("solver", type(error).__name__)

    def _hand_over(self) -> None:
        """Give the solver what is new in the graph."""
        vertices, edges = self._handed_over
        if (vertices, edges) == (self.graph.vertex_count, self.graph.edge_count):
            return
        self._handed_over = self.graph.vertex_count, self.graph.edge_count
        self.solver.add(range(vertices, self.graph.vertex_count), range(edges, self.graph.edge_count))

    def _noise(self, source: str, covariance: Array) -> Gaussian:
        """Noise of an edge, made before anything is added to the graph: it must not fail half-way."""
        size = len(covariance)
        least = covariance + np.diag(_LEAST_VARIANCE[:size])
        try:
            return Gaussian.from_covariance(least)
        except NoiseError:  # of extreme numbers: a kilometre's lever arm, an hour's motion in one step
            self.counters.count(source, "covariance_floored")
            values, vectors = np.linalg.eigh(0.5 * (least + least.T))
            floored = np.maximum(values, _LEAST_EIGENVALUE * values[-1])
            return Gaussian.from_covariance((vectors * floored) @ vectors.T)

    def _pose(self, keyframe: Keyframe) -> se2.Pose:
        x, y, theta = self.solver.estimate([keyframe.vertex])[0].tolist()
        return x, y, theta


def _carry_point(s: Sighting, T_a_b: se2.Pose, motion_covariance: Array) -> tuple[tuple[float, ...], Array]:
    """A point seen from b, seen from a: ``p_a = T_a_b p_b`` and the noise of both."""
    x, y = s.measured[:2]
    c, n = np.cos(T_a_b[2]), np.sin(T_a_b[2])
    rotation = np.array([[c, -n], [n, c]])
    if len(s.measured) == 2:
        own = np.array(s.covariance).reshape(2, 2)
    else:  # tangent space of the measured pose to the axes of b
        c, n = np.cos(s.measured[2]), np.sin(s.measured[2])
        turn = np.array([[c, -n], [n, c]])
        own = turn @ np.array(s.covariance).reshape(3, 3)[:2, :2] @ turn.T
    by_motion = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])
    covariance = rotation @ (own + by_motion @ motion_covariance @ by_motion.T) @ rotation.T
    return se2.act(T_a_b, (x, y)), covariance


def _carry_pose(s: Sighting, T_a_b: se2.Pose, motion_covariance: Array) -> tuple[tuple[float, ...], Array]:
    """A pose seen from b, seen from a: ``T_a_c = T_a_b T_b_c`` and the noise of both."""
    own = np.array(s.covariance).reshape(3, 3)
    measured: se2.Pose = (s.measured[0], s.measured[1], s.measured[2])
    return se2.compose(T_a_b, measured), se2.propagate(motion_covariance, measured, own)
