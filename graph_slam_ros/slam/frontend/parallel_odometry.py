"""Motions of other odometries than the one in use, between keyframes.

A keyframe is made by the odometry in use. Each other odometry may be slower, and come later. So its motion between two
keyframes is known once its messages surround both stamps; it is interpolated there.
"""

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.measurements.types import Odometry
from graph_slam_ros.slam.frontend.keyframes import Keyframe, KeyframeList
from graph_slam_ros.slam.frontend.odometry_integration import OdometryNoise
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.typing import Array, Numbers

_MOST = 20_000  # messages of an odometry that are remembered


@dataclass(frozen=True, slots=True)
class ParallelMotion:
    """The motion between two keyframes by another odometry than the one in use.

    Attributes
    ----------
    vertices : of the keyframes
    covariance : (dof, dof) of the motion in its tangent space
    """

    source: str
    vertices: tuple[int, int]
    motion: Numbers
    covariance: Array


@dataclass(slots=True)
class _Track:
    """The messages of an odometry that are still needed, and the keyframe at which its next motion begins."""

    messages: list[Odometry]
    keyframe: int


class ParallelOdometry:
    """Collects the messages of all odometries, and returns the motions that are complete.

    Parameters
    ----------
    noise : of odometry whose messages do not state it
    """

    def __init__(self, config: Config, noise: OdometryNoise) -> None:
        self._space, self._noise, self._max_speed_m_s = config.space, noise, config.odometry.max_speed_m_s
        self._gap_ns = round(config.odometry.timeout_s * 1e9)
        self._late_ns = round(config.ordering.late_s * 1e9)
        self._factors = {one.name: one.sigma_factor for one in config.sources}
        self._tracks: dict[str, _Track] = {}
        self._unlinked: set[int] = set()

    def add(self, m: Odometry, keyframes: StampedPoses[Keyframe]) -> None:
        """Add a message of any odometry, in any order. Its motions begin at the newest keyframe."""
        track = self._tracks.get(m.source)
        if track is None:
            track = self._tracks[m.source] = _Track([], max(0, len(keyframes) - 1))
        at = bisect_left(track.messages, m.stamp_ns, key=_stamp)
        if at == len(track.messages) or track.messages[at].stamp_ns != m.stamp_ns:
            insort(track.messages, m, key=_stamp)
        if len(track.messages) > _MOST:
            del track.messages[: _MOST // 2]

    def disconnect(self, keyframe: int) -> None:
        """Give no motion into a keyframe, because the way there is not known."""
        self._unlinked.add(keyframe)

    def forget(self) -> None:
        """Start over, for stamps of another time."""
        self._tracks.clear()

    def motions(self, path: KeyframeList, used: str) -> Iterator[ParallelMotion]:
        """Yield the complete motions of all odometries except the one in use."""
        newest_ns = path.keyframes[-1].stamp_ns if len(path.keyframes) else 0
        for source, track in self._tracks.items():
            while track.keyframe + 1 < len(path.keyframes):
                a, b = path.keyframes[track.keyframe], path.keyframes[track.keyframe + 1]
                reached = bool(track.messages) and track.messages[-1].stamp_ns >= b.stamp_ns
                if not reached and newest_ns - b.stamp_ns <= self._late_ns:
                    break
                track.keyframe += 1
                if reached and source != used and track.keyframe not in self._unlinked:
                    found = self._motion(track.messages, a.stamp_ns, b.stamp_ns)
                    if found is not None:
                        scale = self._factors.get(source, 1.0) ** 2
                        yield ParallelMotion(source, (a.vertex, b.vertex), found[0], scale * found[1])
                first = bisect_right(track.messages, b.stamp_ns, key=_stamp) - 1
                del track.messages[: max(0, first)]

    def _motion(self, messages: list[Odometry], start_ns: int, end_ns: int) -> tuple[Numbers, Array] | None:
        """Return the motion between two stamps and its covariance; None if messages are missing, or if it jumped."""
        first = bisect_right(messages, start_ns, key=_stamp) - 1
        last = bisect_left(messages, end_ns, key=_stamp)
        if first < 0 or end_ns <= start_ns:
            return None
        some, group = messages[first : last + 1], self._space.group
        poses = [m.T_odom_base for m in some]
        stamps = [m.stamp_ns for m in some]
        if any(b - a > self._gap_ns for a, b in pairwise(stamps)):
            return None
        ends = (self._at(some[0], some[1], start_ns), self._at(some[-2], some[-1], end_ns))
        poses[0], poses[-1], stamps[0], stamps[-1] = *ends, start_ns, end_ns
        motion, covariance = self._space.identity, np.zeros((self._space.dof, self._space.dof))
        for k in range(1, len(poses)):
            step = tuple(map(float, group.between(poses[k - 1], poses[k])))
            dt = (stamps[k] - stamps[k - 1]) * 1e-9
            if sum(x * x for x in step[: self._space.dimensions]) > (self._max_speed_m_s * max(dt, _LEAST_S)) ** 2:
                return None
            noise = self._noise.of(step, dt, some[k].twist_covariance)
            covariance = group.propagate_during(covariance, step, noise)
            motion = tuple(map(float, group.compose(motion, step)))
        return self._space.normalized(motion), covariance

    def _at(self, a: Odometry, b: Odometry, stamp_ns: int) -> Numbers:
        part = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        out: Numbers = self._space.group.interpolate(a.T_odom_base, b.T_odom_base, part)
        return out


_LEAST_S = 0.02  # stamps of some drivers crowd together


def _stamp(m: Odometry) -> int:
    return m.stamp_ns
