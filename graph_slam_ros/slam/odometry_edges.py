"""Replacement of odometry edges by edges with more noise, and its undo. The ledger has both edges."""

from collections.abc import Sequence

from graph_slam_ros.graph import Gaussian
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.robust.ledger import Reason, Verdict


def replace_odometry(
    backend: Backend, links: Sequence[int], noises: Sequence[Gaussian], keyframe: int, evidence: float, threshold: float
) -> list[int]:
    """Replace odometry edges by edges with other noise. Returns the new edges.

    Parameters
    ----------
    evidence, threshold : the statistic of the decision, and its threshold
    """
    graph, ledger, new = backend.graph, backend.ledger, []
    for link, noise in zip(links, noises, strict=True):
        old = graph.edge(link)
        new.append(graph.add_edge(old.type, old.vertices, old.measured, noise, "odometry", old.source))
    backend.gate_new(keyframe)
    for link in links:
        backend.decisions.decide(link, keyframe, Verdict.REJECTED, Reason.SLIP, evidence, threshold)
        ledger.threshold.values[link] = threshold
    backend.cancel_search()
    return new


def restore_odometry(backend: Backend, pairs: Sequence[tuple[int, int]], keyframe: int, evidence: float) -> None:
    """Undo ``replace_odometry`` for pairs of an edge and its replacement."""
    for link, replacement in pairs:
        backend.decisions.withdraw([replacement], keyframe, Reason.REVOKED)
        backend.ledger.threshold.values[link] = backend.ledger.threshold.values[replacement]
        backend.decisions.decide(link, keyframe, Verdict.NOT_EVALUATED, Reason.NONE, evidence)
    backend.cancel_search()
    backend.solver.update()
