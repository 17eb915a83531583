"""The gate in front of the pipeline: it decides after a jump of time, a pause, a stop, or with a full queue.

The node and a replay use the same gate, so that both make the same run of the same messages.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Control, Measured, Odometry, Sightings
from graph_slam_ros.slam.frontend.odometry_selector import UNUSUAL

_SURE_NS, _SURE = 1_000_000_000, 3  # of stamps, and messages: a burst that was held up is shorter
_AGAIN_NS = 10_000_000_000  # of stamps: an older stamp that came within this time is a repetition, and no jump
_GOES_ON, _APART_M = 0.5, 0.05  # of the way to where odometry was at that stamp; less is no motion to tell by
Jump: TypeAlias = Literal["time_jump", "clock_step"]


@dataclass(slots=True)
class Passage:
    """The gate's decision on one message.

    Attributes
    ----------
    jump : the value of ``time.on_jump`` (segment, reset or stop) if time jumped back with this message, else empty
    events : what the pipeline processes before the measurements
    measured : the measurements that pass to the pipeline; empty if they were refused
    """

    jump: str = ""
    events: tuple[Control, ...] = ()
    measured: Sequence[Measured] = ()


JUMP_BACK_S = 0.2  # the clock jumped back; what is older by less is out of order


class IngestGate:
    """Decides which measurements pass to the pipeline, and counts the others.

    Parameters
    ----------
    counters : where each refused measurement counts, by its input and the reason
    now_ns : the clock, for what was on its way when the clock jumped back; 0 where there is none

    Attributes
    ----------
    is_paused : whether everything is refused for now
    is_stopped : whether everything is refused until another run begins: time jumped, and ``time.on_jump`` is stop
    """

    def __init__(self, counters: Counters, now_ns: Callable[[], int] = lambda: 0) -> None:
        self._detector = TimeJumpDetector(JUMP_BACK_S)
        self._counters, self._now_ns = counters, now_ns
        self._jumped_ns = 0  # halfway between the clock before its jump and after; 0: it did not jump lately
        self.is_paused = self.is_stopped = False

    def admit(self, measured: Sequence[Measured], on_jump: str, *, has_room: bool = True) -> Passage:
        """Decide on the measurements of one message.

        Parameters
        ----------
        on_jump : ``time.on_jump``, as it is now
        has_room : whether the queue of the pipeline takes another message
        """
        kind = self._detector.jump(measured)
        jump = self.begin_anew(on_jump, kind) if kind else Passage()
        reason = "stopped" if self.is_stopped else "paused" if self.is_paused else "" if has_room else "overflow"
        if reason:
            self.refuse(reason, measured)
            return jump
        return Passage(jump.jump, jump.events, measured)

    def newest_ns(self, source: str) -> int:
        """Return the newest stamp of an odometry; what is later is no jump back. 0 before the first."""
        return self._detector.newest_ns(source)

    def begin_anew(self, on_jump: str, kind: Jump = "time_jump") -> Passage:
        """Decide on a jump of time: the stamps that follow belong to another time."""
        self._detector.forget()
        self.is_stopped = on_jump == "stop" or (self.is_stopped and on_jump != "reset")
        return Passage(on_jump, (Control(kind),) if on_jump == "segment" else ())

    def begin_run(self) -> None:
        """Start a run. It accepts measurements even if the run before was stopped."""
        self.is_stopped = False

    def clock_jumped(self, by_ns: int) -> None:
        """Start to refuse messages that were sent before the clock jumped (``is_from_before``)."""
        self._jumped_ns = self._now_ns() - by_ns // 2

    def is_from_before(self, measured: Sequence[Measured]) -> bool:
        """Return whether measurements were sent before the clock jumped back: their stamps are nearer to that time."""
        if self._jumped_ns and self._now_ns() >= self._jumped_ns:
            self._jumped_ns = 0
        return 0 < self._jumped_ns < max((m.stamp_ns for m in measured), default=0)

    def refuse(self, reason: str, measured: Sequence[Measured]) -> None:
        """Count refused measurements, each sighting as one."""
        for m in measured:
            self._counters.count(input_of(m), reason, size_of(m))


class TimeJumpDetector:
    """Detects stamps that jump back although no clock does: a time server, or a recording played again without /clock.

    Odometry then continues from an earlier stamp, and no odometry continues from the last one. Where its poses go on
    from the last one, and are not those that it had at these stamps, the clock was set back, and the drive goes on.

    Parameters
    ----------
    back_s : a smaller step back is a message out of order
    """

    def __init__(self, back_s: float) -> None:
        self._back_ns = round(back_s * 1e9)
        self._newest_ns: dict[str, int] = {}
        self._recent: dict[str, deque[Odometry]] = {}
        self._last: dict[str, tuple[Odometry, float]] = {}  # that arrived, and how far it was from the one before
        self._stepped = Counter[str]()  # messages in a row whose stamps went back and whose poses went on
        self._anew: dict[str, list[int]] = {}  # ascending stamps from which it may go on: the first, the last, how many

    def jump(self, measured: Iterable[Measured]) -> Jump | None:
        """Return how stamps jumped back with one of these measurements, in their order of arrival, if they did."""
        kinds = [self._kind(m) for m in measured if isinstance(m, Odometry)]  # all of them, whatever the first tells
        return next((kind for kind in kinds if kind), None)

    def newest_ns(self, source: str) -> int:
        """Return the newest stamp of an odometry; 0 before the first."""
        return self._newest_ns.get(source, 0)

    def forget(self) -> None:
        """Forget all stamps, because the next belong to another time."""
        self._newest_ns.clear()
        self._recent.clear()
        self._last.clear()
        self._stepped.clear()
        self._anew.clear()

    def _kind(self, m: Odometry) -> Jump | None:
        last, usual_m = self._last.get(m.source, (m, 0.0))
        moved_m = math.dist(m.T_odom_base[:2], last.T_odom_base[:2])
        self._last[m.source] = m, moved_m
        newest_ns = self._newest_ns.get(m.source, 0)
        if m.stamp_ns >= newest_ns - self._back_ns:
            self._newest_ns[m.source] = max(newest_ns, m.stamp_ns)
            self._remember(m)
            self._anew.clear()
            self._stepped.clear()
            return None
        then = min(self._recent[m.source], key=lambda one: abs(one.stamp_ns - m.stamp_ns))
        if then.stamp_ns == m.stamp_ns and then.T_odom_base == m.T_odom_base:
            return None
        apart_m = math.dist(m.T_odom_base[:2], then.T_odom_base[:2])
        goes_on = moved_m < min(UNUSUAL * usual_m, _GOES_ON * apart_m) and apart_m > _APART_M
        self._stepped[m.source] = (self._stepped[m.source] + 1) * goes_on
        if self._stepped[m.source] >= _SURE:
            return "clock_step"
        first_ns, last_ns, count = self._anew.get(m.source, (0, 0, 0))
        if count == 0 or m.stamp_ns <= last_ns:
            first_ns, count = m.stamp_ns, 0
        self._anew[m.source] = [first_ns, m.stamp_ns, count + 1]
        return "time_jump" if count + 1 >= _SURE and m.stamp_ns - first_ns >= _SURE_NS else None

    def _remember(self, m: Odometry) -> None:
        recent = self._recent.setdefault(m.source, deque())
        recent.append(m)
        while recent and recent[0].stamp_ns < self._newest_ns[m.source] - _AGAIN_NS:
            recent.popleft()


def input_of(m: Measured) -> str:
    """Return the input or topic of a measurement."""
    return m.source.partition("#")[0] if isinstance(m, Odometry) else m.topic


def size_of(m: Measured) -> int:
    """Return how many a measurement counts as: its number of sightings, or one."""
    return len(m.sightings) if isinstance(m, Sightings) else 1
