"""Odometry since a keyframe: relative motion and its covariance."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Any

import numpy as np

from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.typing import Array, Numbers

_REST_NS = 10**9  # for so long a robot must have stood before what its odometry jitters is no motion
_MOST = 10_000  # odometry messages that one motion remembers


@dataclass(slots=True)
class OdometrySample:
    """``T_keyframe_base`` at a stamp, and its covariance (dof, dof) in right tangent coordinates."""

    stamp_ns: int
    T_keyframe_base: Numbers
    covariance: Array
    twist_covariance: Numbers | None = None
    stands: bool = False  # since the odometry before
    turn_variance: Numbers | None = None  # of the rotation about each axis, for each second, where a gyro is part of it
    is_gap: bool = False  # nobody knows where the robot was since the odometry before


class OdometryNoise:
    """Noise of a motion, from its duration or from its size.

    A step of dt seconds adds density^2 dt. A twist covariance C adds C dt max(dt, tau) in a step, because errors of
    velocity last for about tau. With ``odometry.noise: motion`` the variance grows with the angle and the distance of
    each step. A robot at rest adds none.
    """

    def __init__(self, config: OdometryConfig, space: Geometry) -> None:
        self._config, self._space = config, space
        c = config
        self._by_twist = c.noise == "twist"
        self._by_motion = c.noise == "motion" or (self._by_twist and not c.has_densities)
        sigmas = [c.translation_density, c.lateral_density, c.rotation_density]
        if space.dimensions == 3:
            sigmas[2:] = [c.vertical_density, c.tilt_density, c.tilt_density, c.rotation_density]
        self._density = np.diag(np.square(sigmas))
        n = space.dimensions
        # other directions are to the first, and to heading, as the densities are
        self._way = np.diag([(one / c.translation_density) ** 2 for one in sigmas[:n]] + [0.0] * (len(sigmas) - n))
        self._heading = np.diag([0.0] * n + [(one / c.rotation_density) ** 2 for one in sigmas[n:]])
        self._none = np.zeros_like(self._density)
        self._flat: Numbers = ()
        self._square: Array = self._density

    def stands(self, step: Numbers, dt: float) -> bool:
        """Return whether a step of dt seconds is too slow to be a motion."""
        c = self._config
        slow_m, slow_rad = c.still_m_s * dt, c.still_rad_s * dt
        if self._space.dimensions == 2:
            return step[0] * step[0] + step[1] * step[1] < slow_m * slow_m and abs(step[2]) < slow_rad
        turn = 2.0 * (step[3] ** 2 + step[4] ** 2 + step[5] ** 2) ** 0.5  # of a small rotation
        return step[0] ** 2 + step[1] ** 2 + step[2] ** 2 < slow_m**2 and turn < slow_rad

    def is_jitter(self, moved: Numbers) -> bool:
        """Return whether a motion is small enough to be odometry's jitter, whatever its duration."""
        c = self._config
        return self._space.square(moved) < c.still_m**2 and self._space.angle(moved) < c.still_rad

    def of(
        self, step: Numbers, dt: float, twist_covariance: Numbers | None, turn_variance: Numbers | None = None
    ) -> Array:
        """Return the covariance (dof, dof) that a step of dt seconds adds. It is read only: it may be that of others.

        Parameters
        ----------
        turn_variance : of the rotation about each axis, for each second, where it is not that of odometry
        """
        if self._by_twist and twist_covariance is not None:
            out = self._twist(twist_covariance) * (dt * max(dt, self._config.twist_correlation_s))
        else:
            out = self._motion(step, dt) if self._by_motion else self._density * dt
        if turn_variance is None:
            return out
        n, turns = self._space.dimensions, np.zeros_like(out)
        turns[:n, :n] = out[:n, :n]
        turns[n:, n:] = np.diag(turn_variance) * dt
        return turns

    def _motion(self, step: Numbers, dt: float) -> Array:
        if dt == 0.0:
            return self._none
        c = self._config
        way, turned = math.hypot(*step[: self._space.dimensions]), self._space.angle(step)
        heading = c.turn_per_rad * turned + c.turn_per_m * way + c.turn_per_s * dt
        return self._way * (c.way_per_m * way + c.way_per_s * dt) + self._heading * heading

    def _twist(self, flat: Numbers) -> Array:
        if flat is not self._flat:  # drivers repeat the same covariance
            self._flat, self._square = flat, np.array(flat).reshape(self._density.shape)
        return self._square


class StationaryDetector:
    """Detector of a stationary robot: motion that is slow, or that leads nowhere."""

    __slots__ = ("_T_odom_base", "_noise", "_since_ns", "_space", "is_on")

    def __init__(self, noise: OdometryNoise, space: Geometry) -> None:
        self._noise, self._space = noise, space
        self._T_odom_base: Numbers | None = None  # where it has been since, but for jitter
        self._since_ns = 0
        self.is_on = False

    @property
    def state(self) -> list[Any]:
        """Plain values, to ``go_on`` with."""
        return [self._T_odom_base, self._since_ns, self.is_on]

    def go_on(self, state: list[Any]) -> None:
        """Take over what another one knew."""
        there, self._since_ns, self.is_on = state
        self._T_odom_base = there and tuple(there)

    def update(self, step: Step, dt: float) -> bool:
        """Add a step of dt seconds; return whether the robot stands."""
        stands = self._noise.stands(step.T_last_base, dt)
        if self._T_odom_base is None or step.broken or step.slips:
            self._begin(step)
            return stands and not step.broken
        moved = self._space.group.between_one(self._T_odom_base, step.T_odom_base)
        elapsed_ns, is_jitter = step.stamp_ns - self._since_ns, self._noise.is_jitter(moved)
        if self.is_on:
            stands = stands or is_jitter
            if not stands:
                self._begin(step)
        elif elapsed_ns >= _REST_NS:
            self.is_on = self._noise.stands(moved, elapsed_ns * 1e-9)
            if not (self.is_on or is_jitter):  # else it may be either: time will tell
                self._begin(step)
        return stands

    def _begin(self, step: Step) -> None:
        self._T_odom_base, self._since_ns, self.is_on = step.T_odom_base, step.stamp_ns, False


