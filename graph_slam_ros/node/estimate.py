"""The estimate that the worker's thread leaves for the others."""

from dataclasses import dataclass
from typing import Any

from graph_slam_ros.slam import GraphSlam
from graph_slam_ros.slam.solution import Correction
from graph_slam_ros.typing import Numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The state of the pipeline after an update, for whoever must not wait for the next.

    Attributes
    ----------
    T_map_odom : the correction; of identity before the first keyframe
    T_odom_keyframe, covariance, stamp_ns : odometry's pose, tangent covariance and stamp of the newest keyframe
    source : the odometry in use
    is_confirmed : whether the robot knows where it is in a map that was loaded
    fit : chi2 per degree of freedom; NaN before it was looked at
    rivals : loop closures of other explanations that could not be ruled out
    displaced : that the landmarks say that the robot is elsewhere than odometry; empty where they do not
    is_resumed : whether a drive that was cut off goes on by odometry alone: nothing was recognised since
    """

    T_map_odom: Numbers
    T_odom_keyframe: Numbers
    covariance: Any
    stamp_ns: int
    source: str
    is_confirmed: bool
    keyframes: int
    landmarks: int
    edges: int
    segments: int
    solves: int
    correction: Correction
    solve_s: float
    slowest_solve_s: float
    fit: float
    rivals: int
    displaced: str = ""
    is_resumed: bool = False

    @property
    def is_located(self) -> bool:
        """Return whether pose and ``map -> odom`` may be published."""
        return self.is_confirmed or self.is_resumed

    @classmethod
    def of(
        cls,
        slam: GraphSlam,
        correction: Correction,
        *,
        is_confirmed: bool,
        is_resumed: bool,
        solve_s: float,
        slowest_solve_s: float,
        fit: float,
    ) -> "Estimate":
        """Return the estimate of a pipeline that has keyframes; the rest is as of the attributes."""
        newest = slam.keyframes[-1]
        return cls(
            T_map_odom=slam.T_map_odom,
            T_odom_keyframe=newest.T_odom_base,
            covariance=slam.pose_covariance,
            stamp_ns=newest.stamp_ns,
            source=slam.odometry_source,
            is_confirmed=is_confirmed,
            keyframes=len(slam.keyframes),
            landmarks=len(slam.landmarks),
            edges=slam.graph.edge_count,
            segments=len(slam.segments),
            solves=slam.solves,
            correction=correction,
            solve_s=solve_s,
            slowest_solve_s=slowest_solve_s,
            fit=fit,
            rivals=sum(len(rival.only_here) for rival in slam.backend.rivals),
            displaced=str(slam.displaced or ""),
            is_resumed=is_resumed,
        )
