"""Fusion of a gyro with odometry: the two rotations of each step are averaged by their variances.

The bias of the gyro is estimated while the robot stands, and from odometry's rotation while it drives nearly straight.
The error of the bias is common to all steps, so it counts as if it lasted ``gyro.bias_correlation_s``.

Over each second the rotations of odometry and gyro must agree. If they do not, the wheels slip, and the gyro is used
alone. A gyro that disagrees most of the time in motion, or grossly in most of the turns, is itself wrong: in other
units, or with another mount.
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
_DOUBTED, _TRUSTED = 0.5, 0.25  # part of the time in motion, or of that in turns, in which they disagree
_TURNING_RAD_S = 0.1  # a second with a faster turn is one in which both must turn
_GROSS = 0.6  # of the larger of both turns: a difference that wheels do not make. A slip by a factor of 2 is 0.5
_TURNED_S, _EXPLAINED = 5.0, 3.0  # in turns, and chi2 per axis of their difference, above which a gyro may be doubted


@dataclass(frozen=True, slots=True)
class GyroState:
    """The present estimate of a gyro.

    Attributes
    ----------
    name : of the input
    bias, sigma : about each axis [rad/s]
    state : ``used``; ``silent``: no message for longer than ``gyro.timeout_s``; ``doubted``: it disagrees with odometry
        most of the time; ``waiting``: no odometry yet. Only while it is ``used`` it has a part in odometry
    ratio : of its turn to that of odometry, over the turns of late; None before there are any
    """

    name: str
    bias: Numbers
    sigma: Numbers
    state: str
    ratio: float | None = None

    @property
    def fault(self) -> str:
        """The reason why the gyro is not used; empty if it is."""
        if self.state == "silent":
            return f"{self.name}: the gyro is silent; the rotation is that of odometry alone (gyro.timeout_s)"
        if self.state == "doubted":
            turns = "" if self.ratio is None else f", it turns {self.ratio:.3g} times as much as odometry"
            return (
                f"{self.name}: gyro and odometry contradict each other{turns}; the gyro is not used. "
                f"{_cause(self.ratio, self.name)}"
            )
        return ""

    def __str__(self) -> str:
        """The state and the bias, for a person."""
        bias = ", ".join(f"{b:.5f} +- {s:.5f}" for b, s in zip(self.bias, self.sigma, strict=True))
        return f"{self.state}; bias {bias} rad/s"


def _cause(ratio: float | None, name: str) -> str:
    """The likely cause of a ratio of turns, and what mends it."""
    mount = f"its TF, or {name}.mount where there is none"
    if ratio is not None and abs(ratio) > 1.0 / _GROSS:
        return "It must be in rad/s: are these degrees? Correct its driver"
    if ratio is not None and -1.0 / _GROSS < ratio < -_GROSS:
        return f"It must be counter-clockwise positive. Correct {mount}: roll pi turns it over"
    if ratio is not None and abs(ratio) < 1.0 - _GROSS:
        return f"Its axis is not that of the robot, or its driver sends zeros. Correct {mount}"
    return f"It must be in rad/s, counter-clockwise positive. Check {mount}, and odometry.turn_factor"


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
    """One step of a window: seconds, odometry's turn, the gyro's less that, and the variance of the difference."""

    seconds: float
    odometry: Numbers
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
        self._seen_s = self._disagrees = self._turning_s = self._grossly = 0.0
        self._statistic = self._turn_chi2 = 0.0  # of this window, and the mean of those in turns
        self._products = [0.0, 0.0]  # of odometry's turn with the gyro's and with itself, over turns of late
        self._is_doubted = False
        self._state = "waiting"
        self._newest_ns: int | None = None  # of the last step
        self._is_restored = False  # from a map, before the first step

    @property
    def state(self) -> GyroState:
        """The present estimate of it."""
        both, square = self._products
        sigma = tuple(map(math.sqrt, self._bias_variance))
        return GyroState(self.name, tuple(self._bias), sigma, self._state, both / square if square else None)

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
        slips = self._contradicts(_Step(seconds, odometry, difference, white), stood)
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
        self._statistic = statistic
        return statistic > self._limit

    def _judge(self, seconds: float, slips: bool, *, is_moving: bool) -> None:
        """Update how often they disagree. Wheels slip now and then, but a wrong gyro always disagrees."""
        if not is_moving:
            return
        self._seen_s = min(self._seen_s + seconds, _MEMORY_S)
        self._disagrees += (slips - self._disagrees) * min(1.0, seconds / self._seen_s)
        self._judge_turn(seconds)
        most = _TRUSTED if self._is_doubted else _DOUBTED
        in_motion = self._seen_s >= _DOUBTED_AFTER_S and self._disagrees > most
        in_turns = self._turning_s >= _TURNED_S and self._turn_chi2 > _EXPLAINED * self._axes and self._grossly > most
        self._is_doubted = in_motion or in_turns

    def _judge_turn(self, seconds: float) -> None:
        """Update in how much of the turns the difference is larger than wheels make it. Straight on nothing shows."""
        over_s = sum(one.seconds for one in self._window)
        o, d = (
            tuple(map(sum, zip(*turns, strict=True)))
            for turns in ([one.odometry for one in self._window], [one.difference for one in self._window])
        )
        g = tuple(a + b for a, b in zip(o, d, strict=True))
        largest = max(math.hypot(*o), math.hypot(*g))
        if largest < _TURNING_RAD_S * over_s:
            return
        self._turning_s = min(self._turning_s + seconds, _MEMORY_S)
        part = min(1.0, seconds / self._turning_s)
        self._grossly += ((math.hypot(*d) > _GROSS * largest) - self._grossly) * part
        self._turn_chi2 += (self._statistic - self._turn_chi2) * part
        for k, one in enumerate((g, o)):
            self._products[k] += (sum(a * b for a, b in zip(o, one, strict=True)) - self._products[k]) * part

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
