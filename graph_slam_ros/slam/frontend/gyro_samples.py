"""The messages of a gyro, and the turn that they measured between two stamps."""

from bisect import bisect_left, bisect_right, insort
from dataclasses import dataclass

from graph_slam_ros.config.pipeline import GyroConfig
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
