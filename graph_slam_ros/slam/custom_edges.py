"""Custom edges: measurements whose edge types plugins have, between poses of the robot and landmarks."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.edge_tags import map_edge_of
from graph_slam_ros.graph import EdgeType
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.custom_edges import edge_type_of
from graph_slam_ros.measurements.edge_noise import edge_noise
from graph_slam_ros.measurements.types import CustomEdge
from graph_slam_ros.plugin_edges import FailedEdge, failed_edges
from graph_slam_ros.slam.anchor import Anchor
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp, as_matrix
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.robust.ledger import Reason
from graph_slam_ros.typing import Array

_LABEL = "custom"


class CustomEdges:
    """Adds custom edges to the graph, and withdraws those on which their plugin fails.

    The poses of an edge are those of the robot at the stamps of the measurement. The motion from the keyframe before is
    part of the measurement, and its noise is added.

    Parameters
    ----------
    landmarks : the landmarks that an edge may name
    anchor : locates the map for a surveyed landmark that was not seen before
    """

    def __init__(
        self,
        config: Config,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: Landmarks,
        anchor: Anchor,
        counters: Counters,
    ) -> None:
        self._config, self._space, self._counters = config, config.space, counters
        self._backend, self._frontend, self._landmarks, self._anchor = backend, frontend, landmarks, anchor
        frontend.custom_noise_dominates = self._motion_dominates

    def add(self, m: CustomEdge) -> None:
        """Add an edge. One that cannot be used is counted.

        Raises
        ------
        ConfigError, FormatError
            No plugin has the edge type, or the numbers are not those of it.
        """
        edge, measured = edge_type_of(m)
        aliases = self._landmarks.aliases
        m = replace(m, ends=tuple(aliases.get(end, end) if isinstance(end, str) else end for end in m.ends))
        for name in m.landmarks:
            self._begin_surveyed(m, name)
        reason = self._unusable(m, edge)
        if not reason:
            self._frontend.where(m)  # which may add a keyframe
            poses = self._poses(m)
            vertices = self._vertices(m, poses)
            reason = "within_one_keyframe" if len(set(vertices)) < len(vertices) else ""
        if reason:
            self._counters.count(m.topic, reason)
            return
        z = self._with_motions(edge, measured, m, poses)
        with failed_edges() as failed:
            jacobian = self._jacobian(edge, vertices, z)
        if failed:
            self._count_fault(m.topic, next(iter(failed.values())).fault)
            return
        covariance = as_matrix(m.covariance) + self._motion_noise(edge, m, jacobian, poses)
        noise = edge_noise(self._counters, m.topic, covariance, 0)
        self._backend.noise.add_edge(edge, vertices, z, noise, _LABEL, m.topic)
        self._counters.used[m.topic] += 1

    def withdraw(self, failed: Iterable[FailedEdge], keyframe: int) -> bool:
        """Withdraw edges on which their plugin failed during a solve. Returns whether there were any."""
        found = {edge: one.fault for one in failed for edge in self._edges_of(one)}
        for edge, fault in found.items():
            source = self._backend.graph.source_of(edge)
            self._count_fault(source, fault)
            self._counters.used[source] = max(0, self._counters.used[source] - 1)  # those of a loaded map are not in it
        if found:
            self._backend.withdraw(list(found), keyframe, Reason.FAILED)
        return bool(found)

    def _count_fault(self, topic: str, fault: str) -> None:
        self._counters.faults.setdefault(topic, fault)
        self._counters.count(topic, "plugin_failed")

    def _edges_of(self, failed: FailedEdge) -> list[int]:
        """The edges of the graph that caused a failure, without withdrawn ones."""
        graph, ledger = self._backend.graph, self._backend.ledger
        table = graph.tables.get(map_edge_of(failed.tag))
        if table is None:
            return []
        rows = table.at(np.arange(len(table)))
        alike = np.flatnonzero((rows.measured == failed.measured).all(axis=1))
        return [
            int(rows.ids[k])
            for k in alike.tolist()
            if tuple(graph.vertex(v).stored.start for v in rows.vertices[k].tolist()) == failed.at
            and not ledger.is_withdrawn(int(rows.ids[k]))
            and rows.ids[k] >= ledger.final
        ]

    # -- vertices ------------------------------------------------------------------------------------------------

    def _begin_surveyed(self, m: CustomEdge, name: str) -> None:
        """Begin a landmark at its surveyed place, if the map is in the frame of the survey."""
        known = self._config.survey.get(name)
        if known is None or name in self._landmarks.known or not self._landmarks.begins_new:
            return
        if self._anchor.is_located:
            if self._config.start_pose is not None:
                self._anchor.align_to_landmark(known, np.array(known.position), len(self._frontend.path.keyframes) - 1)
            self._landmarks.begin_surveyed(m.topic, name, m.stamp_ns)

    def _unusable(self, m: CustomEdge, edge: EdgeType) -> str:
        """Return why the ends of an edge cannot be used; empty if they can."""
        reason = ""
        for end, kinds in zip(m.ends, edge.accepts, strict=True):
            landmark = self._landmarks.known.get(end) if isinstance(end, str) else None
            if isinstance(end, int):
                reason = reason if self._space.pose in kinds else "not_in_this_space"
            elif landmark is None or landmark.is_unnamed:
                reason = "landmark_unknown"
            elif self._landmarks.kind_of(landmark.vertex) not in kinds:
                reason = "landmark_of_other_kind"
        return reason

    def _poses(self, m: CustomEdge) -> dict[int, PoseAtStamp]:
        """The pose of the robot for each end that has one."""
        where = self._frontend.path.where
        return {slot: where(end) for slot, end in enumerate(m.ends) if isinstance(end, int)}

    def _vertices(self, m: CustomEdge, poses: dict[int, PoseAtStamp]) -> list[int]:
        known = self._landmarks.known
        return [known[end].vertex if isinstance(end, str) else poses[slot].vertex for slot, end in enumerate(m.ends)]

    # -- motion between the keyframe and the measurement -----------------------------------------------------------

    def _with_motions(self, edge: EdgeType, measured: Array, m: CustomEdge, poses: dict[int, PoseAtStamp]) -> Array:
        """The measurement with ``T_keyframe_base`` of each pose, as ``measured_at_stamps`` has it."""
        z = edge.whole(measured[: edge.measured_size - len(edge.tail)])
        z[: len(measured)] = measured
        end = len(measured)
        for slot, kinds in enumerate(edge.accepts):
            if kinds == (self._space.pose,):
                if slot in poses:
                    z[end : end + self._space.pose.size] = poses[slot].T_keyframe_base
                end += self._space.pose.size
        return z

    def _jacobian(self, edge: EdgeType, vertices: Sequence[int], z: Array) -> Array:
        """The Jacobian (m, D) of one edge at the present estimate."""
        values = [self._backend.solver.estimate([vertex])[0] for vertex in vertices]
        at = np.cumsum([0, *(value.size for value in values[:-1])])[None]
        _, jacobian = edge.linearize(np.concatenate(values), at, z[None])
        return jacobian[0]

    def _motion_noise(self, edge: EdgeType, m: CustomEdge, jacobian: Array, poses: dict[int, PoseAtStamp]) -> Array:
        """The noise (m, m) that odometry between keyframes and stamps adds to the residual: ``J Sigma J'``."""
        first = np.cumsum([0, *edge.dofs])
        out = np.zeros((edge.residual_size, edge.residual_size))
        for slot, where in poses.items():
            at_stamp = jacobian[:, first[slot] : first[slot + 1]] @ self._space.group.adjoint(where.T_keyframe_base)
            out += at_stamp @ where.covariance @ at_stamp.T
        return out

    def _motion_dominates(self, m: CustomEdge, where: PoseAtStamp, most: float) -> bool:
        """Return whether it exceeds a fraction of the variance of any number of the residual."""
        edge, measured = edge_type_of(m)
        poses = {slot: pose for slot, pose in self._poses(m).items() if m.ends[slot] == where.stamp_ns}
        vertices = self._vertices(m, self._poses(m))
        if not poses or len(set(vertices)) < len(vertices):
            return False
        with failed_edges() as failed:
            jacobian = self._jacobian(edge, vertices, self._with_motions(edge, measured, m, self._poses(m)))
        added = np.diag(self._motion_noise(edge, m, jacobian, poses))
        return not failed and bool((added > most * np.diag(as_matrix(m.covariance))).any())
