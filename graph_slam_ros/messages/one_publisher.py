"""Several publishers on one odometry topic: their messages are separated by continuity, and one publisher is used.

rclpy does not name the publisher of a message, and a recording does not store it. The poses of each publisher are
continuous. So every message belongs to the track of poses that it continues best. A message that continues no track is
kept until the track in use goes on or is given up. In the first case it was another publisher's, or an outlier. In the
second case odometry has jumped.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from operator import attrgetter

from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.messages.inputs.stamp_leap import StampLeap
from graph_slam_ros.typing import Numbers

_ROOM_M, _ROOM_RAD = 0.08, 0.08  # between a pose and where its track leads
_ACCELERATION_M_S2, _ACCELERATION_RAD_S2 = 10.0, 20.0  # of robots
_START_M_S, _START_RAD_S = 3.0, 3.0  # speed of a track that has only one pose
_LEAST_S, _MOST_S, _MOST_RATIO = 0.02, 1.0, 10.0  # stamps may crowd together; a track leads no farther than this
_BACK_NS = 200_000_000  # what is older is left to the order of stamps
_GAP_NS, _GAP_PERIODS = 1_000_000_000, 10.0  # what is dated later than after so long a gap waits for the next to agree
_SURE, _PERIODS, _PATIENT_NS = 3, 3.0, 500_000_000  # messages, periods and ns after which a new track is a jump
_NOISY, _NOISIEST = 3.0, 2.5  # of the usual misfit, and at most
_MOST_LABELS = 8
_USUAL_NS = 200_000_000  # period of a track that has only one pose
_REMEMBERED, _FORGOTTEN_NS = 4, 2_000_000_000
_MOST_NEW, _MOST_WAITING, _MOST_SINGLE = 100, 1000, 5


class _Track:
    """A sequence of poses that continue one another.

    Parameters
    ----------
    first : its first message
    label : source under which its messages are used; empty before they are

    Attributes
    ----------
    past : stamp and pose of the last messages, by ascending stamp
    count : messages so far
    waiting : its messages that are neither used nor refused
    is_established : whether it is another publisher's, which goes on beside the one in use
    """

    def __init__(self, first: Odometry, label: str = "") -> None:
        self.label, self.count, self.is_established = label, 0, False
        self.past: deque[tuple[int, Numbers]] = deque(maxlen=_REMEMBERED)
        self.waiting: deque[Odometry] = deque()
        self.add(first)

    def add(self, m: Odometry) -> None:
        """Add a message. One that is not newer does not change the prediction."""
        self.count += 1
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
        self._labels = 1
        self._usual = 0.0  # misfit of the odometry in use

    def accept(self, m: Odometry) -> list[Odometry]:
        """Accept a message. Returns those that may be used now, in order of arrival."""
        if self._goes_on(m):
            return [m]
        newest_ns, room_ns = m.stamp_ns, _GAP_NS
        if self._tracks:
            newest_ns = min(m.stamp_ns, self._tracks[0].newest_ns)
            room_ns = max(_GAP_NS, round(_GAP_PERIODS * self._tracks[0].period_ns))
        return [
            out
            for _, one in self._leap.accept(m.stamp_ns, m, newest_ns, room_ns)
            for out in self._follow_publisher(one)
        ]

    def accept_run(self, run: Sequence[Odometry]) -> int:
        """Accept messages from the first on, as far as each goes on with the only track; return how many."""
        return next((k for k, m in enumerate(run) if not self._goes_on(m)), len(run))

    def finish(self) -> list[Odometry]:
        """No more messages come: odometry has jumped to those that wait."""
        new = [track for track in self._tracks[1:] if not track.is_established]
        out = self._switch_to(max(new, key=attrgetter("newest_ns"))) if new else []
        self.forget_time()
        return out

    def forget_time(self) -> None:
        """Begin anew with the stamps, without tracks."""
        self._leap.forget()
        for track in self._tracks:
            self._drop(track, 0)
        self._tracks.clear()

    def _goes_on(self, m: Odometry) -> bool:
        """Return whether a message, now part of it, goes on with the only track: the quick answer for nearly all."""
        if len(self._tracks) != 1 or self._leap.holds or self._labels > _MOST_LABELS:
            return False
        used = self._tracks[0]
        if used.label != m.source or not -_BACK_NS <= m.stamp_ns - used.newest_ns <= _GAP_NS:
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
        if not self._tracks:
            self._tracks.append(_Track(m, m.source))
            return [m]
        used = self._tracks[0]
        if m.stamp_ns < used.newest_ns - _BACK_NS:  # its place is decided by the order of stamps
            others = (track for track in self._tracks if track.is_established)
            if used.misfit(m) <= 1.0 or all(track.misfit(m) > 1.0 for track in others):
                return [m]
            self._refuse()
            return []
        track = self._continued(m)
        track.waiting.append(m)
        if track is used:
            return self._go_on(m)
        silent_ns = track.newest_ns - track.waiting[0].stamp_ns
        patience_ns = self._timeout_ns if track.is_established else max(_PERIODS * used.period_ns, _PATIENT_NS)
        if track.count >= _SURE and silent_ns >= patience_ns:
            return self._switch_to(track)
        self._drop(track, _MOST_WAITING)
        new = [one for one in self._tracks[1:] if not one.is_established]
        waiting = [m for one in new for m in one.waiting]
        if len(waiting) <= _MOST_NEW:
            return []
        for one in new:  # there are too many to decide: all that waits is used
            one.waiting.clear()
        track.waiting.extend(sorted(waiting, key=attrgetter("stamp_ns")))
        return self._switch_to(track)

    def _continued(self, m: Odometry) -> _Track:
        """The track that a message continues best, now with it; a new one if it continues none."""
        used = self._tracks[0]
        is_lone = len(self._tracks) == 1
        is_due = len(used.past) > 1 and m.stamp_ns - used.newest_ns <= _PERIODS * used.period_ns
        track: _Track | None = used
        if not ((is_lone or is_due) and self._fits(used, m)):
            track = min(self._tracks, key=lambda one: one.misfit(m))
            if track.misfit(m) > 1.0:
                track = self._at_speed(m)
        if track is None:
            track = _Track(m)
            self._tracks.append(track)
        else:
            track.add(m)
        return track

    def _at_speed(self, m: Odometry) -> _Track | None:
        """The track of a message and two tracks of one pose each, for a robot that is fast from the start."""
        single = [track for track in self._tracks if len(track.past) == 1][-_MOST_SINGLE:]
        for a, b in combinations(single, 2):
            alone = a.past.copy()
            a.past.extend(b.past)
            if alone[0][0] < b.newest_ns and a.misfit(m) <= 1.0:
                a.count += b.count
                a.waiting.extend(b.waiting)
                self._tracks.remove(b)
                return a
            a.past = alone
        return None

    def _go_on(self, at: Odometry) -> list[Odometry]:
        """Continue the track in use. Messages since then that do not continue it are not used."""
        used, *others = self._tracks
        for track in others:
            is_same = track.misfit(at) <= 1.0  # it was noise that made it look like another
            is_gone = is_same or at.stamp_ns - track.newest_ns > _FORGOTTEN_NS
            self._drop(track, 0 if is_gone else 1)  # the last may be what links the two
            track.is_established = True
            if is_gone:
                self._tracks.remove(track)
        return _handed_on(used)

    def _switch_to(self, track: _Track) -> list[Odometry]:
        """Use another publisher's track, beside the one that was in use; or a new one, to which that has jumped."""
        used = self._tracks[0]
        self._tracks.remove(track)
        if not track.is_established:
            track.label = used.label
            for one in self._tracks:
                self._drop(one, _MOST_WAITING if one.is_established else 0)
            self._tracks = [one for one in self._tracks if one.is_established]
        elif not track.label:
            self._labels += 1
            track.label = f"{track.waiting[-1].source}#{self._labels}"
        used.is_established, track.is_established = True, False
        self._tracks.insert(0, track)
        return _handed_on(track)

    def _drop(self, track: _Track, kept: int) -> None:
        """Use none of what waits, except perhaps the last few."""
        while len(track.waiting) > kept:
            track.waiting.popleft()
            self._refuse()


def _handed_on(track: _Track) -> list[Odometry]:
    """What has waited, under the label of its track."""
    out = [m if track.label == m.source else replace(m, source=track.label) for m in track.waiting]
    track.waiting.clear()
    return out