class IntegratedOdometry:
    """The motion since a keyframe, and each odometry message of it.

    Parameters
    ----------
    rest : of the robot, which outlasts keyframes
    """

    __slots__ = ("_moved", "_noise", "_rest", "_space", "keyframe", "moving_ns")

    def __init__(
        self, noise: OdometryNoise, space: Geometry, keyframe: int, start_ns: int, rest: StationaryDetector
    ) -> None:
        self.keyframe = keyframe
        self.moving_ns = 0  # whole numbers: a sum of seconds would round
        self._noise, self._space, self._rest = noise, space, rest
        self._moved = [OdometrySample(start_ns, space.identity, np.zeros((space.dof, space.dof)))]

    @property
    def state(self) -> list[Any]:
        """Plain values, to ``go_on`` with."""
        return [self.moving_ns, [[getattr(one, name) for name in one.__slots__] for one in self._moved]]

    def go_on(self, state: list[Any]) -> None:
        """Take over what another one remembered."""
        self.moving_ns, moved = state
        self._moved = [
            OdometrySample(
                stamp_ns, tuple(T), np.array(covariance), twist and tuple(twist), stands, turn and tuple(turn), gap
            )
            for stamp_ns, T, covariance, twist, stands, turn, gap in moved
        ]

    @property
    def now(self) -> OdometrySample:
        """The motion at the newest odometry."""
        return self._moved[-1]

    @property
    def start_ns(self) -> int:
        """Stamp of the keyframe."""
        return self._moved[0].stamp_ns

    def step(self, step: Step) -> None:
        """Append one step of odometry."""
        self.extend(step, self._rest.update(step, (step.stamp_ns - self._moved[-1].stamp_ns) * 1e-9))

    def extend(self, step: Step, stands: bool) -> None:
        """Append a step in which the robot stood or not, as what ``cut`` left over of the motion before."""
        before = self._moved[-1]
        to = self._space.group.compose_one(before.T_keyframe_base, step.T_last_base)
        moved = self._extended(before, to, step, stands)
        self.moving_ns += (moved.stamp_ns - before.stamp_ns) * (not moved.stands)
        if before.stands and moved.stands:  # of a robot that stands for hours, only the last is remembered
            self._moved[-1] = moved
        else:
            self._moved.append(moved)

    def at(self, stamp_ns: int) -> OdometrySample:
        """Return the motion since the keyframe at a stamp, interpolated between two odometry messages."""
        k = bisect_right(self._moved, stamp_ns, key=_stamp) - 1
        a = self._moved[k]
        if a.stamp_ns == stamp_ns or k + 1 == len(self._moved):
            return a
        b, group = self._moved[k + 1], self._space.group
        fraction = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        step = group.interpolate(self._space.identity, group.between(a.T_keyframe_base, b.T_keyframe_base), fraction)
        rest = Step(stamp_ns, step, step, b.twist_covariance, turn_variance=b.turn_variance)
        return self._extended(a, group.compose(a.T_keyframe_base, step), rest, b.stands)

    def cut(self, stamp_ns: int) -> Step | None:
        """End the motion at a stamp after the last odometry but one; return the step that is left over, if any."""
        last, group = self.now, self._space.group
        if stamp_ns == last.stamp_ns:
            return None
        at = self.at(stamp_ns)
        # the next cut is made of this rest: without a norm of 1 its error would double from cut to cut
        rest = self._space.normalized(group.between(at.T_keyframe_base, last.T_keyframe_base))
        self._moved[-1] = at
        return Step(last.stamp_ns, rest, rest, last.twist_covariance, turn_variance=last.turn_variance)

    def reaches(self, stamp_ns: int) -> bool:
        """Return whether odometry says where the robot was at a stamp: not after its end, nor in a gap."""
        k = bisect_right(self._moved, stamp_ns, key=_stamp)
        if self._moved[k - 1].stamp_ns == stamp_ns:
            return True
        return k < len(self._moved) and not self._moved[k].is_gap

    @property
    def is_long(self) -> bool:
        """Return whether too many messages are remembered, so that a keyframe is needed."""
        return len(self._moved) >= _MOST

    @property
    def before_last_ns(self) -> int:
        """Stamp of the last odometry but one, or of the keyframe."""
        return self._moved[-2].stamp_ns if len(self._moved) > 1 else self.start_ns

    def _extended(self, a: OdometrySample, to: Numbers, step: Step, stands: bool) -> OdometrySample:
        moving_ns = (step.stamp_ns - a.stamp_ns) * (not stands)
        noise = self._noise.of(step.T_last_base, moving_ns * 1e-9, step.twist_covariance, step.turn_variance)
        covariance = self._space.group.propagate_during(a.covariance, step.T_last_base, noise)
        is_gap = step.is_gap and not (stands or self._noise.is_jitter(step.T_last_base))
        return OdometrySample(step.stamp_ns, to, covariance, step.twist_covariance, stands, step.turn_variance, is_gap)


def _stamp(moved: OdometrySample) -> int:
    return moved.stamp_ns
