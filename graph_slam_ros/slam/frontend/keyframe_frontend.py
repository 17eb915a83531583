"""The front end: odometry becomes keyframes. Each is a vertex, joined to the one before by an odometry edge."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.edge_noise import edge_noise
from graph_slam_ros.measurements.types import (
    AngularVelocity,
    Closure,
    Fix,
    InitialPose,
    Measured,
    Observation,
    Odometry,
    Sightings,
)
from graph_slam_ros.slam.frontend import motion_compensation
from graph_slam_ros.slam.frontend.corrections import Corrections
from graph_slam_ros.slam.frontend.frozen_odometry import FrozenOdometry
from graph_slam_ros.slam.frontend.gates import Gates
from graph_slam_ros.slam.frontend.gyro import GyroFusion, SavedBias
from graph_slam_ros.slam.frontend.keyframes import Keyframe, KeyframeList, SightingPose
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.odometry_integration import IntegratedOdometry, OdometryNoise
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD, OdometrySelector, Step
from graph_slam_ros.slam.frontend.stamp_order import PendingObservations, StampOrder
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.noise.factors import NoiseScales
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

_UNCERTAIN, _MAX_UNCERTAIN_M = 10.0, 1e5  # times as far as a given pose is away: so little odometry is trusted there
_NEAR, _SLOW = 0.15, 3.5  # the same seen from nearer [m, rad] than this is soon for so many times the least interval


class KeyframeFrontend:
    """Integrates odometry, chooses keyframes, and adds them and the motion between them to the graph.

    Parameters
    ----------
    edges : adds edges to the graph
    solver : tells where the last keyframe is
    datum : of a map that is loaded

    Attributes
    ----------
    config : the present parameters
    path : the keyframes
    sighting_poses : where the robot observed landmarks
    order : brings measurements into the order of their stamps
    pending : observations that odometry has not reached
    gates : what an observation passes before it is used
    edges : adds fixes, loop closures and poses that are given
    corrections : of odometry and sightings
    gyro : as part of odometry; None where no input is one
    T_odom_base : of the last step of odometry, as its messages have it
    covariance : (dof, dof) of the newest keyframe's pose, by the last solve and the odometry since
    initial_pose : the pose that is given for the next odometry
    frozen_ns : when sightings last showed that the robot moves while odometry stands still
    held_covariance : (dof, dof) of the newest pose when the map was held, for the next odometry
    """

    def __init__(
        self,
        config: Config,
        path: KeyframeList,
        edges: NoiseScales,
        counters: Counters,
        solver: Solver,
        datum: tuple[float, ...] = (),
    ) -> None:
        self.config, self._space, self._solver = config, config.space, solver
        self._edges, self._graph, self._counters = edges, edges.graph, counters
        self._noise = OdometryNoise(config.odometry, self._space)
        self.odometry = OdometrySelector(config.odometry, config.inputs.names.split(), self._space, counters)
        self.path = path
        self.sighting_poses = StampedPoses(SightingPose, self._space.pose.size)
        self.corrections = Corrections(config)
        self.order = StampOrder(config.ordering, counters, self.corrections.lag_ns)
        self.pending = PendingObservations(config.ordering, self.path, self.odometry, counters)
        self.gates = Gates(config, path, self.odometry, counters, datum)
        self._frozen = FrozenOdometry(self._noise, self._space)
        self.frozen_ns: int | None = None
        self.edges = PoseEdges(self._space, edges, counters)
        self.covariance = np.zeros((self._space.dof, self._space.dof))
        self.gyro = GyroFusion(config, self._noise, counters) if config.gyro_input else None
        self._sigma_factors = {one.name: one.sigma_factor for one in config.sources}
        self.T_odom_base: Numbers = self._space.identity
        self.initial_pose: InitialPose | None = None
        self.held_covariance: Array | None = None
        self._observed_from, self._observed = -1, set[str]()  # a keyframe, and what was observed since
        self._before_step: Array | None = None  # covariance of the motion until the clock was set

    @property
    def source(self) -> str:
        """The name of the odometry input in use; empty before its first message."""
        return self.odometry.used.source if self.odometry.used else ""

    @property
    def now_ns(self) -> int:
        """Stamp of the newest odometry or keyframe."""
        return max(self.odometry.newest_ns or 0, self.path.keyframes[-1].stamp_ns)

    def restore(
        self,
        keyframes: StampedPoses[Keyframe],
        segments: Sequence[int],
        drives: Sequence[int],
        sighting_poses: StampedPoses[SightingPose],
        drive: Mapping[str, Any],
        gyro_bias: SavedBias | None,
    ) -> None:
        """Continue after the keyframes of a map, and where ``drive`` was, if that is given."""
        self.path.restore(keyframes, segments, drives)
        if self.gyro and gyro_bias:
            self.gyro.restore(gyro_bias)
        if drive:
            self.path.go_on(drive["path"])
            used = self.odometry.go_on(drive["odometry"])
            self.T_odom_base = used.T_odom_base
            self.order.go_on(used.stamp_ns)
            self.gates.go_on(drive["thinning"])
            self._observed_from, self._observed = drive["observed"][0], set(drive["observed"][1])
            self._edges.due = tuple(drive["noise_due"])
        self.sighting_poses = sighting_poses

    @property
    def drive(self) -> dict[str, Any]:
        """Plain values of what the next odometry continues, beside the map; empty where a new drive begins."""
        if self.odometry.used is None:
            return {}
        return {
            "path": self.path.state,
            "odometry": self.odometry.state,
            "thinning": self.gates.state,
            "observed": [self._observed_from, sorted(self._observed)],
            "noise_due": self._edges.due,
        }

    def forget_before(self, first: int) -> None:
        """Forget the keyframes before a number."""
        self.path.forget_before(first)
        self.sighting_poses = self.sighting_poses.without(np.flatnonzero(self.sighting_poses.ids < first))

    def forget_time(self, *, goes_on: bool = False) -> None:
        """Keep the map and start over with the stamps: the next odometry begins a segment, or goes on."""
        motion = self.path.motion
        self._before_step = motion.now.covariance if motion is not None and goes_on else None
        self.order.forget()
        self.odometry.forget()
        self.path.forget_time()
        self.gates.forget_time()
        if self.gyro:
            self.gyro.forget()

    def accepts(self, m: Measured) -> TypeGuard[Odometry | Observation]:
        """Return whether a measurement may be queued. If not, it is counted, or it was a gyro's and is used up."""
        if isinstance(m, AngularVelocity):
            self._add_to_gyro(m)
            return False
        return self.order.accepts(m) and (isinstance(m, Odometry) or self.gates.accepts(m))

    def steps(self, m: Odometry) -> Iterator[Step]:
        """Yield the corrected steps that an odometry message completes."""
        before_ns = self.odometry.newest_ns
        for step in self.odometry.steps(m):
            seconds = 0.0 if before_ns is None else (step.stamp_ns - before_ns) * 1e-9
            before_ns, self.T_odom_base = step.stamp_ns, step.T_odom_base
            if self.gyro is None:
                yield self.corrections.step(step, seconds)
                continue
            fused = self.gyro.fuse(self.corrections.step(step), seconds)
            yield self.corrections.with_bias(fused, seconds)

    def _add_to_gyro(self, m: AngularVelocity) -> None:
        if self.gyro is None or m.topic != self.gyro.name:
            self._counters.count(m.topic, "not_in_use")
        else:
            self.gyro.add(m)

    def drop_pending(self) -> None:
        """Drop what is pending, because no odometry follows."""
        self.pending.drop()
        if self.gyro:
            self.gyro.drop()

    # -- the motion since the last keyframe ------------------------------------------------------------------------

    def begins_segment(self, step: Step) -> bool:
        """Return whether a step begins a segment: odometry or time jumped, or a pose was given."""
        return self.path.motion is None or step.broken or self.initial_pose is not None

    def integrate(self, step: Step) -> int:
        """Add a step to the motion since the last keyframe, unless it is no motion; return the stamp it reaches."""
        motion = self.path.motion
        if motion is None:
            return step.stamp_ns
        if not step.broken:
            motion.step(step)
            self.path.samples.add(step)
        return motion.now.stamp_ns

    def is_due(self) -> bool:
        """Return whether the motion since the last keyframe is large enough for another."""
        motion, longest_ns = self.path.motion, self.config.keyframes.max_interval_s * 1e9
        if motion is None or self.held_covariance is not None:
            return motion is not None
        at, due = motion.now.T_keyframe_base, self.config.keyframes
        is_far = self._space.square(at) >= due.min_distance_m**2 or self._space.angle(at) >= due.min_angle_rad
        return is_far or motion.is_long or (motion.moving_ns >= longest_ns and not self._noise.is_jitter(at))

    # -- keyframes -------------------------------------------------------------------------------------------------

    def begin(self, step: Step) -> None:
        """Add the first keyframe: at the pose of odometry, or at the initial pose that was given."""
        vertex = self._graph.add_vertex(self._space.pose, self.config.start_pose or step.T_odom_base)
        self.path.segments.append(0)
        self.path.append(vertex, step, self.config.ordering.late_s)

    def add(self, step: Step) -> None:
        """Add a keyframe at a step that was integrated before."""
        now = self._motion.now
        covariance, held = now.covariance, self.held_covariance
        if held is not None:  # the first that is free in a held map is as uncertain as the pose was then
            covariance, self.held_covariance = self._space.group.propagate(held, now.T_keyframe_base, covariance), None
        self._append(step, now.T_keyframe_base, covariance)

    def begin_segment(self, step: Step) -> bool:
        """Add a keyframe after a jump of odometry or time, or at a given pose; return whether one was added."""
        given, self.initial_pose, self.held_covariance = self.initial_pose, None, None
        motion, keyframes = self.path.motion, self.path.keyframes
        if motion is not None:
            T_last_now, covariance = motion.now.T_keyframe_base, motion.now.covariance
        else:  # of a loaded map, too: its odometry was that of another drive
            T_last_now = self._space.group.between(keyframes[-1].T_odom_base, step.T_odom_base)
            covariance = np.zeros_like(self.covariance)
        goes_on, self._before_step = self._before_step, None
        self.path.segments.append(len(keyframes))
        if goes_on is not None and given is None:
            covariance = goes_on + self._noise.of(T_last_now, 1.0, step.twist_covariance)
        else:
            covariance = covariance + np.diag(np.square(self._space.sigmas(*self._added_sigmas(given, T_last_now))))
        self._append(step, T_last_now, covariance, given.T_map_base if given else None)
        if given:
            self.edges.initial_pose(keyframes[-1].vertex, given)
        return given is not None

    def follow_frozen(self, m: Sightings) -> None:
        """Add a keyframe between loose edges where sightings show that the robot moved and odometry stood still."""
        where, motion = self.path.where(m.stamp_ns), self.path.motion
        if motion is None or where.keyframe != motion.keyframe or not motion.before_last_ns < m.stamp_ns:
            return
        T_odom_base = self._space.group.compose(self.path.keyframes[where.keyframe].T_odom_base, where.T_keyframe_base)
        if self._frozen.has_moved(m, T_odom_base):
            self._counters.count(self.source.partition("#")[0], "frozen")
            self.frozen_ns = m.stamp_ns
            self._keyframe_at(where, motion)
            self.gates.forget_time()

    def where(self, m: Observation) -> PoseAtStamp:
        """Return the pose at an observation; add a keyframe there if odometry's noise since the last one matters."""
        where, motion = self.path.where(m.stamp_ns), self.path.motion
        if motion is not None and self._deserves_keyframe(m, where, motion):
            where = self._keyframe_at(where, motion)
        if isinstance(m, Sightings):
            if where.keyframe != self._observed_from:
                self._observed_from, self._observed = where.keyframe, set()
            self._observed.update(s.id for s in m.sightings)
        return where

    @property
    def _motion(self) -> IntegratedOdometry:
        motion = self.path.motion
        assert motion is not None
        return motion

    @property
    def _last_pose(self) -> Numbers:
        return tuple(self._solver.estimate([self.path.keyframes[-1].vertex])[0].tolist())

    def _append(self, step: Step, T_last_now: Numbers, covariance: Array, at: Numbers | None = None) -> None:
        """Add a vertex at odometry's pose, or at the given pose, and the edge from the vertex before."""
        group, last = self._space.group, self.path.keyframes[-1]
        vertex = self._graph.add_vertex(self._space.pose, at or group.compose(self._last_pose, T_last_now))
        covariance = covariance * self._sigma_factors.get(self.source, 1.0) ** 2
        if self.frozen_ns in (last.stamp_ns, step.stamp_ns):  # nobody knows how far, before and after
            covariance = covariance + np.diag(np.square(self._space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD)))
        noise = edge_noise(self._counters, "odometry", covariance, self._space.dimensions)
        relative_pose = self._space.relative_pose
        self._edges.add_edge(relative_pose, [last.vertex, vertex], T_last_now, noise, "odometry", self.source)
        self.covariance = group.propagate(self.covariance, T_last_now, covariance)
        self.path.append(vertex, step, self.config.ordering.late_s)

    def _added_sigmas(self, given: InitialPose | None, T_last_now: Numbers) -> tuple[float, float]:
        """Return the sigmas in metres and radians that are added to the motion into a new segment.

        A given pose that is far away must not pull on the path before it: it may be wrong.
        """
        if given is None:
            return JUMP_SIGMA_M, JUMP_SIGMA_RAD
        group = self._space.group
        away = group.between(group.compose(self._last_pose, T_last_now), given.T_map_base)
        far_m = math.hypot(*away[: self._space.dimensions])
        uncertain_m = min(_UNCERTAIN * far_m, _MAX_UNCERTAIN_M)
        return max(JUMP_SIGMA_M, uncertain_m), max(JUMP_SIGMA_RAD, _UNCERTAIN * math.pi)

    def _deserves_keyframe(self, m: Observation, where: PoseAtStamp, newest: IntegratedOdometry) -> bool:
        """Return whether the noise of the motion since the keyframe is too large beside that of the measurement."""
        if where.keyframe != newest.keyframe or not newest.before_last_ns < where.stamp_ns:
            return False
        if self._noise.is_jitter(where.T_keyframe_base):
            return False
        c, added_sigma_m = self.config.keyframes, self.config.landmarks.added_sigma_m
        since_s = (where.stamp_ns - newest.start_ns) * 1e-9
        most = max(c.shared_noise, 1.0) if since_s < c.min_interval_s else c.shared_noise
        if not motion_compensation.motion_noise_dominates(self._space, m, where, most, added_sigma_m):
            return False
        if since_s >= _SLOW * c.min_interval_s or not self._is_repeated(m, where):
            return True
        return motion_compensation.motion_noise_dominates(self._space, m, where, 1.0, added_sigma_m, sharpest=True)

    def _is_repeated(self, m: Observation, where: PoseAtStamp) -> bool:
        """Return whether the same was observed since the keyframe from nearly there. Without ids it may be new."""
        if not isinstance(m, Sightings) or where.keyframe != self._observed_from:
            return False
        moved, names = where.T_keyframe_base, {s.id for s in m.sightings}
        is_near = max(math.hypot(*moved[: self._space.dimensions]), self._space.angle(moved)) < _NEAR
        return is_near and "" not in names and names <= self._observed

    def _keyframe_at(self, where: PoseAtStamp, motion: IntegratedOdometry) -> PoseAtStamp:
        """Add a keyframe at a stamp within the last step of odometry; the step is cut in two."""
        group, size, keyframes = self._space.group, self._space.dof, self.path.keyframes
        stood = motion.now.stands
        rest = motion.cut(where.stamp_ns)
        T_odom_base = group.compose(keyframes[where.keyframe].T_odom_base, where.T_keyframe_base)
        if self.gyro or self.corrections.found or self.corrections.are_configured:  # not in odometry's own frame
            left = self.corrections.uncorrected(rest.T_last_base) if rest is not None else self._space.identity
            T_odom_base = tuple(map(float, group.compose(self.T_odom_base, group.inverse(left))))
        step = Step(where.stamp_ns, self._space.identity, T_odom_base)
        self._append(step, motion.now.T_keyframe_base, where.covariance)
        if rest is not None:
            self._motion.extend(rest, stood)
        keyframe = len(keyframes) - 1
        at_keyframe = self._space.identity, np.zeros((size, size))
        return PoseAtStamp(keyframe, keyframes[keyframe].vertex, where.stamp_ns, *at_keyframe)


