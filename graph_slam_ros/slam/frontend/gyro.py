"""Fusion of a gyro with odometry: the two rotations of each step are averaged by their variances.

The bias of the gyro is estimated while the robot stands, and from odometry's rotation while it drives nearly straight.
The error of the bias is common to all steps, so it counts as if it lasted ``gyro.bias_correlation_s``.

Over each second the rotations of odometry and gyro must agree. If they do not, the wheels slip, and the gyro is used
alone. A gyro that disagrees most of the time is itself wrong: in other units, or with another mount.
"""

import math
from collections import deque
from dataclasses import dataclass, replace

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import AngularVelocity
from graph_slam_ros.slam.frontend.gyro_samples import GyroSamples, Turn
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise, StationaryDetector
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.typing import Numbers

_WINDOW_S = 1.0
_STRAIGHT_RAD_S = 0.1  # above, errors of odometry's turn factor would pass for a bias
_QUIET, _QUIET_RAD_S = 10.0, 0.02  # times its noise, and rate, by which a gyro at rest may vary
_DOUBTED_AFTER_S, _MEMORY_S = 10.0, 60.0
_DOUBTED, _TRUSTED = 0.5, 0.25  # part of the time in motion in which they disagree


@dataclass(frozen=True, slots=True)
class GyroState:
    """The present estimate of a gyro.

    Attributes
    ----------
    name : of the input
    bias, sigma : about each axis [rad/s]
    state : ``used``; ``silent``: no message for longer than ``gyro.timeout_s``; ``doubted``: it disagrees with odometry
        most of the time; ``waiting``: no odometry yet. Only while it is ``used`` it has a part in odometry
    """

    name: str
    bias: Numbers
    sigma: Numbers
    state: str

    @property
    def fault(self) -> str:
        """The reason why the gyro is not used; empty if it is."""
        if self.state == "silent":
            return f"{self.name}: the gyro is silent; the rotation is that of odometry alone (gyro.timeout_s)"
        if self.state == "doubted":
            return (
                f"{self.name}: gyro and odometry contradict each other most of the time; the gyro is not used. It "
                f"must be in rad/s, counter-clockwise positive. Check its frame, TF or {self.name}.mount, "
                f"odometry.turn_factor"
            )
        return ""

    def __str__(self) -> str:
        """The state and the bias, for a person."""
        bias = ", ".join(f"{b:.5f} +- {s:.5f}" for b, s in zip(self.bias, self.sigma, strict=True))
        return f"{self.state}; bias {bias} rad/s"


@dataclass(frozen=True, slots=True)
class SavedBias:
    """The bias of a gyro as a map keeps it.

    Attributes
    ----------
    name : of the input
    bias : about each axis [rad/s]
    variance : of it [rad^2/s^2]
    stamp_ns : of the newest odometry by then
    """

    name: str
    bias: Numbers
    variance: Numbers
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class _Step:
    """One step of a window: seconds, the gyro's turn less odometry's, and the variance of that."""

    seconds: float
    difference: Numbers
    variance: Numbers


