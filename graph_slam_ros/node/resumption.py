"""Checks by odometry whether an interrupted drive goes on after a restart."""

import math
from itertools import pairwise

from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.typing import Numbers

_LONGEST_NS = 60_000_000_000  # without odometry: after more, the robot may have been carried
_SPEED_OF = 20  # keyframes before the end, which say how fast the robot was
_LEAST, _MOST = 0.3, 1.2  # times the way at that speed: so far it has driven since
_NEAR = 0.1  # m and rad: an odometry that begins anew so close to where it was does no harm


class Resumption:
    """Compares the odometry before a restart with the first after it.

    Parameters
    ----------
    slam : the pipeline in the map of the run that was cut off, before the first odometry
    used_ns, source : stamp and input of the last odometry before; None and empty where there was none
    """

    def __init__(self, slam: GraphSlam, used_ns: int | None, source: str) -> None:
        self._first = len(slam.keyframes)  # of the new drive
        self._used_ns, self._source = used_ns, source
        self._goes_on: bool | None = None

    def goes_on(self, slam: GraphSlam) -> bool:
        """Return whether the odometry of the new drive continues the one before it, and has not jumped since."""
        if len(slam.keyframes) <= self._first or slam.segments[-1] != self._first:
            return False
        if self._goes_on is None:
            self._goes_on = self._is_continuous(slam)
        return self._goes_on

    def _is_continuous(self, slam: GraphSlam) -> bool:
        last, first = slam.keyframes[self._first - 1], slam.keyframes[self._first]
        if self._used_ns is None or _name(slam.odometry_source) != _name(self._source):
            return False
        if not 0 < first.stamp_ns - self._used_ns <= _LONGEST_NS:
            return False
        moved = slam.space.group.between(last.T_odom_base, first.T_odom_base)
        far_m = math.hypot(*moved[: slam.space.dimensions])
        most_m = slam.config.odometry.max_speed_m_s * (first.stamp_ns - last.stamp_ns) * 1e-9
        if far_m > most_m:
            return False
        return self._is_as_fast(slam, far_m, first.T_odom_base) or not _begins_anew(slam, moved, first.T_odom_base)

    def _is_as_fast(self, slam: GraphSlam, far_m: float, T_odom_base: Numbers) -> bool:
        """Return whether the way since then fits the speed before, and odometry is not at its origin."""
        several = [slam.keyframes[k] for k in range(max(self._first - _SPEED_OF, 0), self._first)]
        seconds = (several[-1].stamp_ns - several[0].stamp_ns) * 1e-9
        n, since_s = slam.space.dimensions, (slam.keyframes[self._first].stamp_ns - several[-1].stamp_ns) * 1e-9
        way_m = sum(math.dist(a.T_odom_base[:n], b.T_odom_base[:n]) for a, b in pairwise(several))
        usual_m = way_m / seconds * since_s if seconds > 0.0 else 0.0
        return _LEAST * usual_m <= far_m <= _MOST * usual_m and _size(slam, T_odom_base) > _NEAR


def _begins_anew(slam: GraphSlam, moved: Numbers, T_odom_base: Numbers) -> bool:
    """Return whether odometry is nearer to its origin than to its last pose. A metre counts as much as a radian."""
    far, from_begin = (_size(slam, pose) for pose in (moved, T_odom_base))
    return far > _NEAR and from_begin < far


def _size(slam: GraphSlam, pose: Numbers) -> float:
    return math.hypot(*pose[: slam.space.dimensions]) + slam.space.angle(pose)


def _name(source: str) -> str:
    """The name of the input. Its publishers are numbered anew after a restart."""
    return source.partition("#")[0]
