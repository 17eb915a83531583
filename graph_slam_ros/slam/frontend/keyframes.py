"""The path: its keyframes, and the odometry between them as far back as late measurements may reach."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.frontend.odometry_integration import IntegratedOdometry, OdometryNoise, StationaryDetector
from graph_slam_ros.slam.frontend.odometry_selector import Step
from graph_slam_ros.slam.frontend.odometry_track import OdometrySamples
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.typing import Numbers


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A selected instant: its vertex, its stamp, and its pose by odometry. The solver owns the estimate."""

    vertex: int
    stamp_ns: int
    T_odom_base: Numbers


@dataclass(frozen=True, slots=True)
class SightingPose:
    """The pose of an observation: the index of a keyframe, and the motion since."""

    keyframe: int
    stamp_ns: int
    T_keyframe_base: Numbers


class KeyframeList:
    """Keyframes in order of time, and the motion since each of the last ones.

    Attributes
    ----------
    segments : the keyframes at which odometry began or began again
    drives : the first keyframe of each drive; there is more than one after a map was loaded
    samples : odometry between the keyframes
    """

    def __init__(self, noise: OdometryNoise, space: Geometry) -> None:
        self.keyframes = StampedPoses(Keyframe, space.pose.size)
        self.segments: list[int] = []
        self.drives: list[int] = []
        self._is_new_drive = True
        self._noise, self._space = noise, space
        self._motions: deque[IntegratedOdometry] = deque()
        self._rest = StationaryDetector(noise, space)
        self._epoch = 0  # the first keyframe since stamps began anew
        self.samples = OdometrySamples(space)

    @property
    def motion(self) -> IntegratedOdometry | None:
        """The motion since the newest keyframe; None after stamps have jumped back."""
        return self._motions[-1] if self._motions else None

    @property
    def rests(self) -> bool:
        """Return whether the robot has stood for a second or more."""
        return self._rest.is_on

    @property
    def oldest_ns(self) -> int:
        """Stamp of the first keyframe since stamps last jumped back."""
        return int(self.keyframes.stamps_ns[max(self._epoch - self.keyframes.first, 0)])

    @property
    def remembered_ns(self) -> int:
        """The stamp from which on each odometry message is remembered."""
        return self._motions[0].start_ns

    @property
    def remembered_from(self) -> int:
        """The number of the keyframe from which on each odometry message is remembered."""
        return self._motions[0].keyframe if self._motions else len(self.keyframes)

    def append(self, vertex: int, step: Step, late_s: float) -> None:
        """Add a keyframe at odometry's pose; forget motions that ended more than ``late_s`` ago."""
        if self._is_new_drive:
            self.drives.append(len(self.keyframes))
            self._is_new_drive = False
        self.keyframes.append(vertex, step.stamp_ns, step.T_odom_base)
        keyframe = len(self.keyframes) - 1
        self._motions.append(IntegratedOdometry(self._noise, self._space, keyframe, step.stamp_ns, self._rest))
        oldest_ns = step.stamp_ns - round(late_s * 1e9)
        while len(self._motions) > 2 and self._motions[1].start_ns <= oldest_ns:
            self._motions.popleft()

    def restore(self, keyframes: StampedPoses[Keyframe], segments: Sequence[int], drives: Sequence[int]) -> None:
        """Continue after these keyframes. The motion from the last of them to the present is unknown."""
        self.keyframes = keyframes
        self.segments += segments
        self.drives += drives
        self.forget_time()

    @property
    def state(self) -> list[Any]:
        """Plain values, to ``go_on`` with: what odometry knows since the keyframes that it remembers."""
        return [self._epoch, self._rest.state, [[one.keyframe, one.state] for one in self._motions]]

    def go_on(self, state: list[Any]) -> None:
        """Continue the drive after ``restore``."""
        self._epoch, rest, motions = state
        self._is_new_drive = False
        self._rest.go_on(rest)
        for keyframe, moved in motions:
            self._motions.append(IntegratedOdometry(self._noise, self._space, keyframe, 0, self._rest))
            self._motions[-1].go_on(moved)

    def forget_before(self, first: int) -> None:
        """Forget the keyframes before a number."""
        self.keyframes = self.keyframes.since(first)
        self.samples.forget_before(int(self.keyframes.stamps_ns[0]))

    def forget_time(self) -> None:
        """Start over with the stamps: they cannot be compared with those before."""
        self._motions.clear()
        self.samples.forget()
        self._rest = StationaryDetector(self._noise, self._space)
        self._epoch = len(self.keyframes)

    def reaches(self, stamp_ns: int) -> bool:
        """Return whether odometry says where the robot was at a stamp: not while it was silent, and the robot moved."""
        motion = next((m for m in reversed(self._motions) if m.start_ns <= stamp_ns), None)
        return motion is None or motion.reaches(stamp_ns)

    def where(self, stamp_ns: int) -> PoseAtStamp:
        """Return the robot's pose at a stamp: the keyframe before it and the odometry in between."""
        motion = next((m for m in reversed(self._motions) if m.start_ns <= stamp_ns), None)
        if motion is None:
            return self._where_long_ago(stamp_ns)
        moved = motion.at(stamp_ns)
        vertex = self.keyframes[motion.keyframe].vertex
        return PoseAtStamp(motion.keyframe, vertex, stamp_ns, moved.T_keyframe_base, moved.covariance)

    def _where_long_ago(self, stamp_ns: int) -> PoseAtStamp:
        """Interpolate between two keyframes whose odometry is no longer remembered."""
        present = self.keyframes.stamps_ns[max(self._epoch - self.keyframes.first, 0) :]
        k = len(self.keyframes) - len(present) + int(np.searchsorted(present, stamp_ns, side="right")) - 1
        group, (a, b) = self._space.group, (self.keyframes[k], self.keyframes[k + 1])
        T_a_b = self._space.identity if k + 1 in self.segments else group.between(a.T_odom_base, b.T_odom_base)
        fraction = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
        moved = group.interpolate(self._space.identity, T_a_b, fraction)
        covariance = group.noise_during(moved, self._noise.of(moved, (stamp_ns - a.stamp_ns) * 1e-9, None))
        return PoseAtStamp(k, a.vertex, stamp_ns, moved, covariance)
