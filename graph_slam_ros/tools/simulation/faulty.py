"""Recordings and graphs with faults. The truth stays as it was, and every wrong message is listed.

faulty, wrong = faulty_recording(simulate("warehouse", 7), [Fault.named("swapped_ids", at=0.3)], seed=7)
write_bag(faulty, "warehouse.mcap")
write_table("warehouse.faults.csv", WrongMessage, wrong)
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from graph_slam_ros.edge_tags import tag_of
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.g2o_writer import graph_lines
from graph_slam_ros.formats.graph_file import G2oFile
from graph_slam_ros.graph import EdgeType, Gaussian, Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.slam import Closure, Sighting
from graph_slam_ros.tools.simulation.bag import ODOMETRY_TOPIC, recorded_names
from graph_slam_ros.tools.simulation.draft import Draft, Wrong, WrongLine, WrongMessage
from graph_slam_ros.tools.simulation.false_closures import Closures
from graph_slam_ros.tools.simulation.faults import Fault, put_faults
from graph_slam_ros.tools.simulation.motion import space_of
from graph_slam_ros.tools.simulation.pose_graph import values_of
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC, LANDMARKS_TOPIC, Recording, places
from graph_slam_ros.typing import Array, Numbers


def faulty_recording(recording: Recording, faults: Sequence[Fault], seed: int) -> tuple[Recording, list[WrongMessage]]:
    """Put faults into a recording. The truth stays as it was.

    Raises
    ------
    GraphSlamError
        A fault does not fit: it needs closures, or landmarks that are seen often, and there are none.
    """
    space, at = space_of(recording.T_world_base[0]), {ns: k for k, ns in enumerate(recording.stamps_ns.tolist())}
    sizes = [len(one.sightings) for one in recording.seen]
    draft = Draft(
        space,
        recording.T_world_base,
        recording.T_odom_base,
        recording.twist,
        [s for one in recording.seen for s in one.sightings],
        np.repeat(np.array([at[one.stamp_ns] for one in recording.seen], dtype=np.int64), sizes),
        recording.landmarks,
        _closures_of(recording, space, at),
        places(recording.T_world_base),
    )
    put_faults(draft, faults, seed)
    starts = np.cumsum([0, *sizes]).tolist()
    kept = [[k for k in range(start, end) if k not in draft.hidden] for start, end in pairwise(starts)]
    seen = tuple(
        replace(one, sightings=tuple(draft.sightings[k] for k in some))
        for one, some in zip(recording.seen, kept, strict=True)
        if some
    )
    closures, place = _recorded_closures(recording, draft)
    twist = recording.twist if draft.twist is None else draft.twist
    faulty = replace(recording, T_odom_base=draft.odometry, twist=twist, seen=seen, closures=closures)

    def message(what: str, k: int) -> tuple[str, int, int | str, str]:
        if what == "odometry":
            return ODOMETRY_TOPIC, int(recording.stamps_ns[k]), "", ""
        if what == "closure":
            one = closures[place[k]]
            first = next(j for j, other in enumerate(closures) if other.stamp_ns == one.stamp_ns)
            return CLOSURES_TOPIC, one.stamp_ns, place[k] - first, str(one.from_stamp_ns)
        of = int(np.searchsorted(starts, k, side="right")) - 1
        if k in draft.hidden:
            return LANDMARKS_TOPIC, recording.seen[of].stamp_ns, "", ""
        return LANDMARKS_TOPIC, recording.seen[of].stamp_ns, kept[of].index(k), names[draft.sightings[k].id]

    names = recorded_names(recording)
    hidden = {("sighting", k): Wrong(fault, draft.true_id(k)) for k, fault in draft.hidden.items()}
    rows = [
        WrongMessage(*message(what, k), wrong.fault, names.get(wrong.true_id, ""))
        for (what, k), wrong in (draft.wrong | hidden).items()
    ]
    return faulty, sorted(rows, key=lambda row: (row.stamp_ns, row.topic, row.index or 0))


def _closures_of(recording: Recording, space: Geometry, at: Mapping[int, int]) -> Closures:
    n, d = len(recording.closures), space.dof
    ends = [(at[c.from_stamp_ns], at[c.stamp_ns]) for c in recording.closures]
    covariances = np.reshape([c.covariance for c in recording.closures], (n, d, d))
    root = Gaussian.from_covariance(covariances).sqrt_information if n else np.empty((0, d, d))
    measured = np.reshape([c.T_from_base for c in recording.closures], (n, space.pose.size))
    return Closures(np.array(ends, dtype=np.int64).reshape(n, 2), measured, root)


def _recorded_closures(recording: Recording, draft: Draft) -> tuple[tuple[Closure, ...], list[int]]:
    """All closures in order of their later stamp, and the place there of each of the draft's."""
    found, new = list(recording.closures), draft.closures
    for k in range(len(found), len(new)):
        earlier, later = recording.stamps_ns[new.ends[k]].tolist()
        covariance = np.linalg.inv(new.root[k].T @ new.root[k])
        flat = tuple((0.5 * (covariance + covariance.T)).ravel().tolist())
        found.append(Closure(later, earlier, CLOSURES_TOPIC, tuple(new.measured[k].tolist()), flat))
    order = sorted(range(len(found)), key=lambda k: found[k].stamp_ns)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return tuple(found[k] for k in order), place.tolist()


