"""The read-only part of the pipeline that is the path: keyframes, segments, and where the robot saw what."""

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Index, Numbers


class PathView:
    """The path of a pipeline, read from its parts.

    Attributes
    ----------
    config : the present parameters
    backend : the graph, its solver and the verdicts on its edges
    """

    config: Config
    backend: Backend
    _frontend: KeyframeFrontend

    @property
    def space(self) -> Geometry:
        """The plane or space."""
        return self.config.space

    @property
    def graph(self) -> Graph:
        """The graph of vertices and edges."""
        return self.backend.graph

    @property
    def solver(self) -> Solver:
        """The solver of the graph."""
        return self.backend.solver

    @property
    def keyframes(self) -> StampedPoses[Keyframe]:
        """The keyframes, in order of time."""
        return self._frontend.path.keyframes

    @property
    def first_keyframe(self) -> int:
        """The number of the first keyframe that was not condensed."""
        return self.keyframes.first

    @property
    def began_ns(self) -> int:
        """The stamp of the first keyframe of all."""
        return self.bounded.old[0].stamp_ns if self.bounded else self.keyframes[0].stamp_ns

    @property
    def bounded(self) -> BoundedState | None:
        """The state of a condensed map that is not in its graph; None where nothing was condensed."""
        return self.backend.bounded if self.first_keyframe else None

    def newer_keyframes(self, first: int) -> list[Keyframe]:
        """The keyframes from a number on, without those that were condensed."""
        return self.keyframes.after(first)

    @property
    def keyframe_count(self) -> int:
        """The number of keyframes, condensed ones included."""
        return len(self.keyframes)

    @property
    def segments(self) -> list[int]:
        """The indices of the keyframes at which a segment begins: odometry started there, or jumped."""
        return self._frontend.path.segments

    @property
    def drives(self) -> list[int]:
        """The index of the first keyframe of each drive; the last drive is the present one."""
        return self._frontend.path.drives

    @property
    def sighting_poses(self) -> StampedPoses[SightingPose]:
        """The poses at the stamps of the sightings, each relative to a keyframe."""
        return self._frontend.sighting_poses

    def trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` of all keyframes, (n, 3) or (n, 7)."""
        return self.solver.estimate(self.keyframes.ids).reshape(-1, self.space.pose.size)

    def shown_path(self) -> tuple[Index, Array]:
        """Stamps and estimated poses of all keyframes that are in the graph, in order of time."""
        old = self.bounded.old if self.bounded else []
        vertices = [*(one.vertex for one in old), *self.keyframes.ids.tolist()]
        stamps_ns = [*(one.stamp_ns for one in old), *self.keyframes.stamps_ns.tolist()]
        poses = self.solver.estimate(vertices).reshape(-1, self.space.pose.size)
        return np.array(stamps_ns, dtype=np.int64), poses

    def sighting_trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` at the stamps of the sightings, (n, 3) or (n, 7).

        The correction of odometry between two keyframes is spread evenly over the time between them.
        """
        poses, group = self.trajectory(), self.space.group
        found, stamps_ns = self._at_sightings(poses), self.keyframes.stamps_ns
        since_ns = self.sighting_poses.stamps_ns - stamps_ns[self._sighting_rows]
        ends = np.isin(self.sighting_poses.ids + 1, [*self.segments, len(self.keyframes)])
        a = self._sighting_rows[~ends]
        motion = self._motions(a)
        wrong = group.local(tuple(poses[a + 1].T), group.compose(tuple(poses[a].T), motion))
        part = np.minimum(since_ns[~ends] / np.maximum(stamps_ns[a + 1] - stamps_ns[a], 1), 1.0)
        found[~ends] = np.stack(group.retract(tuple(found[~ends].T), tuple(part * d for d in wrong)), axis=-1)
        return found

    @property
    def _sighting_rows(self) -> Index:
        """The row of the keyframe of each sighting."""
        return self.sighting_poses.ids - self.first_keyframe

    def _motions(self, keyframes: Index) -> Numbers:
        """The motion from each of some keyframes, by their rows, to the next as measured, in arrays."""
        odometry, group = self.keyframes.poses, self.space.group
        motion: Numbers = group.between(tuple(odometry[keyframes].T), tuple(odometry[keyframes + 1].T))
        if self._frontend.gyro is None:
            return self._frontend.corrections.motion(motion)
        out, ids = np.stack(motion, axis=-1), self.keyframes.ids
        edges = map(self.graph.edge, self.graph.edges_of("odometry").tolist())
        measured = {tuple(edge.vertices): edge.measured for edge in edges}
        for k, ends in enumerate(zip(ids[keyframes].tolist(), ids[keyframes + 1].tolist(), strict=True)):
            out[k] = measured.get(ends, out[k])
        return tuple(out.T)

    def sighting_odometry(self) -> Array:
        """Return the poses of odometry alone, ``T_odom_base`` at the stamps of the sightings, (n, 3) or (n, 7)."""
        return self._at_sightings(self.keyframes.poses)

    def _at_sightings(self, keyframe_poses: Array) -> Array:
        keyframes = keyframe_poses[self._sighting_rows]
        return np.stack(self.space.group.compose(tuple(keyframes.T), tuple(self.sighting_poses.poses.T)), axis=-1)
