"""Edges that left the map, with the decisions on them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.lifelong.surroundings import CHAIN
from graph_slam_ros.slam.robust.ledger import INSIDE, Reason, Verdict
from graph_slam_ros.typing import Index

CONDENSED, EXPIRED = "condensed", "expired"


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


def archived(
    backend: Backend, keyframes: StampedPoses[Keyframe], edges: Index, names: Mapping[int, str]
) -> tuple[CondensedEdge, ...]:
    """Return what is known of edges that are about to leave, without those that condensing itself has made.

    Parameters
    ----------
    names : of landmarks, by their vertices
    """
    graph, ledger, out = backend.graph, backend.ledger, []
    edges = edges[~graph.has_label(edges, (PLACES, CHAIN))]
    labels, sources, newest = (np.zeros(len(edges), dtype=np.int64) for _ in range(3))
    landmarks = [""] * len(edges)
    for code, table in enumerate(graph.tables.values()):
        at = np.flatnonzero(graph.table_of_edge.values[edges] == code)
        rows = graph.row_of_edge.values[edges[at]]
        ends = table.vertices.values[rows]
        labels[at], sources[at] = table.label.values[rows], table.source.values[rows]
        newest[at] = np.searchsorted(keyframes.ids, ends, side="right").max(axis=1) - 1  # landmarks came after it
        for k, vertices in zip(at.tolist(), ends.tolist(), strict=True):
            landmarks[k] = next((names[v] for v in vertices if v in names), "")
    columns = ledger.keyframe, ledger.statistic, ledger.numbers, ledger.threshold, ledger.verdict, ledger.reason
    judged = zip(*(column.values[edges].tolist() for column in columns), strict=True)
    stamps_ns = keyframes.stamps_ns[np.maximum(newest, 0)].tolist()
    of_graph = zip(graph.edge_ids.of_all(edges).tolist(), labels.tolist(), sources.tolist(), landmarks, strict=True)
    for (number, label, source, landmark), stamp_ns, one in zip(of_graph, stamps_ns, judged, strict=True):
        keyframe, statistic, dof, threshold, code_of_verdict, reason = one
        verdict = Verdict(code_of_verdict)
        is_in = verdict in INSIDE or verdict is Verdict.NOT_EVALUATED
        out.append(
            CondensedEdge(
                number,
                graph.labels[label],
                graph.sources[source],
                landmark,
                keyframe,
                stamp_ns,
                statistic,
                dof,
                threshold,
                verdict,
                Reason(reason),
                CONDENSED if is_in else EXPIRED,
            )
        )
    return tuple(out)
