"""Edges that left the map, with the decisions on them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from graph_slam_ros.graph.place import LABEL as PLACES
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.lifelong.thinned import CHAIN
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
    ids, stamps_ns = keyframes.ids, keyframes.stamps_ns
    lasting = graph.edge_ids.of_all(edges).tolist()
    for edge, number in zip(edges.tolist(), lasting, strict=True):
        one, verdict = graph.edge(edge), Verdict(ledger.verdict.values.item(edge))
        newest = int(np.searchsorted(ids, one.vertices, side="right").max()) - 1  # landmarks came after it
        is_in = verdict in INSIDE or verdict is Verdict.NOT_EVALUATED
        out.append(
            CondensedEdge(
                number,
                one.label,
                one.source,
                next((names[v] for v in one.vertices if v in names), ""),
                ledger.keyframe.values.item(edge),
                int(stamps_ns[max(newest, 0)]),
                ledger.statistic.values.item(edge),
                ledger.numbers.values.item(edge),
                ledger.threshold.values.item(edge),
                verdict,
                Reason(ledger.reason.values.item(edge)),
                CONDENSED if is_in else EXPIRED,
            )
        )
    return tuple(out)