def faulty_graph(file: G2oFile, truth: Array, faults: Sequence[Fault], seed: int) -> tuple[G2oFile, list[WrongLine]]:
    """Put faults into a graph. Its initial values stay as they were.

    Poses are taken in order of their ids, as read from a file. Sightings are edges from a pose to a landmark.

    Parameters
    ----------
    truth : the stored numbers of all vertices end to end, as ``graph.initial``: of a graph whose truth nobody knows,
        those of its optimum

    Raises
    ------
    GraphSlamError
        A fault does not fit: it needs closures, odometry or landmarks that are seen often, and there are none.
    """
    parts = _Parts(file, truth)
    draft = parts.draft()
    put_faults(draft, faults, seed)
    if draft.hidden:
        raise GraphSlamError(f"{next(iter(draft.hidden.values()))}: only in a recording: a graph keeps all its edges")
    out, edges = parts.graph_of(draft)
    tags = {tag_of(edge) for edge in out.graph.tables}
    text = graph_lines(out, values_of(out.graph, out.graph.initial.values))
    lines = [number for number, line in enumerate(text, start=1) if line.split()[0] in tags]
    labels = np.empty(out.graph.edge_count, dtype=np.int64)
    for table in out.graph.tables.values():
        labels[table.id.values] = table.label.values
    line_of = dict(zip(np.lexsort((np.arange(len(labels)), labels)).tolist(), lines, strict=True))
    rows = []
    for key, wrong in draft.wrong.items():
        if key in edges:
            edge = out.graph.edge(edges[key])
            first, second = (out.ids[v] for v in edge.vertices[:2])
            true: int | str = int(wrong.true_id) if wrong.true_id else ""
            rows.append(WrongLine(line_of[edges[key]], tag_of(edge.type), first, second, wrong.fault, true))
    return out, sorted(rows, key=lambda row: row.line)


