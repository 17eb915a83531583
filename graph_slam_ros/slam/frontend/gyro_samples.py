"""The messages of a gyro, and the turn that they measured between two stamps."""

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass
from itertools import pairwise

from graph_slam_ros.config.gyro import GyroConfig
from graph_slam_ros.lie import so3
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import AngularVelocity
from graph_slam_ros.typing import Numbers

_MOST = 20_000  # messages that odometry has not reached


@dataclass(frozen=True, slots=True)
class Turn:
    """A turn by a gyro, its bias included.

    Attributes
    ----------
    angle : about z in the plane, a rotation vector in space [rad]
    variance : of white noise, about each axis [rad^2]
    spread : by which rates differ, on the axis where they do most [rad/s]
    """

    angle: Numbers
    variance: Numbers
    spread: float


class GyroSamples:
    """Turn rates in order of stamp, integrated by the trapezoidal rule.

    A stamp after the newest message has that one's rate. What the next message shows to be different is made up for in
    the next turn.
    """

    def __init__(self, config: GyroConfig, axes: int, counters: Counters) -> None:
        self._config, self._counters, self._axes = config, counters, axes
        self._gap_ns = round(config.timeout_s * 1e9)
        self._samples: list[AngularVelocity] = []
        self._until_ns = 0  # turns up to here were given out
        self._held: tuple[int, Numbers] | None = None  # since when a rate was held, and the turn by it

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
        self._until_ns, self._held = 0, None

    def begin(self, stamp_ns: int) -> None:
        """Drop the messages before a stamp, except the newest of them."""
        first = max(0, bisect_right(self._samples, stamp_ns, key=_stamp) - 1)
        for m in self._samples[:first]:
            self._counters.count(m.topic, "before_odometry")
        del self._samples[:first]
        self._until_ns, self._held = stamp_ns, None

    def turn(self, start_ns: int, end_ns: int) -> Turn | None:
        """Return the turn between two stamps; None if messages are missing. Stamps increase from call to call."""
        held, self._held = self._held, None
        since_ns = held[0] if held else start_ns
        found = self._integrated(since_ns, end_ns)
        if held and found is not None:
            found = Turn(self._less(held[1], found.angle), found.variance, found.spread)
        newest = bisect_right(self._samples, end_ns, key=_stamp) - 1
        if found is not None and not self._is_followed(newest):
            last_ns = max(self._samples[newest].stamp_ns, since_ns)
            rate, seconds = self._samples[newest].rate, (end_ns - last_ns) * 1e-9
            self._held = (last_ns, tuple(seconds * w for w in rate)) if seconds else None
        self._drop(newest)
        self._until_ns = end_ns
        return found

    def _drop(self, newest: int) -> None:
        """Drop the messages before the newest used one; the next turn begins with that one."""
        for m in self._samples[: max(0, newest)]:
            self._counters.used[m.topic] += 1
        del self._samples[: max(0, newest)]

    def _is_followed(self, k: int) -> bool:
        """Return whether the next message is near enough to interpolate."""
        return k + 1 < len(self._samples) and self._are_near(k)

    def _are_near(self, k: int) -> bool:
        return self._samples[k + 1].stamp_ns - self._samples[k].stamp_ns <= self._gap_ns

    def _integrated(self, start_ns: int, end_ns: int) -> Turn | None:
        first = bisect_right(self._samples, start_ns, key=_stamp) - 1
        last = bisect_right(self._samples, end_ns, key=_stamp) - 1
        if first < 0 or not all(self._are_near(k) for k in range(first, last)):
            return None
        if end_ns - self._samples[last].stamp_ns > self._gap_ns:
            return None
        stamps = [start_ns, *(m.stamp_ns for m in self._samples[first + 1 : last + 1])]
        if stamps[-1] < end_ns:
            stamps.append(end_ns)
        angle, variance = so3.exp((0.0, 0.0, 0.0)), [0.0] * self._axes
        rates = [self._rate(first + k, stamp_ns) for k, stamp_ns in enumerate(stamps[:-1])]
        rates.append(self._rate(last, end_ns))
        total = [0.0] * self._axes
        for k, (a_ns, b_ns) in enumerate(pairwise(stamps)):
            seconds = (b_ns - a_ns) * 1e-9
            step = tuple(0.5 * seconds * (a + b) for a, b in zip(rates[k], rates[k + 1], strict=True))
            if self._axes == 3:
                angle = so3.compose(angle, so3.exp(step))
            total = [t + s for t, s in zip(total, step, strict=True)]
            density = self._density(first + k)
            variance = [v + d * seconds for v, d in zip(variance, density, strict=True)]
        spread = max(max(of_axis) - min(of_axis) for of_axis in zip(*rates, strict=True))
        whole = tuple(map(float, so3.log(angle))) if self._axes == 3 else tuple(total)
        return Turn(whole, tuple(variance), spread)

    def _rate(self, k: int, stamp_ns: int) -> Numbers:
        """Return the rate at a stamp, interpolated from message ``k`` on."""
        a = self._samples[k]
        if a.stamp_ns >= stamp_ns or not self._is_followed(k):
            return a.rate
        b = self._samples[k + 1]
        part = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        return tuple(x + part * (y - x) for x, y in zip(a.rate, b.rate, strict=True))

    def _density(self, k: int) -> Numbers:
        """The variance of the turn from a message on, about each axis for each second [rad^2/s]."""
        m = self._samples[k]
        if m.covariance is None:
            return (self._config.density**2,) * self._axes
        if self._is_followed(k):
            period_ns = self._samples[k + 1].stamp_ns - m.stamp_ns
        else:
            period_ns = self._gap_ns if k == 0 else min(self._gap_ns, m.stamp_ns - self._samples[k - 1].stamp_ns)
        return tuple(m.covariance[axis * (self._axes + 1)] * period_ns * 1e-9 for axis in range(self._axes))

    def _less(self, before: Numbers, whole: Numbers) -> Numbers:
        """Return the part of a turn that was not returned before."""
        if self._axes == 1:
            return (whole[0] - before[0],)
        rest = so3.log(so3.compose(so3.inverse(so3.exp(before)), so3.exp(whole)))
        return tuple(map(float, rest))


def _stamp(m: AngularVelocity) -> int:
    return m.stamp_ns
