"""The held-out likelihood of a run: how well sightings are predicted by an estimate that was made without them.

Stretches of the drive of two seconds are dealt to two halves by the hash of their time, so that they are the same ones
whatever the parameters are. Of two after one another each goes to another half: nothing is predicted from farther than
four seconds, where an uncertain heading would make it no linear problem any more. The sightings of one half are left
out, everything is solved, and they are predicted from what the other half and odometry say; then the other way round.
All sightings of a stretch are predicted together, and are then used for the prediction of the next stretch. So what
stretches have in common, as errors of landmarks, counts once, and the sum is the density of one half given the other::

    -log p = 1/2 r' S^-1 r + 1/2 log det(2 pi S),    S = J P J' + R

Here P is the joint covariance of the poses and landmarks of the stretch without its sightings, J their Jacobian and R
the noise of the sightings. What errors of a stretch have in common is that of the pose, which odometry carried there:
this determines the noise of odometry. What they do not have in common determines the noise of sightings. Single
sightings left out of a stretch would be predicted by their neighbours, and would say next to nothing of odometry. The
innovations of a filter say it as well, but those of the online estimate also have its errors of linearisation and of
landmarks seen for the first time. The logarithm of the density is a proper score: its expectation is best at the true
noise (Gneiting, Raftery, "Strictly proper scoring rules, prediction, and estimation", 2007), and as a sum of two
conditional densities it is a composite likelihood (Varin, Reid, Firth, "An overview of composite likelihood methods",
2011).

Each sighting, given those before it in its stretch, may be an outlier: then it is anywhere within 10 m or 10 rad. A
sighting that the pipeline refused has the score of an outlier.
"""

import hashlib
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import rows_of
from graph_slam_ros.typing import Array, Index

if TYPE_CHECKING:
    from graph_slam_ros.slam import GraphSlam

STRETCH_NS = 2_000_000_000
OUTLIERS = 0.01  # part of the sightings
OUTLIER_RANGE = 10.0  # of each number of an outlier [m, rad]
LEAST = 20  # sightings: fewer say nothing
_LEAST_WEIGHT = 0.1  # by the loss: a sighting with less is an outlier
_SIGHTINGS = "landmarks"


@dataclass(frozen=True, slots=True)
class HeldOut:
    """The score of left-out sightings that were predicted.

    Attributes
    ----------
    nats : sum of -log p over the sightings
    sightings : how many were predicted
    """

    nats: float
    sightings: int


def held_out(slam: "GraphSlam") -> HeldOut:
    """Return the held-out likelihood of the sightings of a finished run.

    Raises
    ------
    GraphSlamError
        It has too few sightings that others predict, or the estimate is not determined without a half of them.
    """
    origins = slam.sighting_origins
    found = predict(slam.graph, slam.solver, origins.edge, origins.stamp_ns)
    if found.sightings < LEAST:
        raise GraphSlamError(
            f"{found.sightings} sightings can be left out and predicted by others, fewer than {LEAST}: "
            "landmarks must be seen again after 2 s"
        )
    return found


def predict(graph: Graph, solver: Solver, edges: Index, stamps_ns: Index, outliers: float = OUTLIERS) -> HeldOut:
    """Predict sightings from the others, half by half.

    Parameters
    ----------
    solver : at the optimum of all
    edges, stamps_ns : (n,) sightings and when they were made
    outliers : the part of them that is expected to be outliers

    Raises
    ------
    GraphSlamError
        The estimate is not determined without a half of them.
    """
    of_label = graph.has_label(edges, (_SIGHTINGS,)) & (edges < graph.edge_count)
    edges, stretch = edges[of_label], stamps_ns[of_label] // STRETCH_NS
    fits = _fits(graph, solver, edges)
    half = np.array([_half(number) for number in stretch.tolist()], dtype=np.int64)
    nats, count = 0.0, 0
    for one in (0, 1):
        rest = _solved(graph, solver, edges[fits & (half != one)], edges)
        known = rest.knows(edges) & (half == one)
        refused = edges[known & ~fits]
        count += int(known.sum())
        for table, rows in rows_of(graph, refused).items():
            nats += len(rows) * _outlier_nats(table.type.residual_size, outliers)
        inside = np.flatnonzero(known & fits)
        for number in np.unique(stretch[inside]).tolist():
            some = edges[inside[stretch[inside] == number]]
            nats += rest.nats(some, outliers)
            rest.add(some)
    return HeldOut(nats, count)


def _half(stretch: int) -> int:
    """The half that a stretch of time belongs to: of two after one another, each to another."""
    pair, second = divmod(stretch, 2)
    return (hashlib.sha256(str(pair).encode()).digest()[0] + second) % 2


def _outlier_nats(size: int, outliers: float) -> float:
    return math.inf if outliers <= 0.0 else size * math.log(OUTLIER_RANGE) - math.log(outliers)