class _Parts:
    """A graph's edges by kind: odometry, sightings, closures, and others, which no fault changes."""

    def __init__(self, file: G2oFile, truth: Array) -> None:
        graph = file.graph
        self.file, self.truth = file, truth
        self.space = space = SPATIAL if SPATIAL.pose in graph.kinds else PLANAR
        self.tags = self._landmark_poses()
        ids = np.asarray(file.ids)
        is_pose = graph.kind.values == (graph.kinds.index(space.pose) if space.pose in graph.kinds else -1)
        poses = np.flatnonzero(is_pose & ~np.isin(np.arange(graph.vertex_count), list(self.tags)))
        self.poses = poses[np.argsort(ids[poses])]
        if len(self.poses) < 2:
            raise GraphSlamError("faults: a graph of fewer than two poses")
        self.place = {vertex: k for k, vertex in enumerate(self.poses.tolist())}
        self.kinds = {edge: kind for kind, edge in space.sightings.items()} | {space.tag_position: "position"}
        self.odometry: dict[int, tuple[int, bool]] = {}  # by the later pose: edge, and whether it leads forward
        self.sightings: list[tuple[int, int, Sighting]] = []  # pose, edge
        self.closures: list[tuple[int, int, Array, Array]] = []
        for edge in range(graph.edge_count):
            self._sort(edge)
        self.sightings.sort(key=lambda one: one[:2])

    def _landmark_poses(self) -> set[int]:
        """Vertices that are landmarks although they are poses: the ends of edges of the class ``landmarks``."""
        table = self.file.graph.tables.get(self.space.relative_pose)
        if table is None or "landmarks" not in self.file.graph.labels:
            return set()
        rows = np.flatnonzero(table.label.values == self.file.graph.labels.index("landmarks"))
        return set(table.at(rows).vertices[:, 1].tolist())

    def _sort(self, edge: int) -> None:
        one = self.file.graph.edge(edge)
        ends, measured = one.vertices, one.measured
        if one.type is self.space.relative_pose and ends[0] in self.place and ends[1] in self.place:
            first, second = self.place[ends[0]], self.place[ends[1]]
            if abs(first - second) == 1:
                self.odometry.setdefault(max(first, second), (edge, first < second))
            else:
                self.closures.append((first, second, measured, one.sqrt_information))
        elif one.type in self.kinds and ends[0] in self.place and ends[1] not in self.place:
            size = one.type.measured_size - len(one.type.tail)
            on_robot = tuple(measured[size:].tolist()) or None
            name, covariance = str(self.file.ids[ends[1]]), ()
            seen = Sighting(name, self.kinds[one.type], tuple(measured[:size].tolist()), covariance, on_robot)
            self.sightings.append((self.place[ends[0]], edge, seen))

    def draft(self) -> Draft:
        """Return the draft for the faults: odometry as a chain from the origin, and closures that lead forward."""
        space, group = self.space, self.space.group
        chain: list[Numbers] = [space.identity]
        for k in range(1, len(self.poses)):
            step = self._step(k)
            chain.append(tuple(float(x) for x in group.retract(group.compose(chain[-1], step), (0.0,) * space.dof)))
        ends = np.array([one[:2] for one in self.closures], dtype=np.int64).reshape(-1, 2)
        measured = np.reshape([one[2] for one in self.closures], (-1, space.pose.size))
        root = np.reshape([one[3] for one in self.closures], (-1, space.dof, space.dof))
        landmarks = {}
        for vertex, file_id in enumerate(self.file.ids):
            if vertex not in self.place:
                landmarks[str(file_id)] = tuple(self._true(vertex).tolist())
        return Draft(
            space,
            np.array([self._true(vertex) for vertex in self.poses.tolist()]),
            np.array(chain),
            None,
            [seen for _, _, seen in self.sightings],
            np.array([pose for pose, _, _ in self.sightings], dtype=np.int64),
            landmarks,
            Closures(ends, measured, root),
            np.arange(len(self.poses)),
        )

    def graph_of(self, draft: Draft) -> tuple[G2oFile, dict[tuple[str, int], int]]:
        """A new graph with the draft's measurements, and its edges by what they measure."""
        old, group = self.file.graph, self.space.group
        graph = Graph()
        for vertex in range(old.vertex_count):
            graph.add_vertex(old.kind_of(vertex), old.vertex(vertex).initial)
        vertex_of = {str(file_id): vertex for vertex, file_id in enumerate(self.file.ids)}
        changed: dict[int, tuple[list[int], Array]] = {}
        edges: dict[tuple[str, int], int] = {}
        for k, (edge, forward) in self.odometry.items():
            edges["odometry", k] = edge
            if ("odometry", k) in draft.wrong:
                a, b = (tuple(draft.odometry[p].tolist()) for p in ((k - 1, k) if forward else (k, k - 1)))
                changed[edge] = list(old.edge(edge).vertices), np.array(group.between(a, b))
        for k, ((_, edge, _), s) in enumerate(zip(self.sightings, draft.sightings, strict=True)):
            edges["sighting", k] = edge
            if ("sighting", k) in draft.wrong:
                ends = list(old.edge(edge).vertices)
                ends[1] = vertex_of[s.id]
                changed[edge] = ends, np.array([*s.measured, *(s.T_base_sensor or ())])
        now: dict[int, int] = {}
        for edge in range(old.edge_count):
            one = old.edge(edge)
            ends, measured = changed.get(edge, (list(one.vertices), one.measured))
            now[edge] = graph.add_edge(
                _fitting(one.type, self.space, graph, ends),
                ends,
                measured,
                Gaussian(one.sqrt_information),
                one.label,
            )
        edges = {key: now[edge] for key, edge in edges.items()}
        true = len(self.closures)
        if len(draft.closures) > true:
            added = graph.add_edges(
                self.space.relative_pose,
                self.poses[draft.closures.ends[true:]],
                draft.closures.measured[true:],
                Gaussian(draft.closures.root[true:]),
                "closures",
            )
            edges |= {("closure", true + k): edge for k, edge in enumerate(added.tolist())}
        seen_from = {now[edge]: number for edge, number in self.file.seen_from.items()}
        return replace(self.file, graph=graph, seen_from=seen_from), edges

    def _true(self, vertex: int) -> Array:
        return self.truth[self.file.graph.vertex(vertex).stored]

    def _step(self, later: int) -> Numbers:
        """The motion by odometry; the true one if there is none."""
        group = self.space.group
        if later not in self.odometry:
            earlier, this = (tuple(self._true(int(v)).tolist()) for v in self.poses[later - 1 : later + 1])
            return tuple(float(x) for x in group.between(earlier, this))
        edge, forward = self.odometry[later]
        measured = tuple(self.file.graph.edge(edge).measured.tolist())
        return measured if forward else tuple(float(x) for x in group.inverse(measured))


def _fitting(edge: EdgeType, space: Geometry, graph: Graph, ends: list[int]) -> EdgeType:
    """The edge's type, unless it leads to another landmark now, of which only points or only poses can be seen so."""
    if all(graph.kind_of(v) in kinds for v, kinds in zip(ends, edge.accepts, strict=True)):
        return edge
    for other in (space.sightings["position"], space.tag_position):
        if edge in (space.sightings["position"], space.tag_position) and graph.kind_of(ends[1]) in other.accepts[1]:
            return other
    raise GraphSlamError(f"{edge.name}: landmarks are points and poses, and cannot be taken for each other")
