"""Selects one odometry of several: the first in priority that sends. It returns steps, and marks jumps."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Odometry, from_record, to_record
from graph_slam_ros.slam.levels import ROUNDING
from graph_slam_ros.typing import Numbers

JUMP_SIGMA_M, JUMP_SIGMA_RAD = 10.0, 3.0  # of the motion across a jump: any heading, and anywhere within a hall
_RESET, UNUSUAL = 0.1, 3.0  # m, rad; times the motion before: odometry does not go on from there
_LEAST_S = 0.02  # stamps of some drivers crowd together: a pair of them says nothing of speed
_GAP, _LEAST_GAP_NS = 10.0, 2_000_000_000  # times the usual period, at least; recorded robots pause for 1.4 s
_FASTER, _FROM_REST_M_S = 2.0, 5.0  # times the speed before a gap, or of a car that drove off in it
_REMEMBERED = 1000  # messages of a source that is not in use, to take over from where the one in use fell silent


@dataclass(slots=True)
class Step:
    """The motion since the step before.

    Attributes
    ----------
    T_odom_base : the pose in the frame of the odometry in use
    broken : whether odometry jumped here, so that ``T_last_base`` is no motion of the robot
    is_gap : whether so much time has passed since the step before that nobody knows where the robot was meanwhile
    turn_variance : of the rotation about each axis per second, if a gyro contributed to it [rad^2/s]
    slips : whether a gyro contradicts odometry, so that the robot may turn although odometry stands
    """

    stamp_ns: int
    T_last_base: Numbers
    T_odom_base: Numbers
    twist_covariance: Numbers | None = None
    broken: bool = False
    is_gap: bool = False
    turn_variance: Numbers | None = None
    slips: bool = False


class OdometrySelector:
    """Selects by stamps alone: the selection follows from what was accepted, not from when it arrived.

    Parameters
    ----------
    priority : names of sources, the best first; others follow in the order they come

    Attributes
    ----------
    sources : those that have been used
    used : the last message that was used
    """

    def __init__(self, config: OdometryConfig, priority: Sequence[str], space: Geometry, counters: Counters) -> None:
        self._config, self._space, self._counters = config, space, counters
        self._silent_ns = round(config.timeout_s * 1e9)
        self.sources: set[str] = set()
        self._order = list(priority)
        self._past: dict[str, deque[Odometry]] = {}
        self.used: Odometry | None = None
        self._last_step = space.identity
        self._usual_ns, self._longest_ns = 0.0, math.inf  # between two messages; more is a gap

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the last odometry message that was used."""
        return None if self.used is None else self.used.stamp_ns

    def forget(self) -> None:
        """Start over, for stamps of another time."""
        self._past.clear()
        self.used = None
        self._last_step = self._space.identity

    @property
    def state(self) -> list[Any]:
        """Plain values, to ``go_on`` with."""
        return [self.used and to_record(self.used), list(self._order), self._last_step, self._usual_ns]

    def go_on(self, state: list[Any]) -> Odometry:
        """Continue after the odometry message that another one had used last, and return that."""
        used, order, last_step, usual_ns = state
        message = from_record(used)
        assert isinstance(message, Odometry)
        self.used, self._order, self._last_step = message, list(order), tuple(last_step)
        self._past[message.source] = deque([message], maxlen=_REMEMBERED)
        self._set_usual(usual_ns)
        return message

    def steps(self, m: Odometry) -> list[Step]:
        """Return the steps that a message completes: none if its odometry is not in use."""
        if m.source not in self._order:
            self._order.append(m.source)
        if m.source not in self._past:
            self._past[m.source] = deque(maxlen=_REMEMBERED)
        past, used = self._past[m.source], self.used
        if past and past[-1].stamp_ns == m.stamp_ns:
            self._counters.count(m.source, "duplicate" if past[-1] == m else "duplicate_stamp")
            return []
        past.append(m)
        if used is None:
            return [self._use(m, self._space.identity, broken="")]
        if m.source == used.source:
            return [self._follow(used, m)]
        if self._has_failed_over(m, used):
            return self._switched(past, used)
        self._counters.count(m.source, "not_in_use")
        return []

    def _has_failed_over(self, m: Odometry, used: Odometry) -> bool:
        if self._order.index(m.source) < self._order.index(used.source):
            return m.stamp_ns >= used.stamp_ns
        return m.stamp_ns - used.stamp_ns > self._silent_ns

    def _switched(self, past: "deque[Odometry]", used: Odometry) -> list[Step]:
        """Return the interpolated steps since the other odometry was last used; none until this one reaches so far."""
        group = self._space.group
        newer = [m for m in past if m.stamp_ns > used.stamp_ns]
        older = [m for m in past if m.stamp_ns <= used.stamp_ns]
        source = past[-1].source
        if not older:
            if newer[-1].stamp_ns - used.stamp_ns <= self._silent_ns:
                self._counters.count(source, "not_in_use")
                return []
            self._counters.count(source, "switched_to_unlinked")
            return [self._use(newer[-1], self._space.identity, broken="jump")]
        self._counters.count(source, "switched_to")
        if not newer:  # of the very stamp that was used last
            self.used = older[-1]
            return []
        a, b = older[-1], newer[0]
        fraction = (used.stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        at = Odometry(used.stamp_ns, group.interpolate(a.T_odom_base, b.T_odom_base, fraction), None, b.source)
        out = []
        for m in newer:
            out.append(self._follow(at, m))
            at = m
        return out

    def _follow(self, a: Odometry, b: Odometry) -> Step:
        step = self._space.group.between_one(a.T_odom_base, b.T_odom_base)
        dt_ns = b.stamp_ns - a.stamp_ns
        usual_s = self._usual_ns * 1e-9 if dt_ns > self._longest_ns else 0.0
        how = self._jump(step, b.T_odom_base, dt_ns * 1e-9, usual_s)
        return self._use(b, step, broken=how)

    def _use(self, m: Odometry, step: Numbers, *, broken: str) -> Step:
        if broken:
            self._counters.count(m.source, broken)
        self._counters.used[m.source] += 1
        self.sources.add(m.source)
        dt_ns = m.stamp_ns - self.used.stamp_ns if self.used else 0
        is_gap = dt_ns > self._longest_ns and not broken
        usual_ns = self._usual_ns or dt_ns
        self._set_usual(usual_ns + 0.1 * (min(dt_ns, 2.0 * usual_ns) - usual_ns))
        self.used, self._last_step = m, self._space.identity if broken else step
        return Step(m.stamp_ns, step, m.T_odom_base, m.twist_covariance, bool(broken), is_gap)

    def _set_usual(self, usual_ns: float) -> None:
        self._usual_ns = usual_ns
        self._longest_ns = max(_LEAST_GAP_NS, _GAP * usual_ns) if usual_ns else math.inf

    def _jump(self, motion: Numbers, T_odom_base: Numbers, dt: float, usual_s: float) -> str:
        """Return ``reset_to_zero`` or ``jump``; empty if a robot can move like this.

        ``usual_s`` is the usual period where odometry was silent for so long that its driver may have restarted, and
        driven on; else 0.
        """
        if self._is_reset(motion, T_odom_base, is_gap=usual_s > 0.0):
            return "reset_to_zero"
        most_m_s = self._config.max_speed_m_s
        if usual_s:
            most_m_s = min(most_m_s, max(_FROM_REST_M_S, _FASTER * self._size(self._last_step)[0] / usual_s))
        is_jump = self._space.square(motion) > (most_m_s * max(dt, _LEAST_S)) ** 2
        return "jump" if is_jump else ""

    def _is_reset(self, motion: Numbers, T_odom_base: Numbers, *, is_gap: bool) -> bool:
        """Return whether the driver restarted: odometry is at the origin, farther away than robots move in a step."""
        if abs(T_odom_base[0]) > ROUNDING and not is_gap:
            return False
        (far_m, far_rad), (at_m, at_rad), (usual_m, usual_rad) = map(self._size, (motion, T_odom_base, self._last_step))
        most_m, most_rad = max(_RESET, UNUSUAL * usual_m), max(_RESET, UNUSUAL * usual_rad)
        is_at_zero = at_m <= most_m and at_rad <= most_rad if is_gap else max(at_m, at_rad) <= ROUNDING
        is_far = far_m > most_m  # a heading may be that of a compass, which goes on
        return (is_at_zero and (is_far or far_rad > most_rad)) or (at_m <= ROUNDING and is_far)

    def _size(self, pose: Numbers) -> tuple[float, float]:
        return math.hypot(*pose[: self._space.dimensions]), self._space.angle(pose)