class PoseEdges:
    """Adds fixes, loop closures and given poses to a graph. Repaired noise is counted."""

    def __init__(self, space: Geometry, edges: NoiseScales, counters: Counters) -> None:
        self._space, self._edges, self._counters = space, edges, counters

    def initial_pose(self, vertex: int, pose: InitialPose) -> None:
        """Add a prior for a pose that a user gave."""
        noise = self._noise("initialpose", motion_compensation.as_matrix(pose.covariance))
        self._edges.add_edge(self._space.pose_prior, [vertex], pose.T_map_base, noise, "initialpose")

    def fix(self, m: Fix, where: PoseAtStamp, T_map_keyframe: Numbers) -> None:
        """Add a prior to a keyframe. A position without some axes gives one prior per known principal axis."""
        space, vertices, topic = self._space, [where.vertex], m.topic
        if m.kind not in space.fixes:
            self._counters.count(topic, "not_in_this_space")
            return
        compensated = motion_compensation.fix(space, m, where, T_map_keyframe)
        n = space.dimensions
        axes = motion_compensation.axes_known(compensated.covariance) if m.kind == "position" else []
        for axis, variance in axes:
            noise = edge_noise(self._counters, topic, np.array([[variance]]), 1)
            along = float(axis @ compensated.measured[:n])
            measured = (*axis.tolist(), along, *compensated.measured[n:])
            self._edges.add_edge(space.coordinate_prior, vertices, measured, noise, "fixes", topic)
        if not axes:
            metres = n if m.kind in ("pose", "position") else 0
            noise = edge_noise(self._counters, topic, compensated.covariance, metres)
            self._edges.add_edge(space.fixes[m.kind], vertices, compensated.measured, noise, "fixes", topic)
        self._counters.used[topic] += 1

    def closure(self, m: Closure, earlier: PoseAtStamp, later: PoseAtStamp) -> None:
        """Add a closure between two keyframes."""
        if earlier.keyframe == later.keyframe:
            self._counters.count(m.topic, "within_one_keyframe")
            return
        compensated = motion_compensation.closure(self._space, m, earlier, later)
        noise, vertices = self._noise(m.topic, compensated.covariance), [earlier.vertex, later.vertex]
        self._edges.add_edge(self._space.relative_pose, vertices, compensated.measured, noise, "closures", m.topic)
        self._counters.used[m.topic] += 1

    def _noise(self, source: str, covariance: Array) -> Gaussian:
        """The noise of a pose."""
        return edge_noise(self._counters, source, covariance, self._space.dimensions)
