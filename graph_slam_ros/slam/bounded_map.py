"""A map bounded by its area: visits that left the window are condensed, and graph and solver are compacted.

Both are done at once, at keyframes that follow from the accepted measurements alone, and only while nothing goes on
that could change a verdict: no search, no alarm, nothing held back undecided. So a replay condenses as the live run
does.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.slam.anchor import Anchor
from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.doubt.detector import OdometryDoubt
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.levels import ENOUGH
from graph_slam_ros.slam.lifelong.condenser import CHAIN, Condensed, Condenser, RemovedPose, seen_from
from graph_slam_ros.slam.lifelong.place import Cell
from graph_slam_ros.slam.lifelong.state import Left, Records, record_type
from graph_slam_ros.slam.robust.gating import CANDIDATES
from graph_slam_ros.slam.robust.ledger import INSIDE, Reason, Verdict
from graph_slam_ros.slam.solution import Solution
from graph_slam_ros.typing import Index

CONDENSED, EXPIRED = "condensed", "expired"
BATCH = 200  # keyframes that leave the window together, at most those of one visit, and those that wait for its end
_VISITS, _BACKLOG = 4, 300  # most visits of an update, or it takes long; unless so many keyframes are to leave
_AGAIN = 20  # keyframes until it is tried again, where sightings without ids are not explained yet
_SOURCE = "map"  # of what is counted
_SUMMED = (PLACES, CHAIN)  # edges that a later one contains, when it takes their place


@dataclass(frozen=True, slots=True)
class CondensedEdge:
    """An edge that left the map, and what was decided of it.

    Attributes
    ----------
    edge : its lasting id
    label, source, landmark : as in the ledger
    keyframe : at which it was judged first
    stamp_ns : of the newest keyframe that it was attached to
    statistic, dof, threshold, verdict, reason : as in the ledger, in the end
    became : ``condensed`` if it was believed: a place or a longer motion has what it measured; else ``expired``
    """

    edge: int
    label: str
    source: str
    landmark: str
    keyframe: int
    stamp_ns: int
    statistic: float
    dof: int
    threshold: float
    verdict: Verdict
    reason: Reason
    became: str


@dataclass(frozen=True, slots=True)
class Condensation:
    """The part of a map that left it at one time.

    Attributes
    ----------
    left : records of the keyframes that left, and of the poses at which something was seen from them
    first : number of the first of these keyframes; sightings_before : how many such poses had left before
    edges : of the graph that are gone, with what was decided of them
    """

    left: Left
    first: int
    sightings_before: int
    edges: tuple[CondensedEdge, ...]


class BoundedMap:
    """Condenses what has left the window.

    Parameters
    ----------
    backend : its graph, solver and ``bounded`` are changed; all other parts forget what has left
    """

    def __init__(
        self,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        anchor: Anchor,
        doubt: OdometryDoubt,
        solution: Solution,
        counters: Counters,
    ) -> None:
        self._space, self._backend, self._frontend = frontend.config.space, backend, frontend
        self._landmarks, self._anchor, self._doubt = landmarks, anchor, doubt
        self._solution, self._counters = solution, counters
        self.state = backend.bounded
        self.condenser = Condenser(self._space, backend.solver, self.state)
        self._tried = 0  # keyframes at the last try

    @property
    def _is_due(self) -> bool:
        """Return whether so many keyframes are out of the window that some should leave."""
        keyframes, config = self._frontend.path.keyframes, self._frontend.config
        is_long = len(keyframes) - keyframes.first >= config.map.window_keyframes + BATCH
        return config.condenses and is_long and len(keyframes) > self._tried

    @property
    def _limit(self) -> int:
        """The number of the first keyframe that may not leave."""
        path, window = self._frontend.path, self._frontend.config.map.window_keyframes
        return min(len(path.keyframes) - window, path.remembered_from)

    def condense(self) -> Condensation | None:
        """Condense what has left the window, if that is due; returns what has left the map.

        It waits until all is judged, solved and explained, and nothing goes on that could change a verdict. A failure
        is counted, and changes nothing.
        """
        backend, keyframes = self._backend, self._frontend.path.keyframes
        if not (self._is_due and backend.is_quiet and self._doubt.now is None and self._solution.is_whole):
            return None
        if not self._landmarks.anonymous.may_forget_before(self._limit):
            self._tried = len(keyframes) + _AGAIN
            return None
        self._landmarks.map.withdraw_tentative(self._limit)
        places, scale = deepcopy((self.state.places, self.state.scale))
        self._tried = len(keyframes)
        condensed = backend.all_or_nothing(_SOURCE, self._condensed_visits)
        if condensed is None:
            self._tried += BATCH - 1  # the same would most likely fail at the next keyframe again
            self.state.places, self.state.scale = places, scale
            return None
        rows, end = condensed
        return self._compacted(rows, Left(self._left(rows), self._sightings(end)), end) if rows else None

    # -- visits ------------------------------------------------------------------------------------------------------

    def _condensed_visits(self) -> tuple[list[RemovedPose], int]:
        """Condense; returns what left, in order of time, and the first number that stays."""
        path, solver = self._frontend.path, self._backend.solver
        ids, first, width = path.keyframes.ids, path.keyframes.first, self._frontend.config.map.cell_m
        limit = self._limit - first
        at, rows = solver.estimate(ids), list[RemovedPose]()
        begins = [*(begin - first for begin in sorted(path.segments) if begin > first), len(ids)]
        cells = list(map(tuple, np.floor(at[:, : self._space.dimensions] / width).astype(np.int64).tolist()))
        marks, k, room = seen_from(self._space, solver, ids), 0, _VISITS if limit < _BACKLOG else limit
        while k < limit and room:
            longest = min(k + BATCH, begins[bisect_right(begins, k)])  # a visit is of one segment
            end = k + _length(marks[k:longest], cells[k:longest])
            if max(end, k + 1) > limit:
                break
            if end == k:  # it has an edge that cannot be condensed
                rows.append(self._staying_keyframe(int(ids[k])))
                self._counters.count(_SOURCE, "held_keyframe" if solver.is_held(int(ids[k])) else "not_condensed")
                k += 1
                continue
            visit = ids[k:end].tolist()
            waits = limit - end < BATCH
            ahead = set[int]().union(*(some or () for some in marks[end : begins[bisect_right(begins, end)]]))
            done = self.condenser.condense(visit, int(ids[end]), cells[k], ahead, waits=waits)
            if done.how == "waits":
                break
            self._note_end(done, end - k)
            removed = {one.vertex: one for one in done.removed}
            rows += [removed.get(vertex) or self._staying_keyframe(vertex) for vertex in visit]
            k, room = end, room - 1
        self.condenser.rescale()
        self._solution.guard.checked(solver.update)
        self._backend.note_condensed()
        return rows, first + k

    def _note_end(self, done: Condensed, keyframes: int) -> None:
        """Count how a visit of so many keyframes ended."""
        if done.wider > 1.0:
            self._counters.count(_SOURCE, "visit_wider")
        if done.how == "kept":
            self._counters.count(_SOURCE, "not_condensed", keyframes)
        else:
            self._counters.count(_SOURCE, "visit_lost" if done.is_contradiction else "visit_condensed")

    def _staying_keyframe(self, vertex: int) -> RemovedPose:
        """Return a keyframe that is its own base."""
        return RemovedPose(vertex, vertex, self._space.identity)

    def _left(self, rows: Sequence[RemovedPose]) -> Records:
        """Return the records of the keyframes that leave."""
        keyframes = self._frontend.path.keyframes
        left = np.zeros(len(rows), dtype=record_type(self._space))
        for k, row in enumerate(rows):
            one = keyframes[keyframes.first + k]
            left[k] = one.stamp_ns, row.vertex, row.base, row.T_base_vertex, one.T_odom_base
        return left

    # -- compaction --------------------------------------------------------------------------------------------------

    def _compacted(self, rows: Sequence[RemovedPose], left: Left, end: int) -> Condensation:
        """Remove what has left from the graph, and let all parts forget it."""
        keyframes = self._frontend.path.keyframes
        for k, row in enumerate(rows):
            if row.base == row.vertex:
                self.state.old[keyframes.first + k] = keyframes[keyframes.first + k]
        before = self.state.sightings
        vertices, edges = self._staying(int(keyframes.ids[end - keyframes.first]))
        gone = np.setdiff1d(self._backend.graph.edge_ids.since(), edges)
        archive = archived(self._backend, keyframes, gone, self._landmarks.map.names())
        out = Condensation(left, keyframes.first, before, archive)
        self._backend.keep(vertices, edges)
        self._frontend.forget_before(end)
        self.condenser.forget_removed()
        for drive in self._frontend.path.drives:
            if out.first <= drive < end:
                self.state.begins[drive] = before + int(np.sum(left.sightings["of"] < drive))
        self.state.keyframes, self.state.sightings = end, before + len(left.sightings)
        self._note_accepted(out.edges)
        self._landmarks.forget_before(end)
        self._anchor.restore()
        self._doubt.forget_before(int(self._frontend.path.keyframes.ids[0]))
        self._solution.solve_rest()
        return out

    def _note_accepted(self, edges: Sequence[CondensedEdge]) -> None:
        """Count the accepted measurements among edges that leave."""
        drives = self._frontend.path.drives
        for one in edges:
            if one.became == CONDENSED and one.label in CANDIDATES:
                drive = drives[max(bisect_right(drives, one.keyframe) - 1, 0)]
                self.state.accepted.setdefault(drive, Counter())[one.source] += 1

    def _staying(self, window: int) -> tuple[Index, Index]:
        """The vertices and edges that stay; ``window`` is the first keyframe of the window, by its vertex.

        Edges stay that count, and those of the window that may count again; all of a frozen or held map do, but for
        those in whose place another has come.
        """
        backend, graph = self._backend, self._backend.graph
        every = graph.vertex_ids.since()
        vertices = np.union1d(backend.solver.vertices, every[every < max(backend.frozen, backend.held[0])])
        staying = [np.empty(0, dtype=np.int64)]
        for table in graph.tables.values():
            ids, ends = table.ids, table.vertices
            is_kept = np.isin(ends, vertices)
            is_young = ((ends >= window) & is_kept).any(axis=1)
            is_edge = is_kept.all(axis=1) & ((table.weight.values > 0.0) | is_young)
            is_superseded = (table.weight.values == 0.0) & graph.has_label(ids, _SUMMED)
            staying.append(ids[is_edge | ((ids < backend.first_free_edge) & ~is_superseded)])
        return vertices, np.sort(np.concatenate(staying))

    def _sightings(self, end: int) -> Records:
        """Records of the poses at which something was seen from the keyframes that leave."""
        keyframes, poses = self._frontend.path.keyframes, self._frontend.sighting_poses
        rows = np.flatnonzero(poses.ids < end)
        out = np.zeros(len(rows), dtype=record_type(self._space))
        out["stamp_ns"], out["of"], out["base"] = poses.stamps_ns[rows], poses.ids[rows], poses.ids[rows]
        out["T_base"] = poses.poses[rows]
        odom = keyframes.poses[poses.ids[rows] - keyframes.first]
        if len(rows):
            out["T_odom"] = np.stack(self._space.group.compose(tuple(odom.T), tuple(poses.poses[rows].T)), axis=-1)
        return out


def _length(marks: Sequence[set[int] | None], cells: Sequence[Cell]) -> int:
    """The number of keyframes, from the first of some on, that are one visit.

    They can be condensed, and they are in one cell, or go on in the next until they have seen enough for a place.

    Parameters
    ----------
    marks : the landmarks that are seen from each, or None where it cannot be condensed
    """
    seen = set[int]()
    for k, (some, cell) in enumerate(zip(marks, cells, strict=True)):
        if some is None or (cell != cells[0] and len(seen) >= ENOUGH):
            return k
        seen |= some
    return len(marks)


def archived(
    backend: Backend, keyframes: StampedPoses[Keyframe], edges: Index, names: Mapping[int, str]
) -> tuple[CondensedEdge, ...]:
    """Return what is known of edges that are about to leave, without those that condensing itself has made.

    Parameters
    ----------
    names : of landmarks, by their vertices
    """
    graph, ledger, out = backend.graph, backend.ledger, []
    for number in edges.tolist():
        edge = graph.edge(number)
        if edge.label in (PLACES, CHAIN):
            continue
        newest = np.searchsorted(keyframes.ids, edge.vertices, side="right").max() - 1  # landmarks came after it
        verdict, row = ledger.verdict_of(number), ledger.ids.row(number)
        is_in = verdict in INSIDE or verdict is Verdict.NOT_EVALUATED
        out.append(
            CondensedEdge(
                number,
                edge.label,
                edge.source,
                next((names[vertex] for vertex in edge.vertices if vertex in names), ""),
                ledger.keyframe.values.item(row),
                int(keyframes.stamps_ns[max(newest, 0)]),
                ledger.statistic.values.item(row),
                ledger.numbers.values.item(row),
                ledger.threshold.values.item(row),
                verdict,
                Reason(ledger.reason.values.item(row)),
                CONDENSED if is_in else EXPIRED,
            )
        )
    return tuple(out)