class GyroFusion:
    """Fuses the steps of odometry with a gyro.

    Parameters
    ----------
    noise : of odometry
    """

    def __init__(self, config: Config, noise: OdometryNoise, counters: Counters) -> None:
        self._config, self._space, self._noise, self._counters = config.gyro, config.space, noise, counters
        self._still_rad = config.odometry.still_rad
        self.name = config.gyro_input
        self._axes = self._space.dof - self._space.dimensions
        self._samples = GyroSamples(config.gyro, self._axes, counters)
        self._rest = StationaryDetector(noise, self._space)
        self._bias = [0.0] * self._axes
        self._bias_variance = [self._config.bias_sigma**2] * self._axes
        self._window: deque[_Step] = deque()
        self._limit = quantile(self._config.gate, self._axes)
        self._seen_s = self._disagrees = 0.0
        self._is_doubted = False
        self._state = "waiting"
        self._newest_ns: int | None = None  # of the last step
        self._is_restored = False  # from a map, before the first step

    @property
    def state(self) -> GyroState:
        """The present estimate of it."""
        return GyroState(self.name, tuple(self._bias), tuple(map(math.sqrt, self._bias_variance)), self._state)

    @property
    def saved(self) -> SavedBias | None:
        """The bias for a map; None before the first step of odometry."""
        if self._newest_ns is None:
            return None
        return SavedBias(self.name, tuple(self._bias), tuple(self._bias_variance), self._newest_ns)

    def restore(self, saved: SavedBias) -> None:
        """Go on with the bias of a map, if it is that of this gyro. It walks until the next odometry."""
        if saved.name == self.name and len(saved.bias) == self._axes:
            self._bias, self._bias_variance = list(saved.bias), list(saved.variance)
            self._newest_ns = saved.stamp_ns
            self._is_restored = True

    def add(self, m: AngularVelocity) -> None:
        """Add a message of the gyro, in any order."""
        self._samples.add(m)

    def drop(self) -> None:
        """Drop the pending messages, because no odometry will come for them."""
        self._samples.forget()

    def forget(self) -> None:
        """Begin anew with the stamps. The bias may be another by then."""
        self.drop()
        self._window.clear()
        self._rest = StationaryDetector(self._noise, self._space)
        self._bias_variance = [self._config.bias_sigma**2] * self._axes
        self._is_restored = False

    def fuse(self, step: Step, seconds: float, source: str) -> Step:
        """Return a step of odometry, its rotation fused with that of the gyro.

        Parameters
        ----------
        seconds : since the step before
        source : the odometry, for what is counted
        """
        if self._is_restored:
            self._age_restored(step.stamp_ns)
        elif seconds > 0.0 and not step.broken:
            self._bias_variance = [v + self._config.bias_walk**2 * seconds for v in self._bias_variance]
        self._newest_ns = step.stamp_ns
        if seconds <= 0.0 or step.broken:
            self._rest.update(step, max(seconds, 0.0))
            self._samples.begin(step.stamp_ns)
            self._window.clear()
            return step
        stood = self._rest.update(step, seconds)
        turn = self._samples.turn(step.stamp_ns - round(seconds * 1e9), step.stamp_ns)
        if turn is None:
            self._counters.count(self.name, "gyro_silent")
            self._state = "silent"
            self._window.clear()
            return step
        return self._fused(step, seconds, turn, stood, source)

    def _age_restored(self, stamp_ns: int) -> None:
        """Let the bias of a map walk until now. It is not known less than that of a gyro that was never used."""
        gone_s = (stamp_ns - (self._newest_ns or 0)) * 1e-9
        walked = self._config.bias_walk**2 * gone_s if gone_s >= 0.0 else math.inf  # of another clock
        most = self._config.bias_sigma**2
        self._bias_variance = [min(v + walked, max(v, most)) for v in self._bias_variance]
        self._is_restored = False

    def _fused(self, step: Step, seconds: float, turn: Turn, stood: bool, source: str) -> Step:
        n, group = self._space.dimensions, self._space.group
        tangent = tuple(map(float, group.log(step.T_last_base)))
        odometry = (0.0,) * self._axes if stood else tangent[n:]
        noise = self._noise.of(step.T_last_base, 0.0 if stood else seconds, step.twist_covariance)
        of_odometry = tuple(map(float, noise.diagonal()[n:]))
        own = tuple(v + self._config.turn_per_rad * abs(a) for v, a in zip(turn.variance, turn.angle, strict=True))
        measured = tuple(a - b * seconds for a, b in zip(turn.angle, self._bias, strict=True))
        difference = tuple(self._wrapped(a - b) for a, b in zip(measured, odometry, strict=True))
        white = tuple(a + b for a, b in zip(of_odometry, own, strict=True))
        slips = self._contradicts(_Step(seconds, difference, white), stood)
        self._judge(seconds, slips, is_moving=slips or not stood)
        if self._is_doubted:
            self._counters.count(self.name, "gyro_doubted")
            self._state = "doubted"
            return step
        self._state = "used"
        persisting = [v * self._config.bias_correlation_s * seconds for v in self._bias_variance]
        if not slips and self._shows_bias(turn, seconds, odometry, stood):
            self._learn(difference, white, seconds)
        if stood and not slips:
            return step
        variance = [a + b for a, b in zip(own, persisting, strict=True)]
        weight = [1.0 if slips else o / (o + g) for o, g in zip(of_odometry, variance, strict=True)]
        if slips:
            self._counters.count(source, "turn_slips")
        fused = tuple(o + w * d for o, w, d in zip(odometry, weight, difference, strict=True))
        motion = tuple(map(float, group.exp((*tangent[:n], *fused))))
        density = tuple(w * v / seconds for w, v in zip(weight, variance, strict=True))
        return replace(step, T_last_base=motion, turn_variance=density, slips=slips)

    def _wrapped(self, angle: float) -> float:
        return math.remainder(angle, 2.0 * math.pi) if self._axes == 1 else angle

    def _contradicts(self, step: _Step, stood: bool) -> bool:
        """Return whether the turns of the last second differ by more than their errors."""
        window = self._window
        window.append(step)
        while len(window) > 1 and sum(one.seconds for one in window) - window[0].seconds >= _WINDOW_S:
            window.popleft()
        seconds = sum(one.seconds for one in window)
        statistic = 0.0
        for axis in range(self._axes):
            apart = sum(one.difference[axis] for one in window)
            variance = sum(one.variance[axis] for one in window) + self._bias_variance[axis] * seconds**2
            variance += self._still_rad**2 * stood
            statistic += apart**2 / variance
        return statistic > self._limit

    def _judge(self, seconds: float, slips: bool, *, is_moving: bool) -> None:
        """Update how often they disagree. Wheels slip now and then, but a wrong gyro always disagrees."""
        if not is_moving:
            return
        self._seen_s = min(self._seen_s + seconds, _MEMORY_S)
        self._disagrees += (slips - self._disagrees) * min(1.0, seconds / self._seen_s)
        if self._seen_s >= _DOUBTED_AFTER_S:
            self._is_doubted = self._disagrees > (_TRUSTED if self._is_doubted else _DOUBTED)

    def _shows_bias(self, turn: Turn, seconds: float, odometry: Numbers, stood: bool) -> bool:
        """Return whether the difference to odometry is the bias, and not a turn of one of them."""
        if not stood:
            return math.hypot(*odometry) < _STRAIGHT_RAD_S * seconds
        return turn.spread < max(_QUIET_RAD_S, _QUIET * math.sqrt(max(turn.variance)) / seconds)

    def _learn(self, difference: Numbers, variance: Numbers, seconds: float) -> None:
        """One step of a Kalman filter of the bias, an axis at a time."""
        for axis, apart in enumerate(difference):
            before = self._bias_variance[axis]
            gain = before * seconds / (before * seconds**2 + variance[axis])
            self._bias[axis] += gain * apart
            self._bias_variance[axis] = (1.0 - gain * seconds) * before
