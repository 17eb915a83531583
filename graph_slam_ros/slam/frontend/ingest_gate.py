"""The gate in front of the pipeline: it decides after a jump of time, a pause, a stop, or with a full queue.

The node and a replay use the same gate, so that both make the same run of the same messages.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import Control, Measured, Odometry, Sightings

_SURE_NS, _SURE = 1_000_000_000, 3  # of stamps, and messages: a burst that was held up is shorter
_AGAIN_NS = 10_000_000_000  # of stamps: an older stamp that came within this time is a repetition, and no jump


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
        jump = self.begin_anew(on_jump) if self._detector.is_jump(measured) else Passage()
        reason = "stopped" if self.is_stopped else "paused" if self.is_paused else "" if has_room else "overflow"
        if reason:
            self.refuse(reason, measured)
            return jump
        return Passage(jump.jump, jump.events, measured)

    def newest_ns(self, source: str) -> int:
        """Return the newest stamp of an odometry; what is later is no jump back. 0 before the first."""
        return self._detector.newest_ns(source)

    def begin_anew(self, on_jump: str) -> Passage:
        """Decide on a jump of time: the stamps that follow belong to another time."""
        self._detector.forget()
        self.is_stopped = on_jump == "stop" or (self.is_stopped and on_jump != "reset")
        return Passage(on_jump, (Control("time_jump"),) if on_jump == "segment" else ())

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

    Odometry then continues from an earlier stamp, and no odometry continues from the last one.

    Parameters
    ----------
    back_s : a smaller step back is a message out of order
    """

    def __init__(self, back_s: float) -> None:
        self._back_ns = round(back_s * 1e9)
        self._newest_ns: dict[str, int] = {}
        self._recent_ns: dict[str, deque[int]] = {}
        self._anew: dict[str, list[int]] = {}  # ascending stamps from which it may go on: the first, the last, how many

    def is_jump(self, measured: Iterable[Measured]) -> bool:
        """Return whether stamps jumped back with one of these measurements, in their order of arrival."""
        jumped = False
        for m in measured:  # all of them, whatever the first tells
            if isinstance(m, Odometry) and self._has_jumped(m):
                jumped = True
        return jumped

    def newest_ns(self, source: str) -> int:
        """Return the newest stamp of an odometry; 0 before the first."""
        return self._newest_ns.get(source, 0)

    def forget(self) -> None:
        """Forget all stamps, because the next belong to another time."""
        self._newest_ns.clear()
        self._recent_ns.clear()
        self._anew.clear()

    def _has_jumped(self, m: Odometry) -> bool:
        newest_ns = self._newest_ns.get(m.source, 0)
        if m.stamp_ns >= newest_ns - self._back_ns:
            self._newest_ns[m.source] = max(newest_ns, m.stamp_ns)
            self._remember(m)
            self._anew.clear()
            return False
        if m.stamp_ns in self._recent_ns[m.source]:
            return False
        first_ns, last_ns, count = self._anew.get(m.source, (0, 0, 0))
        if count == 0 or m.stamp_ns <= last_ns:
            first_ns, count = m.stamp_ns, 0
        self._anew[m.source] = [first_ns, m.stamp_ns, count + 1]
        return count + 1 >= _SURE and m.stamp_ns - first_ns >= _SURE_NS

    def _remember(self, m: Odometry) -> None:
        recent = self._recent_ns.setdefault(m.source, deque())
        recent.append(m.stamp_ns)
        while recent and recent[0] < self._newest_ns[m.source] - _AGAIN_NS:
            recent.popleft()


def input_of(m: Measured) -> str:
    """Return the input or topic of a measurement."""
    return m.source.partition("#")[0] if isinstance(m, Odometry) else m.topic


def size_of(m: Measured) -> int:
    """Return how many a measurement counts as: its number of sightings, or one."""
    return len(m.sightings) if isinstance(m, Sightings) else 1
