"""The path of an estimate, at any stamp: what clocks of sensors are compared with.

Between two keyframes it moves as odometry has it; what the estimate corrects of that is spread evenly over the time. A
robot that stands and goes is nowhere near half-way when half of the time is over.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend.corrections import scaled
from graph_slam_ros.slam.frontend.odometry_track import OdometryTrack
from graph_slam_ros.slam.levels import ROUNDING
from graph_slam_ros.typing import Array, Index, Mask

_AROUND_S = 0.25  # to either side of a stamp: shorter, and a velocity is noise
_REST_S = 3.0  # between two samples of odometry: longer, and nobody knows when of it the robot moved


class EstimatedPath:
    """Keyframes with stamps (n,), of segments between which odometry does not lead, and odometry between two of them.

    Attributes
    ----------
    poses, factors : (n, size) of the keyframes, and odometry's factors of distance and turn; to be set
    """

    def __init__(self, space: Geometry, stamps_ns: Index, segments: Sequence[int], track: OdometryTrack) -> None:
        backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
        # Stamps began anew: before, nothing is known by its own.
        first = self._first = int(backwards[-1]) + 1 if len(backwards) else 0
        self._space, self._track = space, track
        self.poses, self.factors = track.keyframes, (track.distance, track.turn)
        self._origin_ns = int(stamps_ns[first])
        self._own_s = (stamps_ns[first:] - self._origin_ns) * 1e-9
        self._sample_s, self._samples = self._with_samples()
        before, after = tuple(self._samples[:-1].T), tuple(self._samples[1:].T)
        self._steps = np.stack(space.group.local(after, before), axis=-1)  # from each sample to the next
        stands = (np.diff(self._samples, axis=0) == 0.0).all(axis=1)
        is_open = (np.diff(self._sample_s) > _REST_S) & ~stands
        gaps = [(self._sample_s[k], self._sample_s[k + 1]) for k in np.flatnonzero(is_open).tolist()]
        joints = [k - first for k in segments if first < k < len(stamps_ns)]
        self._gaps = [*gaps, *((self._own_s[k - 1], self._own_s[k]) for k in joints)]

    def _with_samples(self) -> tuple[Array, Array]:
        """Seconds and poses of odometry at the keyframes and between them."""
        since_s = (self._track.stamps_ns - self._origin_ns) * 1e-9
        inside = (since_s > self._own_s[0]) & (since_s < self._own_s[-1]) & ~np.isin(since_s, self._own_s)
        seconds = np.concatenate((self._own_s, since_s[inside]))
        order = np.argsort(seconds, kind="stable")
        return seconds[order], np.concatenate((self._track.keyframes[self._first :], self._track.poses[inside]))[order]

    def knows(self, stamps_ns: Index, most_s: float) -> Mask:
        """Return whether (n,) the path is known around each stamp, up to a number of seconds away."""
        since_s, reach = (stamps_ns - self._origin_ns) * 1e-9, most_s + _AROUND_S
        inside = (since_s - reach >= self._own_s[0]) & (since_s + reach <= self._own_s[-1])
        for begin_s, end_s in self._gaps:
            inside &= (since_s + reach <= begin_s) | (since_s - reach >= end_s)
        return np.asarray(inside)

    def at(self, stamps_ns: Index, after_s: float) -> tuple[Index, Array, Array]:
        """The poses (n, size) at an offset from some stamps.

        Before them the index (n,) of the keyframe before, and which part of the time to the next is over.
        """
        since_s, group = (stamps_ns - self._origin_ns) * 1e-9 + after_s, self._space.group
        k, fraction = _interval(self._own_s, since_s)
        s, part = _interval(self._sample_s, since_s)
        step = group.exp(tuple(part * one for one in self._steps[s].T))
        odom, k = group.compose(tuple(self._samples[s].T), step), k + self._first
        start, end = (tuple(self._track.keyframes[at].T) for at in (k, k + 1))
        moved, whole = (scaled(self._space, group.between(start, one), *self.factors) for one in (odom, end))
        a, b = tuple(self.poses[k].T), tuple(self.poses[k + 1].T)
        rest = tuple(fraction * one for one in group.local(b, group.compose(a, whole)))
        return k, fraction, np.stack(group.compose(group.compose(a, moved), group.exp(rest)), axis=-1)

    def velocity(self, stamps_ns: Index, after_s: float) -> Array:
        """Twist (n, dof) of the base around these times, in its own axes [m/s, rad/s]."""
        before, behind = (self.at(stamps_ns, after_s + side)[2] for side in (-_AROUND_S, _AROUND_S))
        tangent = self._space.group.local(tuple(behind.T), tuple(before.T))
        return np.stack(tangent, axis=-1) / (2.0 * _AROUND_S)


def _interval(seconds: Any, at_s: Any) -> tuple[Index, Array]:
    """The interval (n,) that each time is in, and the part of it that is over."""
    k = np.clip(np.searchsorted(seconds, at_s, side="right") - 1, 0, len(seconds) - 2)
    return k, np.clip((at_s - seconds[k]) / np.maximum(seconds[k + 1] - seconds[k], ROUNDING), 0.0, 1.0)
