"""Several publishers on one odometry topic: their messages are separated by continuity, and one publisher is used.

rclpy does not name the publisher of a message, and a recording does not store it. The poses of each publisher are
continuous. So every message belongs to the track of poses that it continues best. A message that continues no track is
kept until the track in use goes on or is given up. In the first case it was another publisher's, or an outlier. In the
second case odometry has jumped.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Any

from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.messages.inputs.stamp_leap import StampLeap
from graph_slam_ros.typing import Numbers

_ROOM_M, _ROOM_RAD = 0.08, 0.08  # between a pose and where its track leads
_ACCELERATION_M_S2, _ACCELERATION_RAD_S2 = 10.0, 20.0  # of robots
_START_M_S, _START_RAD_S = 3.0, 3.0  # speed of a track that has only one pose
_LEAST_S, _MOST_S, _MOST_RATIO = 0.02, 1.0, 10.0  # stamps may crowd together; a track leads no farther than this
_BACK_NS = 200_000_000  # what is older is left to the order of stamps
_AHEAD_NS = 60_000_000_000  # where odometry goes on so much later, the tracks begin anew
_GAP_NS, _GAP_PERIODS = 1_000_000_000, 10.0  # what is dated later than after so long a gap waits for the next to agree
_SURE, _PERIODS, _PATIENT_NS = 3, 3.0, 500_000_000  # messages, periods and ns after which a new track is a jump
_NOISY, _NOISIEST = 3.0, 2.5  # of the usual misfit, and at most
_MOST_LABELS = 8
_USUAL_NS = 200_000_000  # period of a track that has only one pose
_REMEMBERED, _FORGOTTEN_NS = 4, 2_000_000_000
_MOST_HELD, _MOST_SINCE, _MOST_SINGLE = 100, 1000, 5


@dataclass(slots=True, eq=False)
class _Track:
    """A sequence of poses that continue one another.

    Attributes
    ----------
    label : source under which its messages are used; empty before they are
    past : stamp and pose of the last messages, by ascending stamp
    count : messages so far
    first_ns : stamp of its first message
    is_established : whether it is another publisher's, which goes on beside the one in use
    since : its messages since the last of the track in use, and one before
    """

    label: str = ""
    past: deque[tuple[int, Numbers]] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    count: int = 0
    first_ns: int = 0
    is_established: bool = False
    since: deque[Odometry] = field(default_factory=deque)

    def add(self, m: Odometry) -> None:
        """Add a message. One that is not newer does not change the prediction."""
        self.count += 1
        self.first_ns = self.first_ns or m.stamp_ns
        if not self.past or m.stamp_ns > self.past[-1][0]:
            self.past.append((m.stamp_ns, m.T_odom_base))

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest message."""
        return self.past[-1][0]

    @property
    def period_ns(self) -> float:
        """The period of its messages."""
        return (self.newest_ns - self.past[0][0]) / (len(self.past) - 1) if len(self.past) > 1 else _USUAL_NS

    def misfit(self, m: Odometry) -> float:
        """Return the distance of a message from the track's prediction; up to 1 it may continue the track."""
        (first_ns, first), (last_ns, last), pose = self.past[0], self.past[-1], m.T_odom_base
        dt = (m.stamp_ns - last_ns) * 1e-9
        span_s, within_s = (last_ns - first_ns) * 1e-9, min(max(abs(dt), _LEAST_S), _MOST_S)
        ratio = dt / span_s if span_s > 0.0 else 0.0
        room = 1.0 + min(abs(ratio), _MOST_RATIO)  # what a pose is off by makes the speed, too, be off
        room_m = room * _ROOM_M + 0.5 * _ACCELERATION_M_S2 * within_s**2
        room_rad = room * _ROOM_RAD + 0.5 * _ACCELERATION_RAD_S2 * within_s**2
        if span_s == 0.0:
            room_m, room_rad = room_m + _START_M_S * within_s, room_rad + _START_RAD_S * within_s
        dx, dy = last[0] - first[0], last[1] - first[1]
        turned = math.remainder(last[2] - first[2], math.tau) if len(pose) == 3 else 0.0
        if len(pose) == 3:  # what turns so fast may turn back
            swept = sum(abs(math.remainder(b[2] - a[2], math.tau)) for (_, a), (_, b) in pairwise(self.past))
            room_rad += 2.0 * swept / max(span_s, _LEAST_S) * within_s
        bend = 0.5 * (1.0 + ratio) * turned  # between the middles of both motions, of a robot that goes on in a bend
        c, s = ratio * math.cos(bend), ratio * math.sin(bend)
        x, y = pose[0] - last[0] - c * dx + s * dy, pose[1] - last[1] - s * dx - c * dy
        if len(pose) == 3:
            off_rad = abs(math.remainder(pose[2] - last[2] - ratio * turned, math.tau))
            return max(math.hypot(x, y) / room_m, off_rad / room_rad)
        z = pose[2] - last[2] - ratio * (last[2] - first[2])
        off_rad = abs(_turn(last, pose) - abs(ratio) * _turn(first, last))
        return max(math.hypot(x, y, z) / room_m, off_rad / room_rad)


