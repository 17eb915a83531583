"""Odometry since a keyframe: relative motion and its covariance."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.slam.config import OdometryConfig
from graph_slam_ros.slam.odometry_choice import Step
from graph_slam_ros.slam.space import Numbers, Space

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moved:
    """``T_keyframe_base`` at a stamp, and its covariance (dof, dof) in right tangent coordinates."""

    stamp_ns: int
    T_keyframe_base: Numbers
    covariance: Array
    twist_covariance: Numbers | None = None


class OdometryNoise:
    """Noise of a motion from its duration.

    A step of dt seconds adds density^2 dt. From a twist covariance C a step adds C dt max(dt, tau), since errors of
    velocity last for about tau. A robot that stands gathers none.
    """

    __slots__ = ("_config", "_density", "_flat", "_space", "_square")

    def __init__(self, config: OdometryConfig, space: Space) -> None:
        self._config, self._space = config, space
        c = config
        sigmas = [c.translation_density, c.lateral_density, c.rotation_density]
        if space.dimensions == 3:
            sigmas[2:] = [c.vertical_density, c.tilt_density, c.tilt_density, c.rotation_density]
        self._density = np.diag(np.square(sigmas))
        self._flat: Numbers = ()
        self._square: Array = self._density

    def stands(self, step: Numbers, dt: float) -> bool:
        """Whether a step in dt seconds is too slow to be one."""
        c = self._config
        slow_m, slow_rad = c.still_m_s * dt, c.still_rad_s * dt
        if self._space.dimensions == 2:
            return step[0] ** 2 + step[1] ** 2 < slow_m**2 and abs(step[2]) < slow_rad
        turn = 2.0 * (step[3] ** 2 + step[4] ** 2 + step[5] ** 2) ** 0.5  # of a small rotation
        return step[0] ** 2 + step[1] ** 2 + step[2] ** 2 < slow_m**2 and turn < slow_rad

    def of(self, dt: float, twist_covariance: Numbers | None) -> Array:
        """Covariance (dof, dof) of the velocities' integral over dt seconds."""
        if self._config.noise == "twist" and twist_covariance is not None:
            return self._twist(twist_covariance) * (dt * max(dt, self._config.twist_correlation_s))
        return self._density * dt

    def _twist(self, flat: Numbers) -> Array:
        if flat is not self._flat:  # drivers repeat the same covariance
            self._flat, self._square = flat, np.array(flat).reshape(self._density.shape)
        return self._square


class Motion:
    """The motion since a keyframe, remembered odometry by odometry."""

    __slots__ = ("_moved", "_noise", "_space", "_stands", "keyframe", "moving_ns")

    def __init__(self, noise: OdometryNoise, space: Space, keyframe: int, start_ns: int) -> None:
        self.keyframe = keyframe
        self.moving_ns = 0  # whole numbers: a sum of seconds would round
        self._noise, self._space = noise, space
        self._stands = False
        self._moved = [Moved(start_ns, space.identity, np.zeros((space.dof, space.dof)))]

    @property
    def now(self) -> Moved:
        """At the newest odometry."""
        return self._moved[-1]

    @property
    def start_ns(self) -> int:
        """Stamp of the keyframe."""
        return self._moved[0].stamp_ns

    def step(self, step: Step) -> None:
        """Go on by one step of odometry."""
        stands, elapsed_ns, moved = self._after(step)
        self.moving_ns += elapsed_ns * (not stands)
        if self._stands and stands:  # of a robot that stands for hours, only the last is remembered
            self._moved[-1] = moved
        else:
            self._moved.append(moved)
        self._stands = stands

    def after(self, step: Step) -> Moved:
        """Where one more step of odometry would lead; it is not taken."""
        return self._after(step)[2]

    def at(self, stamp_ns: int) -> Moved:
        """At a stamp from the keyframe's to the newest odometry's, between two odometry messages by interpolation."""
        k = bisect_right(self._moved, stamp_ns, key=_stamp) - 1
        a = self._moved[k]
        if a.stamp_ns == stamp_ns or k + 1 == len(self._moved):
            return a
        b, group = self._moved[k + 1], self._space.group
        fraction = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        step = group.interpolate(self._space.identity, group.between(a.T_keyframe_base, b.T_keyframe_base), fraction)
        elapsed_ns = stamp_ns - a.stamp_ns
        moves = not self._noise.stands(step, elapsed_ns * 1e-9)
        return self._extended(a, step, elapsed_ns * moves, Step(stamp_ns, step, b.T_keyframe_base, b.twist_covariance))

    def cut(self, stamp_ns: int) -> Step | None:
        """End the motion at a stamp after the last odometry but one; returns the step that is left over, if any."""
        last, group = self.now, self._space.group
        if stamp_ns == last.stamp_ns:
            return None
        at = self.at(stamp_ns)
        # the next cut is made of this rest: without a norm of 1 its error would double from cut to cut
        rest = self._space.normalized(group.between(at.T_keyframe_base, last.T_keyframe_base))
        self._moved[-1] = at
        self._stands = False
        return Step(last.stamp_ns, rest, rest, last.twist_covariance)

    @property
    def before_last_ns(self) -> int:
        """Stamp of the last odometry but one, or of the keyframe."""
        return self._moved[-2].stamp_ns if len(self._moved) > 1 else self.start_ns

    def _after(self, step: Step) -> tuple[bool, int, Moved]:
        """Whether the robot stands in a step, how long that takes, and where it is then."""
        elapsed_ns = step.stamp_ns - self.now.stamp_ns
        stands = self._noise.stands(step.T_last_base, elapsed_ns * 1e-9)
        return stands, elapsed_ns, self._extended(self.now, step.T_last_base, elapsed_ns * (not stands), step)

    def _extended(self, a: Moved, T_a_b: Numbers, moving_ns: int, step: Step) -> Moved:
        group, noise = self._space.group, self._noise.of(moving_ns * 1e-9, step.twist_covariance)
        covariance = group.propagate_during(a.covariance, T_a_b, noise)
        return Moved(step.stamp_ns, group.compose(a.T_keyframe_base, T_a_b), covariance, step.twist_covariance)


def _stamp(moved: Moved) -> int:
    return moved.stamp_ns
