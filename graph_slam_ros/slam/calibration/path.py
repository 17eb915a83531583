"""The path of an estimate, at any stamp: what clocks of sensors are compared with."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Index, Mask, Numbers

_AROUND_S = 0.25  # to either side of a stamp: shorter, and a velocity is noise
_REST_S = 3.0  # between two keyframes: longer, and nobody knows when of it the robot moved


@dataclass(frozen=True, slots=True)
class Between:
    """Poses between two keyframes each.

    Attributes
    ----------
    first : (n,) index of the keyframe before; the other is the next
    fraction : (n,) of the motion between them
    poses : (n, size)
    """

    first: Index
    fraction: Array
    poses: Array


class EstimatedPath:
    """Estimated keyframes, with constant velocity between each two.

    Parameters
    ----------
    stamps_ns : (n,) of keyframes
    poses : (n, size)
    segments : keyframes to which odometry does not lead
    """

    def __init__(self, space: Geometry, stamps_ns: Index, poses: Array, segments: Sequence[int]) -> None:
        backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
        self._first = (
            int(backwards[-1]) + 1 if len(backwards) else 0
        )  # stamps began anew: before, none is told by its own
        self._space, self._poses = space, poses[self._first :]
        self._origin_ns = int(stamps_ns[self._first])
        self._own_s = (stamps_ns[self._first :] - self._origin_ns) * 1e-9
        is_open = np.diff(self._own_s) > _REST_S
        is_open[[k - self._first - 1 for k in segments if k > self._first]] = True
        self._gaps = np.flatnonzero(is_open)

    def knows(self, stamps_ns: Index, most_s: float) -> Mask:
        """Return whether (n,) the path is known around each stamp, up to a number of seconds away."""
        since_s, reach = (stamps_ns - self._origin_ns) * 1e-9, most_s + _AROUND_S
        inside = (since_s - reach >= self._own_s[0]) & (since_s + reach <= self._own_s[-1])
        for gap in self._gaps.tolist():
            inside &= (since_s + reach <= self._own_s[gap]) | (since_s - reach >= self._own_s[gap + 1])
        return np.asarray(inside)

    def at(self, stamps_ns: Index, after_s: float) -> Between:
        """The poses at an offset from some stamps."""
        since_s = (stamps_ns - self._origin_ns) * 1e-9 + after_s
        k = np.clip(np.searchsorted(self._own_s, since_s, side="right") - 1, 0, len(self._own_s) - 2)
        fraction = np.clip((since_s - self._own_s[k]) / (self._own_s[k + 1] - self._own_s[k]), 0.0, 1.0)
        a, b, group = tuple(self._poses[k].T), tuple(self._poses[k + 1].T), self._space.group
        step = tuple(fraction * one for one in group.local(b, a))
        return Between(k + self._first, fraction, np.stack(group.compose(a, group.exp(step)), axis=-1))

    def velocity(self, stamps_ns: Index, after_s: float) -> Array:
        """Twist (n, dof) of the base around these times, in its own axes [m/s, rad/s]."""
        before, behind = (self.at(stamps_ns, after_s + side).poses for side in (-_AROUND_S, _AROUND_S))
        tangent = self._space.group.local(tuple(behind.T), tuple(before.T))
        return np.stack(tangent, axis=-1) / (2.0 * _AROUND_S)

    def motion(self, stamps_ns: Index, after_s: float) -> Numbers:
        """The motion from each stamp over a time, as arrays (n,)."""
        a, b = (tuple(self.at(stamps_ns, after).poses.T) for after in (0.0, after_s))
        out: Numbers = self._space.group.between(a, b)
        return out
