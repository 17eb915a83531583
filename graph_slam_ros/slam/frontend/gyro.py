"""A gyro beside odometry: between keyframes its turn replaces that of odometry.

Its bias is found while the robot stands. Until then odometry turns alone. The error of the bias is common to all steps,
so it counts as if it lasted 10 s.

A gyro that differs from odometry grossly in most of the turns is wrong: in other units, or with another mount. It is
not used then.
"""

import math
from bisect import bisect_left, bisect_right, insort
from collections import deque
from dataclasses import dataclass, replace

from graph_slam_ros.chi_square import quantile
from graph_slam_ros.config.config import Config
from graph_slam_ros.config.pipeline import GyroConfig
from graph_slam_ros.lie import so3
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import AngularVelocity
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise, StationaryDetector
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.levels import GATE
from graph_slam_ros.typing import Numbers

_MOST = 20_000  # messages that odometry has not reached
_WINDOW_S = 1.0
_BIAS_WALK = 1e-4  # rad/s/sqrt(s): of a MEMS gyro after its warm-up
_BIAS_CORRELATION_S = 10.0  # for which an error of the bias counts as one
_MEMORY_S = 60.0
_DOUBTED = 0.5  # part of the time in turns in which they differ grossly; half of it, and it is trusted again
_TURNING_RAD_S = 0.1  # a second with a faster turn is one in which both must turn
_GROSS = 0.6  # of the larger of both turns: a difference that wheels do not make. A slip by a factor of 2 is 0.5
_TURNED_S, _EXPLAINED = 5.0, 3.0  # in turns, and chi2 per axis of their difference, above which a gyro may be doubted


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn by a gyro, its bias included.

    Attributes
    ----------
    angle : about z in the plane, a rotation vector in space [rad]
    variance : of white noise, about each axis [rad^2]
    """

    angle: Numbers
    variance: Numbers


class GyroSamples:
    """Turn rates in order of stamp, integrated by the trapezoidal rule.

    A stamp after the newest message has that one's rate. What the next message shows to be different is made up for in
    the next turn.
    """

    def __init__(self, config: GyroConfig, axes: int, counters: Counters) -> None:
        self._config, self._counters, self._axes = config, counters, axes
        self._gap_ns = round(config.timeout_s * 1e9)
        self._samples: list[AngularVelocity] = []  # from the newest that was used on
        self._until_ns = 0  # turns up to here were given out
        self._given: so3.Quaternion | None = None  # the rotation up to there, since the first message

    def add(self, m: AngularVelocity) -> None:
        """Add a message. A message from before the last used stamp is counted and not used."""
        at = bisect_left(self._samples, m.stamp_ns, key=_stamp)
        if at < len(self._samples) and self._samples[at].stamp_ns == m.stamp_ns:
            self._counters.count(m.topic, "duplicate" if self._samples[at] == m else "duplicate_stamp")
        elif m.stamp_ns <= self._until_ns and at < len(self._samples):
            self._counters.count(m.topic, "late")
        elif len(self._samples) >= _MOST:
            self._counters.count(m.topic, "overflow")
        else:
            insort(self._samples, m, key=_stamp)

    def forget(self) -> None:
        """Start over, for stamps of another time. Messages that odometry has not reached are counted as unused."""
        for m in self._samples[bisect_right(self._samples, self._until_ns, key=_stamp) :]:
            self._counters.count(m.topic, "after_odometry")
        self._samples.clear()
        self._until_ns, self._given = 0, None

    def begin(self, stamp_ns: int) -> None:
        """Drop the messages before a stamp, except the newest of them."""
        first = max(0, bisect_right(self._samples, stamp_ns, key=_stamp) - 1)
        for m in self._samples[:first]:
            self._counters.count(m.topic, "before_odometry")
        del self._samples[:first]
        self._until_ns, self._given = stamp_ns, None

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """Return the turn between two stamps; None if messages are missing. Stamps increase from call to call."""
        newest = bisect_right(self._samples, end_ns, key=_stamp) - 1
        found, given = None, None
        if self._reach(start_ns, end_ns, newest):
            before, now = self._given or self._rotation(start_ns), self._rotation(end_ns)
            angle = so3.log(so3.compose(so3.inverse(before), now))
            variance = tuple(d * (end_ns - start_ns) * 1e-9 for d in self._density(newest))
            found = Turn(tuple(map(float, angle[-self._axes :])), variance)
            given = so3.compose(so3.inverse(self._rotation(self._samples[newest].stamp_ns)), now)
        for m in self._samples[: max(0, newest)]:
            self._counters.used[m.topic] += 1
        del self._samples[: max(0, newest)]
        self._until_ns, self._given = end_ns, given
        return found

    def _reach(self, start_ns: int, end_ns: int, newest: int) -> bool:
        """Return whether messages reach from one stamp to another without a gap."""
        if newest < 0 or self._samples[0].stamp_ns > start_ns:
            return False
        return end_ns - self._samples[newest].stamp_ns <= self._gap_ns and all(map(self._is_followed, range(newest)))

    def _is_followed(self, k: int) -> bool:
        """Return whether the next message is near enough to interpolate."""
        s = self._samples
        return k + 1 < len(s) and s[k + 1].stamp_ns - s[k].stamp_ns <= self._gap_ns

    def _rotation(self, stamp_ns: int) -> so3.Quaternion:
        """Return the rotation from the first message to a stamp."""
        out: so3.Quaternion = so3.IDENTITY
        for k, m in enumerate(self._samples):
            if m.stamp_ns >= stamp_ns:
                break
            until_ns, rate = stamp_ns, m.rate
            if self._is_followed(k):
                b = self._samples[k + 1]
                until_ns = min(stamp_ns, b.stamp_ns)
                half = 0.5 * (until_ns - m.stamp_ns) / (b.stamp_ns - m.stamp_ns)
                rate = tuple(x + half * (y - x) for x, y in zip(m.rate, b.rate, strict=True))
            seconds = (until_ns - m.stamp_ns) * 1e-9
            out = so3.compose(out, so3.exp((*(0.0,) * (3 - self._axes), *(seconds * w for w in rate))))
            if until_ns == stamp_ns:
                break
        return out

    def _density(self, k: int) -> Numbers:
        """The variance of the turn by a message, about each axis for each second [rad^2/s]."""
        m = self._samples[k]
        if m.covariance is None:
            return (self._config.density**2,) * self._axes
        if self._is_followed(k):
            period_ns = self._samples[k + 1].stamp_ns - m.stamp_ns
        else:
            period_ns = self._gap_ns if k == 0 else min(self._gap_ns, m.stamp_ns - self._samples[k - 1].stamp_ns)
        return tuple(m.covariance[axis * (self._axes + 1)] * period_ns * 1e-9 for axis in range(self._axes))


def _stamp(m: AngularVelocity) -> int:
    return m.stamp_ns


@dataclass(frozen=True, slots=True)
class GyroState:
    """The present estimate of a gyro.

    Attributes
    ----------
    name : of the input
    bias, sigma : about each axis [rad/s]
    state : ``used``; ``waiting``: for the robot to stand, so that the bias is known; ``silent``: no message for longer
        than ``gyro.timeout_s``; ``doubted``: it differs from odometry in most turns. Only while it is ``used`` it turns
    ratio : of its turn to that of odometry, over the turns of late; None before there are any
    """

    name: str
    bias: Numbers
    sigma: Numbers
    state: str
    ratio: float | None = None

    @property
    def fault(self) -> str:
        """The reason why the gyro is doubted, and what mends it; empty if it is not."""
        if self.state != "doubted":
            return ""
        turns = "" if self.ratio is None else f", it turns {self.ratio:.3g} times as much as odometry"
        contradict = f"{self.name}: gyro and odometry contradict each other{turns}; the gyro is not used."
        return f"{contradict} {_cause(self.ratio, self.name)}"

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
        return f"Its axis is not that of the robot, or its driver sends zeros. Correct {mount} (graph_slam check BAG)"
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
    """Gives the steps of odometry the turn of a gyro.

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
        self._limit = quantile(GATE, self._axes)  # of a turn over a second that the gyro measures while wheels stand
        self._turning_s = self._grossly = self._turn_chi2 = 0.0  # over turns of late: their time, and two means
        self._products = [0.0, 0.0]  # of odometry's turn with the gyro's and with itself, over turns of late
        self._is_doubted = False
        self._state = "waiting"
        self._newest_ns: int | None = None  # of the last step

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
        self._newest_ns = None

    def fuse(self, step: Step, seconds: float) -> Step:
        """Return a step of odometry with the turn of the gyro, if that is known.

        Parameters
        ----------
        seconds : since the step before
        """
        self._age(step.stamp_ns)
        stands = self._rest.update(step, max(seconds, 0.0))
        if seconds <= 0.0 or step.broken:
            self._samples.begin(step.stamp_ns)
            self._window.clear()
            return step
        turn = self._samples.turn(step.stamp_ns - round(seconds * 1e9), step.stamp_ns)
        if turn is not None:
            return self._turned(step, seconds, turn, stands)
        self._window.clear()
        self._state = "silent"
        self._counters.count(self.name, "gyro_silent")
        return step

    def _age(self, stamp_ns: int) -> None:
        """Let the bias walk until now. It is never known less than that of a gyro that was not used yet."""
        gone_s = (stamp_ns - (stamp_ns if self._newest_ns is None else self._newest_ns)) * 1e-9
        walked = _BIAS_WALK**2 * gone_s if gone_s >= 0.0 else math.inf  # of another clock
        self._bias_variance = [min(v + walked, self._config.bias_sigma**2) for v in self._bias_variance]
        self._newest_ns = stamp_ns

    def _turned(self, step: Step, seconds: float, turn: Turn, stands: bool) -> Step:
        n, group = self._space.dimensions, self._space.group
        tangent = tuple(map(float, group.log(step.T_last_base)))
        odometry = (0.0,) * self._axes if stands else tangent[n:]
        noise = self._noise.of(step.T_last_base, 0.0 if stands else seconds, step.twist_covariance)
        own = [v + self._config.turn_per_rad * abs(a) for v, a in zip(turn.variance, turn.angle, strict=True)]
        measured = tuple(a - b * seconds for a, b in zip(turn.angle, self._bias, strict=True))
        apart = tuple(self._wrapped(a - b) for a, b in zip(measured, odometry, strict=True))
        white = tuple(float(a) + b for a, b in zip(noise.diagonal()[n:], own, strict=True))
        chi2 = self._chi2(_Step(seconds, odometry, apart, white), stands)
        by_hand = stands and chi2 > self._limit
        if by_hand or not stands:
            self._judge(seconds, chi2)
        if self._is_doubted:
            self._state = "doubted"
            self._counters.count(self.name, "gyro_doubted")
            return step
        if stands and not by_hand:
            self._learn(apart, white, seconds)
        if max(self._bias_variance) >= self._config.bias_sigma**2 > 0.0:
            self._state = "waiting"
            self._counters.count(self.name, "gyro_waiting")
            return step
        self._state = "used"
        if stands and not by_hand:
            return step
        motion = tuple(map(float, group.exp((*tangent[:n], *measured))))
        density = tuple(v / seconds + b * _BIAS_CORRELATION_S for v, b in zip(own, self._bias_variance, strict=True))
        return replace(step, T_last_base=motion, turn_variance=density, slips=by_hand)

    def _wrapped(self, angle: float) -> float:
        return math.remainder(angle, 2.0 * math.pi) if self._axes == 1 else angle

    def _chi2(self, step: _Step, stands: bool) -> float:
        """Return the chi2 of the difference of both turns over the last second."""
        window = self._window
        window.append(step)
        while len(window) > 1 and sum(one.seconds for one in window) - window[0].seconds >= _WINDOW_S:
            window.popleft()
        seconds = sum(one.seconds for one in window)
        chi2 = 0.0
        for axis in range(self._axes):
            apart = sum(one.difference[axis] for one in window)
            variance = sum(one.variance[axis] for one in window) + self._bias_variance[axis] * seconds**2
            chi2 += apart**2 / (variance + self._still_rad**2 * stands)
        return chi2

    def _judge(self, seconds: float, chi2: float) -> None:
        """Update in how much of the turns the difference is larger than wheels make it. Straight on nothing shows."""
        over_s = sum(one.seconds for one in self._window)
        o = tuple(map(sum, zip(*(one.odometry for one in self._window), strict=True)))
        d = tuple(map(sum, zip(*(one.difference for one in self._window), strict=True)))
        g = tuple(a + b for a, b in zip(o, d, strict=True))
        largest = max(math.hypot(*o), math.hypot(*g))
        if largest < _TURNING_RAD_S * over_s:
            return
        self._turning_s = min(self._turning_s + seconds, _MEMORY_S)
        part = min(1.0, seconds / self._turning_s)
        self._grossly += ((math.hypot(*d) > _GROSS * largest) - self._grossly) * part
        self._turn_chi2 += (chi2 - self._turn_chi2) * part
        for k, one in enumerate((g, o)):
            self._products[k] += (sum(a * b for a, b in zip(o, one, strict=True)) - self._products[k]) * part
        most = 0.5 * _DOUBTED if self._is_doubted else _DOUBTED
        is_unexplained = self._turning_s >= _TURNED_S and self._turn_chi2 > _EXPLAINED * self._axes
        self._is_doubted = is_unexplained and self._grossly > most

    def _learn(self, difference: Numbers, variance: Numbers, seconds: float) -> None:
        """One step of a Kalman filter of the bias at rest, an axis at a time."""
        for axis, apart in enumerate(difference):
            before = self._bias_variance[axis]
            gain = before * seconds / (before * seconds**2 + variance[axis])
            self._bias[axis] += gain * apart
            self._bias_variance[axis] = (1.0 - gain * seconds) * before
