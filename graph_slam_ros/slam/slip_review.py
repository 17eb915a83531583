"""Slips, and their review after everything was solved: one that all measurements together contradict is taken back."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.odometry_edges import restore_odometry
from graph_slam_ros.slam.robust.ledger import Reason, Verdict
from graph_slam_ros.slam.robust.odometry_errors import odometry_errors
from graph_slam_ros.typing import Array, Index

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Slip:
    """A stretch of odometry in which its errors are larger than its noise.

    Attributes
    ----------
    kind : ``translation`` or ``rotation``
    began_ns, decided_ns, ended_ns : stamps of odometry; the last is None while it goes on
    evidence : twice the logarithm of the likelihood ratio of slip to no slip
    landmarks : the number of landmarks, and of other classes of edges, that contradict odometry
    edges : the number of odometry edges that were replaced
    outcome : why it was taken back; empty if it was not
    segment : always None, because no new segment begins
    """

    kind: str
    began_ns: int
    decided_ns: int
    evidence: float
    landmarks: int
    edges: int = 0
    ended_ns: int | None = None
    outcome: str = ""
    segment: None = None

    def __str__(self) -> str:
        since = f"{self.began_ns * 1e-9:.1f} s"
        why = f"{self.landmarks} landmarks or other inputs contradict it, evidence {self.evidence:.0f}"
        if self.ended_ns is None:
            return f"odometry in doubt since {since}: its {self.kind} is wrong ({why}); it counts for less"
        until = f"{self.ended_ns * 1e-9:.1f} s"
        outcome = self.outcome or f"{self.edges} edges of odometry count for less"
        return f"odometry was in doubt from {since} to {until}: its {self.kind} was wrong ({why}); {outcome}"


@dataclass(slots=True)
class Link:
    """An odometry edge of the problem: the original ``own``, or ``edge`` that replaces it."""

    edge: int
    own: int
    vertices: tuple[int, int]
    stamps_ns: tuple[int, int]

    @property
    def seconds(self) -> float:
        """The time that it took."""
        return (self.stamps_ns[1] - self.stamps_ns[0]) * 1e-9

    def renumbered(self, vertices: Index, edges: Index) -> "Link":
        """Return the same with new ids of vertices and edges, by old ones; -1: it was removed."""
        first, last = vertices[list(self.vertices)].tolist()
        return Link(int(edges[self.edge]), int(edges[self.own]), (first, last), self.stamps_ns)


@dataclass(slots=True)
class View:
    """The edges that were measured from one keyframe, their landmarks or classes, and the sum of their innovations."""

    vertex: int
    edges: list[int]
    seen: list[int | str]
    statistic: float = 0.0
    numbers: int = 0

    def renumbered(self, vertices: Index, edges: Index) -> "View":
        """Return the same with new ids of vertices and edges, by old ones; what was removed is not in it any more."""
        both = [
            (int(edges[edge]), what if isinstance(what, str) else int(vertices[what]))
            for edge, what in zip(self.edges, self.seen, strict=True)
            if edges[edge] >= 0
        ]
        seen = [(edge, what) for edge, what in both if isinstance(what, str) or what >= 0]
        own, of = [edge for edge, _ in seen], [what for _, what in seen]
        return View(int(vertices[self.vertex]), own, of, self.statistic, self.numbers)


def revoke_slip(backend: Backend, pairs: Sequence[Pair], keyframe: int, noise_factor: float) -> bool:
    """Use odometry edges with their own noise again, if that is likelier given all measurements.

    Returns whether that was done. What cannot be computed leaves all as it is.

    Parameters
    ----------
    pairs : of an edge and its replacement, a chain in order of time
    """
    ends = [backend.graph.edge(own).vertices for own, _ in pairs]
    if not pairs or any(a[1] != b[0] for a, b in pairwise(ends)):
        return False
    try:
        errors = odometry_errors(backend.graph, backend.solver, [edge for _, edge in pairs], noise_factor)
        own = covariance_of(backend.graph, [own for own, _ in pairs], 0, errors.covariance)
        gain = errors.log_ratio_of(own)
    except (GraphSlamError, np.linalg.LinAlgError):
        return False
    if gain <= 0.0:
        return False
    restore_odometry(backend, pairs, keyframe, -2.0 * gain)
    return True


def slipped_pairs(
    backend: Backend, keyframes: StampedPoses[Keyframe], began_ns: int, ended_ns: int | None
) -> list[Pair]:
    """Odometry edges of a stretch that count as slip, each with its replacement, in order of time."""
    graph, ledger = backend.graph, backend.ledger
    edges = [edge for edge in graph.edges_of("odometry").tolist() if edge < len(ledger)]
    used, out = dict[tuple[int, ...], int](), list[tuple[int, Pair]]()
    for edge in edges:
        if ledger.verdict_of(edge) is not Verdict.REJECTED:
            used[tuple(graph.edge(edge).vertices)] = edge
    for edge in edges:
        ends = tuple(graph.edge(edge).vertices)
        if edge < max(backend.frozen_edges, backend.held[1]) or ends not in used:
            continue
        stamp_ns = int(keyframes.stamps_ns[np.searchsorted(keyframes.ids, ends[0])])
        is_inside = began_ns <= stamp_ns and (ended_ns is None or stamp_ns < ended_ns)
        if is_inside and ledger.is_withdrawn(edge) and ledger.reason.values[edge] == Reason.SLIP:
            out.append((ends[0], (edge, used[ends])))
    return [pair for _, pair in sorted(out)]


def covariance_of(graph: Graph, edges: Sequence[int], first: int, covariance: Array) -> Array:
    """A covariance of the noise of a chain, with the noise of these edges from one of them on, by its place."""
    dof, out = len(covariance) // len(edges), covariance.copy()
    for k, edge in enumerate(edges[first:], start=first):
        rows, root = slice(k * dof, (k + 1) * dof), graph.edge(edge).sqrt_information
        out[rows, rows] = np.linalg.inv(root.T @ root)
    return out
