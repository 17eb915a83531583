"""The scans in memory, and how the robot moved between them and around each of them by odometry."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from graph_slam_ros.config.pipeline import OdometryConfig
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.association.scans import (
    NEARBY_NS,
    DeadReckoning,
    Motion,
    Scan,
    motion_between,
    rescaled_nearby,
)
from graph_slam_ros.slam.frontend.odometry_selector import JUMP_SIGMA_M, JUMP_SIGMA_RAD
from graph_slam_ros.typing import Array

Added = Callable[[float], Array]
"""Variances (dof,) that so many seconds of motion add to odometry."""


class ScanHistory:
    """Scans in order.

    Parameters
    ----------
    reckoning : odometry of the last seconds

    Attributes
    ----------
    scans : all of them
    firsts : the first cluster of each
    motions : from each to the next
    """

    def __init__(self, space: Geometry, odometry: OdometryConfig, reckoning: DeadReckoning) -> None:
        self._space, self._reckoning, self._noise = space, reckoning, odometry
        self._jump = np.diag(np.square(space.sigmas(JUMP_SIGMA_M, JUMP_SIGMA_RAD)))
        self.scans: list[Scan] = []
        self.firsts: list[int] = []
        self.motions: list[Motion] = []
        self._nearby: list[Array] = []  # of the scans after which odometry went on for long enough
        self._split = set[int]()  # keyframes at which the robot was moved, by their vertices
        self._doubt: Added | None = None

    def append(self, scan: Scan, first: int) -> Motion | None:
        """Add a scan, with its first cluster. Returns the motion to it; None for the first scan."""
        if self.scans:
            motion = motion_between(self._space, self._noise, self.scans[-1].at, scan.at, self._jump)
            self.motions.append(self._doubted(motion))
        self.scans.append(scan)
        self.firsts.append(first)
        return self.motions[-1] if self.motions else None

    def note_motion(self, now_ns: int) -> None:
        """Keep how the robot moved around the scans, as far as odometry shows it by now."""
        for scan in self.scans[len(self._nearby) :]:
            if now_ns < scan.at.stamp_ns + NEARBY_NS:
                break
            self._nearby.append(self._reckoning.nearby(scan.at.stamp_ns))

    def nearby(self) -> Array:
        """Return how the robot moved around each scan (N, S, dof)."""
        more = [self._reckoning.nearby(scan.at.stamp_ns) for scan in self.scans[len(self._nearby) :]]
        return np.array(self._nearby + more)

    def rescale(self, factors: tuple[float, float]) -> None:
        """Take over that odometry's distance and turn were multiplied. The reckoning has done so."""
        self.motions = [motion.rescaled(factors) for motion in self.motions]
        self._nearby = [rescaled_nearby(self._space, one, factors) for one in self._nearby]
        at = self._reckoning.at
        known = [self._reckoning.remembers(scan.at.stamp_ns) for scan in self.scans]
        self.scans = [replace(s, at=at(s.at.stamp_ns)) if k else s for s, k in zip(self.scans, known, strict=True)]

    def doubt(self, since_ns: int, added: Added | None) -> int | None:
        """Use odometry with more noise, or as stated again. Returns the first scan whose motion has changed.

        Parameters
        ----------
        added : what is added since then; None: nothing from now on
        """
        self._doubt = added
        since = [k for k, scan in enumerate(self.scans) if k and scan.at.stamp_ns > since_ns]
        if added is None or not since:
            return None
        for k in since:
            self.motions[k - 1] = self._doubted(self.motions[k - 1])
        return since[0]

    def _doubted(self, motion: Motion) -> Motion:
        if self._doubt is None:
            return motion
        return replace(motion, covariance=motion.covariance + np.diag(self._doubt(motion.moving_s)))

    def split(self, vertex: int) -> int | None:
        """Note that the robot was moved at a keyframe, by its vertex. Returns the first scan since; None if none is."""
        k = self._first_from(vertex)
        if k is not None and not self.motions[k - 1].is_broken:
            m = self.motions[k - 1]
            self.motions[k - 1] = replace(m, covariance=m.covariance + self._jump, is_broken=True)
            self._split.add(vertex)
        return k

    def rejoin(self, vertex: int) -> None:
        """Use odometry again at a keyframe at which the robot was thought to be moved."""
        k = self._first_from(vertex)
        if k is not None and vertex in self._split:
            self.motions[k - 1] = self._unbroken(self.motions[k - 1])
        self._split.discard(vertex)

    @property
    def displacements(self) -> frozenset[int]:
        """The keyframes at which the robot was moved, by their vertices, since the last other jump of odometry."""
        return frozenset(self._split)

    def keep_displacements(self) -> None:
        """Note that another frame of odometry begins: what was decided in the last one stays."""
        self._split.clear()

    def undisplaced(self) -> tuple[Motion, ...]:
        """Return the motions by odometry alone, as if the robot had not been moved."""
        out = list(self.motions)
        for k in filter(None, map(self._first_from, self._split)):
            out[k - 1] = self._unbroken(out[k - 1])
        return tuple(out)

    def _unbroken(self, m: Motion) -> Motion:
        return replace(m, covariance=m.covariance - self._jump, is_broken=False)

    def _first_from(self, vertex: int) -> int | None:
        """Return the first scan of a keyframe or a later one, if others are before it."""
        k = next((k for k, scan in enumerate(self.scans) if scan.where.vertex >= vertex), 0)
        return k or None

    def since(self, keyframe: int) -> int:
        """Return the first scan from which on nothing was seen from a keyframe before a number."""
        for k in range(len(self.scans), 0, -1):
            if any(seen.where.keyframe < keyframe for c in self.scans[k - 1].clusters for seen in c.seen):
                return k
        return 0

    def forget(self, count: int) -> None:
        """Forget the first scans."""
        self.scans = self.scans[count:]
        self.motions, self._nearby = self.motions[count:], self._nearby[count:]
        self.firsts = self.firsts[count:]
