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
from graph_slam_ros.graph import Gaussian
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL, Geometry
from graph_slam_ros.slam import Closure
from graph_slam_ros.tools.simulation.bag import ODOMETRY_TOPIC, recorded_names
from graph_slam_ros.tools.simulation.draft import Draft, WrongLine, WrongMessage
from graph_slam_ros.tools.simulation.false_closures import Closures
from graph_slam_ros.tools.simulation.faults import Fault, put_faults
from graph_slam_ros.tools.simulation.motion import space_of
from graph_slam_ros.tools.simulation.pose_graph import values_of
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC, LANDMARKS_TOPIC, Recording, places
from graph_slam_ros.typing import Array


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
    seen = tuple(
        replace(one, sightings=tuple(draft.sightings[start:end]))
        for one, (start, end) in zip(recording.seen, pairwise(starts), strict=True)
    )
    closures, place = _recorded_closures(recording, draft)
    faulty = replace(recording, T_odom_base=draft.odometry, twist=draft.twist, seen=seen, closures=closures)

    def message(what: str, k: int) -> tuple[str, int, int | str, str]:
        if what == "odometry":
            return ODOMETRY_TOPIC, int(recording.stamps_ns[k]), "", ""
        if what == "closure":
            one = closures[place[k]]
            first = next(j for j, other in enumerate(closures) if other.stamp_ns == one.stamp_ns)
            return CLOSURES_TOPIC, one.stamp_ns, place[k] - first, str(one.from_stamp_ns)
        of = int(np.searchsorted(starts, k, side="right")) - 1
        return LANDMARKS_TOPIC, recording.seen[of].stamp_ns, k - starts[of], names[draft.sightings[k].id]

    names = recorded_names(recording)
    rows = [
        WrongMessage(*message(what, k), wrong.fault, names.get(wrong.true_id, ""))
        for (what, k), wrong in draft.wrong.items()
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
    """Add false closures to the graph of a file, whose poses are in order of their ids.

    Parameters
    ----------
    truth : the stored numbers of all vertices end to end, as ``graph.initial``: of a graph whose truth nobody knows,
        those of its optimum

    Raises
    ------
    GraphSlamError
        Another fault, or no closures that false ones could be like.
    """
    graph, is_pose = file.graph, np.zeros(file.graph.vertex_count, dtype=bool)
    space = SPATIAL if SPATIAL.pose in graph.kinds else PLANAR
    if space.relative_pose not in graph.tables:
        raise GraphSlamError("faults: a graph without relative poses")
    table = graph.tables[space.relative_pose]
    is_pose[np.flatnonzero(graph.kind.values == graph.kinds.index(space.pose))] = True
    if "landmarks" in graph.labels:  # tags with orientation are poses, too
        is_pose[table.vertices.values[table.label.values == graph.labels.index("landmarks"), 1]] = False
    poses = np.flatnonzero(is_pose)
    poses = poses[np.argsort(np.asarray(file.ids)[poses])]
    place = np.full(graph.vertex_count, -1)
    place[poses] = np.arange(len(poses))
    edges = table.at(np.argsort(table.id.values))
    ends = place[edges.vertices]
    is_closure = np.asarray((ends >= 0).all(axis=1))
    steps = np.flatnonzero(is_closure & (np.abs(ends[:, 1] - ends[:, 0]) == 1))
    is_closure[steps[np.unique(ends[steps].max(axis=1), return_index=True)[1]]] = False
    true = truth[graph.offset.values[poses][:, None] + np.arange(space.pose.size)]
    closures = Closures(ends[is_closure], edges.measured[is_closure], edges.sqrt_information[is_closure])
    draft, first = Draft(space, true, true, true, [], ends[:0, 0], {}, closures, np.arange(len(poses))), len(closures)
    for fault in faults:
        if fault.kind != "false_closures":
            raise GraphSlamError(f"{fault.kind}: a graph has no messages and no drive: it takes false_closures alone")
    put_faults(draft, faults, seed)
    false = draft.closures.ends[first:], draft.closures.measured[first:], draft.closures.root[first:]
    added = graph.add_edges(space.relative_pose, poses[false[0]], false[1], Gaussian(false[2]), "closures")
    line_of = _lines(file)
    rows = []
    for edge, (i, j) in zip(added.tolist(), poses[false[0]].tolist(), strict=True):
        rows.append(WrongLine(line_of[edge], tag_of(space.relative_pose), file.ids[i], file.ids[j], "false_closures"))
    return file, sorted(rows, key=lambda row: row.line)


def _lines(file: G2oFile) -> dict[int, int]:
    """The line of each edge in the file that is written, from 1."""
    graph, tags = file.graph, {tag_of(edge) for edge in file.graph.tables}
    text = graph_lines(file, values_of(graph, graph.initial.values))
    lines = [number for number, line in enumerate(text, start=1) if line.split()[0] in tags]
    labels = np.empty(graph.edge_count, dtype=np.int64)
    for table in graph.tables.values():
        labels[table.id.values] = table.label.values
    return dict(zip(np.lexsort((np.arange(len(labels)), labels)).tolist(), lines, strict=True))
