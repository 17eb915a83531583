"""A part of the drive is cut out by hand: its keyframes with all that was measured from them."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.anchor import Anchor
from graph_slam_ros.slam.edit_tools import BY_HAND, EditTools
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.landmark_edits import LandmarkEdits
from graph_slam_ros.slam.path_edits import PathEdits

_LEFT = 2  # keyframes at least


class DriveCut:
    """Cuts keyframes out of a map that no robot drives in at the time."""

    def __init__(
        self,
        space: Geometry,
        tools: EditTools,
        frontend: KeyframeFrontend,
        landmarks: LandmarkEdits,
        path: PathEdits,
        anchor: Anchor,
    ) -> None:
        self._space, self._tools, self._frontend = space, tools, frontend
        self._landmarks, self._path, self._anchor = landmarks, path, anchor
        self._backend = tools.backend

    def cut(self, first: int, last: int, keyframe: int) -> None:
        """Cut out keyframes, by index, both included.

        Raises
        ------
        GraphSlamError
            They are part of a frozen map, the robot drives, or next to nothing would be left.
        """
        tools, backend = self._tools, self._backend
        backend.hand_over()
        gone = self._frontend.path.keyframes.ids[first : last + 1].tolist()
        self._check(gone)
        edges = tools.edges_of(*gone)
        bridges = self._bridges(first, last, edges)
        self._move_anchors(first, last, set(gone), keyframe)
        for source, motion, noise in bridges:
            ends = self._frontend.path.keyframes.ids[[first - 1, last + 1]].tolist()
            backend.graph.add_edge(self._space.relative_pose, ends, motion, noise, "odometry", source)
        backend.gate_new(keyframe)
        self._withdraw_sightings(edges, keyframe)
        tools.withdraw(edges, keyframe)
        for vertex in gone:
            backend.solver.remove(vertex)
        self._renumber(first, last)
        self._anchor.restore()
        tools.counters.count("edit", "cut_out")

    def _check(self, gone: Sequence[int]) -> None:
        left = len(self._frontend.path.keyframes) - len(gone)
        if left < _LEFT:
            raise GraphSlamError(f"{left} keyframes would be left, at least {_LEFT} are needed")
        if self._frontend.path.motion is not None:
            raise GraphSlamError("the robot drives in this map: edit the run when it has ended")
        for vertex in gone:
            self._tools.refuse_held(vertex)

    def _bridges(self, first: int, last: int, edges: Sequence[int]) -> list[tuple[str, Sequence[float], Gaussian]]:
        """Odometry over the part, of each input that has all of it: input, motion and noise."""
        ids, graph, group = self._frontend.path.keyframes.ids, self._backend.graph, self._space.group
        if first == 0 or last == len(ids) - 1:
            return []
        chain = ids[first - 1 : last + 2].tolist()
        steps = {pair: k for k, pair in enumerate(pairwise(chain))}
        links: dict[str, dict[int, int]] = {}
        for edge in edges:
            one = graph.edge(edge)
            if one.label == "odometry" and one.vertices in steps:
                links.setdefault(one.source, {})[steps[one.vertices[0], one.vertices[1]]] = edge
        whole = {source: of for source, of in links.items() if len(of) == len(steps)}
        if not whole:  # an input took over from another on the way
            whole = {"": {k: edge for of in links.values() for k, edge in of.items()}}
        if len(next(iter(whole.values()))) < len(steps):
            raise GraphSlamError("odometry does not lead over it")
        out = list[tuple[str, Sequence[float], Gaussian]]()
        for source, of in whole.items():
            motion, covariance = self._space.identity, np.zeros((self._space.dof, self._space.dof))
            for k in range(len(steps)):
                one = graph.edge(of[k])
                step, root = tuple(one.measured.tolist()), one.sqrt_information
                covariance = group.propagate(covariance, step, np.linalg.inv(root.T @ root))
                motion = self._space.normalized(group.compose(motion, step))
            out.append((source, tuple(map(float, motion)), Gaussian.from_covariance(covariance)))
        return out

    def _move_anchors(self, first: int, last: int, gone: set[int], keyframe: int) -> None:
        """Anchor the keyframe next to the part, where it is now, as one of the part was."""
        graph, ids = self._backend.graph, self._frontend.path.keyframes.ids
        vertex = int(ids[last + 1] if last + 1 < len(ids) else ids[first - 1])
        at = tuple(self._backend.solver.estimate([vertex])[0].tolist())
        for one in map(graph.edge, self._path.anchors()):
            if one.vertices[0] in gone:
                noise = Gaussian(one.sqrt_information)
                if one.label == BY_HAND:
                    self._tools.add(one.type, [vertex], at, noise, keyframe)
                else:
                    graph.add_edge(one.type, [vertex], at, noise, one.label, one.source)

    def _withdraw_sightings(self, edges: Sequence[int], keyframe: int) -> None:
        """Take sightings from landmarks; one that no others determine goes."""
        graph, tools, gone = self._backend.graph, self._tools, set(edges)
        of_vertex: dict[int, list[int]] = {}
        for edge in edges:
            for end in graph.edge(edge).vertices:
                of_vertex.setdefault(end, []).append(edge)
        for name, mark in list(tools.landmarks.known.items()):
            if mark.vertex not in of_vertex:
                continue
            left = [edge for edge in tools.determining(mark.vertex) if edge not in gone]
            left = [edge for edge in left if graph.label_of(edge) != "surveyed"]
            if tools.determines(left, mark.vertex) or self._backend.solver.is_held(mark.vertex):
                self._landmarks.withdraw_from(mark, of_vertex[mark.vertex], keyframe)
            else:
                self._landmarks.remove(name, keyframe)

    def _renumber(self, first: int, last: int) -> None:
        """Give the keyframes after the part their new numbers, wherever they are named."""
        frontend, backend, count = self._frontend, self._backend, last - first + 1
        frontend.cut(first, last)
        ledger = backend.ledger
        before = max(first - 1, 0)

        def newest(keyframe: int) -> int:
            """The newest keyframe there was, of those that are left."""
            return keyframe if keyframe < first else max(keyframe - count, before)

        known = ledger.keyframe.values
        known[:] = np.where(known < first, known, np.maximum(known - count, before))
        ledger.history[:] = [replace(one, keyframe=newest(one.keyframe)) for one in ledger.history]
        backend.edits[:] = [replace(one, keyframe=newest(one.keyframe)) for one in backend.edits]
        for mark in self._tools.landmarks.known.values():
            mark.seen = [
                replace(one, where=replace(one.where, keyframe=newest(one.where.keyframe))) for one in mark.seen
            ]