def _fits(graph: Graph, solver: Solver, edges: Index) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    """Find the sightings that are in the problem and are no outliers of its loss."""
    inside = np.isin(edges, solver.edges)
    for table, rows in rows_of(graph, edges[inside]).items():
        ids = table.at(rows).ids
        out = table.at(rows).weight <= 0.0
        for k, (edge, chi2) in enumerate(zip(ids.tolist(), solver.chi2_of(ids)[0].tolist(), strict=True)):
            loss = solver.settings.last_loss(graph.label_of(edge), graph.source_of(edge))
            out[k] |= weight_and_cost(loss.kind, loss.scale, chi2)[0] < _LEAST_WEIGHT
        inside[np.isin(edges, ids[out])] = False
    return inside


def _solved(graph: Graph, solver: Solver, kept: Index, sightings: Index) -> "_Rest":
    """Solve with some of the sightings alone, as Gaussian measurements. Landmarks that no edge is left of are out."""
    others = np.setdiff1d(solver.edges, sightings)
    edges = np.union1d(others, kept)
    on_some = np.concatenate([t.at(rows).vertices.ravel() for t, rows in rows_of(graph, edges).items()])
    of_sightings = [t.at(rows).vertices[:, 1:].ravel() for t, rows in rows_of(graph, sightings).items()]
    alone = np.setdiff1d(np.concatenate(of_sightings), on_some) if of_sightings else np.zeros(0, dtype=np.int64)
    losses = {k: v for k, v in solver.settings.losses.items() if (k if isinstance(k, str) else k[0]) != _SIGHTINGS}
    rest = Solver(graph, replace(solver.settings, losses=losses, tolerance=0.0, tolerance_sigmas=0.0))
    rest.start_at(solver.values)
    rest.add(np.setdiff1d(solver.vertices, alone), edges)
    for vertex in solver.held.tolist():
        rest.hold(vertex)
    rest.optimize()
    return _Rest(graph, rest)


class _Rest:
    """The estimate without some sightings, which it predicts."""

    def __init__(self, graph: Graph, solver: Solver) -> None:
        self._graph, self._solver, self._values = graph, solver, solver.values
        self._is_inside = np.zeros(graph.vertex_count, dtype=bool)
        self._is_inside[solver.vertices] = True

    def knows(self, edges: Index) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
        """Find the sightings of landmarks that it knows."""
        out = np.zeros(len(edges), dtype=bool)
        for table, rows in rows_of(self._graph, edges).items():
            inside = self._is_inside[table.at(rows).vertices].all(axis=1)
            out[np.isin(edges, table.at(rows[inside]).ids)] = True
        return out

    def add(self, edges: Index) -> None:
        """Use sightings that were predicted for the prediction of later ones."""
        self._solver.add([], edges)
        self._solver.update()
        self._values = self._solver.values

    def nats(self, edges: Index, outliers: float) -> float:
        """-log p of the sightings of a stretch together."""
        tables = rows_of(self._graph, edges)
        ends = [table.at(rows).vertices for table, rows in tables.items()]
        vertices = np.unique(np.concatenate([one.ravel() for one in ends]))
        dofs = np.array([self._graph.kind_of(vertex).dof for vertex in vertices.tolist()])
        first = np.cumsum(dofs) - dofs
        parts = [self._part(*one, vertices, first, int(dofs.sum())) for one in tables.items()]
        residual = np.concatenate([part[0].ravel() for part in parts])
        jacobian = np.concatenate([part[1].reshape(-1, int(dofs.sum())) for part in parts])
        cov = jacobian @ self._solver.joint_marginal(vertices) @ jacobian.T
        noise = [one for part in parts for one in part[2]]
        owner = np.repeat(np.arange(len(noise)), [len(one) for one in noise])
        return _conditional(residual, cov + block_diag(*noise), owner, outliers)

    def _part(
        self, table: EdgeTable, rows: Index, vertices: Index, first: Index, width: int
    ) -> tuple[Array, Array, Array]:
        """Residuals (n, m), Jacobians (n, m, width) and noise (n, m, m) of the edges of a table."""
        ends, measured = table.at(rows).vertices, table.at(rows).measured
        residual, by_end = table.type.linearize(self._values, self._graph.offset.values[ends], measured)
        jacobian: Array = np.zeros((*residual.shape, width))
        begin = 0
        for k, dof in enumerate(table.type.dofs):
            columns = first[np.searchsorted(vertices, ends[:, k])][:, None] + np.arange(dof)
            for row in range(residual.shape[1]):
                jacobian[np.arange(len(rows))[:, None], row, columns] = by_end[:, row, begin : begin + dof]
            begin += dof
        root = table.at(rows).sqrt_information
        return residual, jacobian, np.asarray(np.linalg.inv(np.swapaxes(root, 1, 2) @ root))


def _conditional(residual: Array, cov: Array, owner: Index, outliers: float) -> float:
    """-log p, where each sighting given those before it may be an outlier."""
    root = np.linalg.cholesky(cov)
    white = solve_triangular(root, residual, lower=True)
    rows = 0.5 * white**2 + np.log(np.diag(root)) + 0.5 * math.log(2.0 * math.pi)
    inlier = -np.bincount(owner, rows)
    if outliers <= 0.0:
        return float(-inlier.sum())
    outlier = np.array([-_outlier_nats(size, outliers) for size in np.bincount(owner).tolist()])
    return float(-np.logaddexp(inlier + math.log1p(-outliers), outlier).sum())