def _turn(a: Numbers, b: Numbers) -> float:
    return 2.0 * math.acos(min(1.0, abs(sum(p * q for p, q in zip(a[3:], b[3:], strict=True)))))


class OnePublisher:
    """Selects the messages of one publisher among the odometry messages of an input.

    The first publisher is used. If it falls silent while another goes on, that one takes over as a source of its own
    (``odom#2``). The choice between sources of odometry then links the two.

    Parameters
    ----------
    timeout_s : the publisher in use is silent for longer: another takes over
    refuse : called once for each message of another publisher, when it is certain that it is not used
    refuse_leap : called once for each that is dated ahead of odometry that goes on without it
    """

    def __init__(self, timeout_s: float, refuse: Callable[[], None], refuse_leap: Callable[[], None]) -> None:
        self._timeout_ns, self._refuse = round(timeout_s * 1e9), refuse
        self._leap = StampLeap[Odometry](refuse_leap)
        self._tracks: list[_Track] = []  # the first is in use
        self._held: deque[tuple[_Track, Odometry]] = deque()  # of tracks that are neither in use nor settled
        self._labels = 1
        self._usual = 0.0  # misfit of the odometry in use

    def accept(self, m: Odometry) -> list[Odometry]:
        """Accept a message. Returns those that may be used now, in order of arrival."""
        if self._goes_on(m):
            return [m]
        newest_ns, room_ns = m.stamp_ns, _GAP_NS
        if self._tracks and (used := self._tracks[0]).past:
            newest_ns = min(m.stamp_ns, used.newest_ns)
            room_ns = max(_GAP_NS, round(_GAP_PERIODS * used.period_ns))
        return [
            out
            for _, one in self._leap.accept(m.stamp_ns, m, newest_ns, room_ns)
            for out in self._follow_publisher(one)
        ]

    def accept_run(self, run: Sequence[Odometry]) -> int:
        """Accept messages from the first on, as far as each goes on with the only track; return how many."""
        return next((k for k, m in enumerate(run) if not self._goes_on(m)), len(run))

    def _goes_on(self, m: Odometry) -> bool:
        """Return whether a message, now part of it, goes on with the only track: the quick answer for nearly all."""
        if len(self._tracks) != 1 or self._held or self._leap.holds or self._labels > _MOST_LABELS:
            return False
        used = self._tracks[0]
        if used.label != m.source or not used.past or not -_BACK_NS <= m.stamp_ns - used.newest_ns <= _GAP_NS:
            return False
        if is_next := self._fits(used, m):
            used.add(m)
        return is_next

    def _fits(self, used: _Track, m: Odometry) -> bool:
        """Return whether a message continues the track in use, as noisy as that is."""
        misfit = used.misfit(m)
        if fits := misfit <= min(max(1.0, _NOISY * self._usual), _NOISIEST):
            self._usual += 0.1 * (misfit - self._usual)
        return fits

    def _follow_publisher(self, m: Odometry) -> list[Odometry]:
        if self._labels > _MOST_LABELS:
            return [m]  # these are no publishers: whatever it is, it is used as it comes
        if self._tracks and self._tracks[0].past and m.stamp_ns > self._tracks[0].newest_ns + _AHEAD_NS:
            self._begin_anew()
        if not self._tracks:
            self._tracks.append(_Track(m.source))
        used = self._tracks[0]
        if used.past and m.stamp_ns < used.newest_ns - _BACK_NS:  # its place is decided by the order of stamps
            others = (track for track in self._tracks if track.is_established)
            if used.misfit(m) <= 1.0 or all(track.misfit(m) > 1.0 for track in others):
                return [m]
            self._refuse()
            return []
        track = self._continued(m)
        track.add(m)
        if track is used:
            before = self._go_on(m) if self._held or len(self._tracks) > 1 else []
            return [*before, _labelled(m, track)]
        if track.is_established:
            track.since.append(m)
            return self._switch_to(track)
        self._held.append((track, m))
        return self._jumped() if len(self._held) > _MOST_HELD or _has_jumped(track, used) else []

    def finish(self) -> list[Odometry]:
        """No more messages come: odometry has jumped to those that are kept."""
        out = self._jumped() if self._held else []
        self.forget_time()
        return out

    def forget_time(self) -> None:
        """Begin anew with the stamps, without tracks."""
        self._leap.forget()
        self._begin_anew()

    def _begin_anew(self) -> None:
        for track in self._tracks:
            self._drop(track.since, 0)
        self._drop(self._held, 0)
        self._tracks.clear()

    def _drop(self, some: deque[Any], kept: int) -> None:
        """Use none of these, except perhaps the last few."""
        while len(some) > kept:
            some.popleft()
            self._refuse()

    def _continued(self, m: Odometry) -> _Track:
        """The track that a message continues best; a new one if it continues none."""
        used = self._tracks[0]
        if not used.past:
            return used
        is_lone = len(self._tracks) == 1
        is_due = len(used.past) > 1 and m.stamp_ns - used.newest_ns <= _PERIODS * used.period_ns
        if (is_lone or is_due) and self._fits(used, m):
            return used
        misfit, k = min((track.misfit(m), k) for k, track in enumerate(self._tracks))
        if misfit <= 1.0:
            return self._tracks[k]
        if track := self._at_speed(m):
            return track
        self._tracks.append(_Track())
        return self._tracks[-1]

    def _at_speed(self, m: Odometry) -> _Track | None:
        """The track of a message and two tracks of one pose each, for a robot that is fast from the start."""
        single = [track for track in self._tracks if len(track.past) == 1][-_MOST_SINGLE:]
        for a, b in combinations(single, 2):
            joined = _Track(past=deque([*a.past, *b.past], maxlen=_REMEMBERED))
            if a.newest_ns < b.newest_ns and joined.misfit(m) <= 1.0:
                a.past, a.count = joined.past, a.count + b.count
                self._tracks.remove(b)
                self._held = deque((a if of is b else of, one) for of, one in self._held)
                return a
        return None

    def _go_on(self, at: Odometry) -> list[Odometry]:
        """Continue the track in use. Messages since then that do not continue it are not used."""
        used = self._tracks[0]
        out = [_labelled(m, used) for track, m in self._held if track is used]
        for track, m in self._held:
            if track is not used:
                track.is_established = True
                track.since.append(m)
        self._held.clear()
        for track in self._tracks[1:]:
            self._drop(track.since, 1)  # the last may be what links the two
            is_same = track.misfit(at) <= 1.0  # it was noise that made it look like another
            if is_same or at.stamp_ns - track.newest_ns > _FORGOTTEN_NS:
                self._drop(track.since, 0)
                self._tracks.remove(track)
        return out

    def _jumped(self) -> list[Odometry]:
        """Continue with the newest track; with all that is kept if there are too many tracks to decide."""
        track, used = self._held[-1][0], self._tracks[0]
        out = [m for of, m in self._held if of is track or len(self._held) > _MOST_HELD]
        for _ in range(len(self._held) - len(out)):
            self._refuse()
        self._held.clear()
        track.label = used.label
        self._tracks = [track, *(one for one in self._tracks[1:] if one.is_established)]
        return [_labelled(m, track) for m in out]

    def _switch_to(self, track: _Track) -> list[Odometry]:
        """Use another track once the track in use has been silent for long enough."""
        if track.count < _SURE or track.newest_ns - track.since[0].stamp_ns <= self._timeout_ns:
            self._drop(track.since, _MOST_SINCE)
            return []
        if not track.label:
            self._labels += 1
            track.label = f"{track.since[-1].source}#{self._labels}"
        out = [_labelled(m, track) for m in track.since]
        track.since.clear()
        self._tracks.remove(track)
        self._tracks[0].is_established, track.is_established = True, False
        self._tracks.insert(0, track)
        return out


def _has_jumped(track: _Track, used: _Track) -> bool:
    """Return whether a new track has gone on without the one in use for so long that the latter is given up."""
    return track.count >= _SURE and track.newest_ns - track.first_ns >= max(_PERIODS * used.period_ns, _PATIENT_NS)


def _labelled(m: Odometry, track: _Track) -> Odometry:
    return m if track.label == m.source else replace(m, source=track.label)
