"""The scale of configured noise, estimated from residuals: by class of edges, input and direction.

Variances of a group of residuals are multiplied by chi2 per degree of freedom, where the degrees of freedom are the
number of residuals less the trace of the hat matrix (Hoaglin, Welsch, "The hat matrix in regression and ANOVA", 1978).
Repeated until nothing changes, that is the restricted maximum-likelihood estimate of variance components (Patterson,
Thompson, "Recovery of inter-block information when block sizes are unequal", 1971).

Errors within one pass by a landmark are alike: a bias of the range is the same in all of them. They are worth less than
independent ones. The variance of a sighting is therefore multiplied by the design effect of cluster samples, too (Kish,
"Survey sampling", 1965): the variance of a pass's mean against that of independent errors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.losses import weight_and_cost
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.slam.frontend.noise_factors import Key, groups, parts_of
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import Losses
from graph_slam_ros.typing import Array, Index

PASS_ENDS_NS = 2_000_000_000  # a landmark that is not seen for so long is passed again
LEAST_IN_PASS, LEAST_PASSES = 3, 10
LEAST_DOF = 200.0  # of a group: below it says too little
MOST_OUTLIERS = 0.05
LEAST_WEIGHT = 0.1  # by the loss: an edge with less is an outlier
SMALLEST, LARGEST = 0.3, 3.0  # factor of a sigma
_MOST_SAMPLED = 200  # edges of a group whose leverage is computed: their joint covariances cost most of all


@dataclass(frozen=True, slots=True)
class NoiseScale:
    """The scale of the sigmas of a group of residuals.

    Attributes
    ----------
    label, source : class of edges and input
    part : of the residual: ``range`` (along the line of sight), ``bearing`` (across it), ``position``, ``rotation`` or
        ``all``
    edges : number of edges
    dof : degrees of freedom: numbers measured, less the unknowns that they determine themselves
    per_dof : chi2 per degree of freedom with the configured noise
    design_effect : how alike errors of one pass by a landmark are: 1 for independent ones
    factor : what the configured sigmas should be multiplied by; where that is not known, what they are multiplied by
    reason : why it is not known; empty where it is
    """

    label: str
    source: str
    part: str
    edges: int
    dof: float
    per_dof: float
    design_effect: float
    factor: float
    reason: str = ""

    @property
    def key(self) -> Key:
        """The key of its group."""
        return self.label, self.source, self.part


@dataclass(slots=True)
class _Sums:
    """Sums over the tables of a group."""

    edges: int = 0
    residuals: float = 0.0
    leverage: float = 0.0
    chi2: float = 0.0
    outliers: int = 0
    passes: int = 0
    of_means: float = 0.0
    of_singles: float = 0.0


def estimate_noise(
    graph: Graph, solver: Solver, factors: Mapping[Key, float], stamp_of: Index, edges: range
) -> list[NoiseScale]:
    """Estimate the noise of each group of residuals at the solver's estimate.

    Parameters
    ----------
    factors : of the configured sigmas, that the graph's edges have now
    stamp_of : (vertices,) nanoseconds of each pose, 0 elsewhere
    edges : that are looked at, by their ids; the solver has them

    Raises
    ------
    GaugeError, SingularError
        As for ``Solver.joint_marginal``.
    """
    if not solver.is_current:
        solver.update()  # covariances are of all there is: so must be the values
    sums: dict[Key, _Sums] = {}
    values, losses = solver.values, Losses(graph, solver.settings.stages()[-1])
    for table, every, label, source in groups(graph, edges):
        rows = every[table.weight.values[every] > 0.0]
        if len(rows):
            block = _Block(table, rows, label, solver, values, losses)
            passes = _passes(block.ends, stamp_of) if label == "landmarks" else []
            for part, axes in parts_of(table.type, label, block.measured).items():
                key = (label, source, part)
                block.add_to(sums.setdefault(key, _Sums()), axes, factors.get(key, 1.0), passes)
    return [_scale(key, total, factors.get(key, 1.0)) for key, total in sums.items()]


class _Block:
    """Edges of one table, class and input at an estimate."""

    def __init__(
        self, table: EdgeTable, rows: Index, label: str, solver: Solver, values: Array, losses: Losses
    ) -> None:
        self.ends, self.measured = table.vertices.values[rows], table.measured.values[rows]
        offset, code = solver.graph.offset.values, int(losses.codes(table, rows[:1])[0])
        self.residual, jacobian = table.type.linearize(values, offset[self.ends], self.measured)
        roots = table.sqrt_information.values[rows]
        chi2 = np.sum(np.einsum("nij,nj->ni", roots, self.residual) ** 2, axis=1)
        self.weight = np.array([weight_and_cost(losses.kind[code], losses.scale[code], one)[0] for one in chi2])
        self.covariance = np.linalg.inv(np.swapaxes(roots, 1, 2) @ roots)
        self.sampled = np.arange(0, len(rows), max(1, -(-len(rows) // _MOST_SAMPLED)))
        joint = [solver.joint_marginal(self.ends[k]) for k in self.sampled]
        self.hat = np.stack([jacobian[k] @ cov @ jacobian[k].T for k, cov in zip(self.sampled, joint, strict=True)])

    def add_to(self, total: "_Sums", axes: Array, factor: float, passes: Sequence[Index]) -> None:
        """Add a part of the residuals: chi2 with the configured noise, the rest with the noise as it is scaled now."""
        own = np.swapaxes(axes, 1, 2) @ self.covariance @ axes
        along = np.swapaxes(axes, 1, 2) @ self.residual[:, :, None]
        white = np.linalg.solve(np.linalg.cholesky(own), along)[:, :, 0] * np.sqrt(self.weight)[:, None] * factor
        inner = np.swapaxes(axes[self.sampled], 1, 2) @ self.hat @ axes[self.sampled]
        share = np.trace(np.linalg.solve(own[self.sampled], inner), axis1=1, axis2=2) * self.weight[self.sampled]
        count = len(white)
        total.edges += count
        total.residuals += float(self.weight.sum()) * white.shape[1]
        total.leverage += float(share.mean()) * count
        total.chi2 += float(np.sum(white**2))
        total.outliers += int(np.count_nonzero(self.weight < LEAST_WEIGHT))
        total.passes += len(passes)
        for those in passes:
            total.of_means += len(those) * float(np.sum(white[those].mean(axis=0) ** 2))
            total.of_singles += float(np.mean(np.sum(white[those] ** 2, axis=1)))


def _passes(ends: Index, stamp_of: Index) -> list[Index]:
    """Sightings of each pass by a landmark, those of three or more."""
    stamps = stamp_of[ends[:, 0]]
    order = np.lexsort((stamps, ends[:, 1]))
    landmark, when = ends[order, 1], stamps[order]
    cuts = np.flatnonzero((np.diff(landmark) != 0) | (np.diff(when) > PASS_ENDS_NS)) + 1
    return [those for those in np.split(order, cuts) if len(those) >= LEAST_IN_PASS]


def _scale(key: Key, total: _Sums, factor_now: float) -> NoiseScale:
    dof = total.residuals - total.leverage
    per_dof = total.chi2 / dof if dof > 0.0 else float("nan")
    design_effect = 1.0
    if total.passes >= LEAST_PASSES and total.of_singles > 0.0:
        design_effect = max(1.0, total.of_means / total.of_singles)
    scale = NoiseScale(*key, total.edges, dof, per_dof, design_effect, factor_now)
    if dof < LEAST_DOF:
        return replace(scale, reason=f"{max(dof, 0.0):.0f} degrees of freedom, fewer than {LEAST_DOF:.0f}")
    if total.outliers > MOST_OUTLIERS * total.edges:
        return replace(scale, reason=f"{total.outliers / total.edges:.0%} outliers, more than {MOST_OUTLIERS:.0%}")
    factor = float(np.sqrt(per_dof * design_effect))
    if factor < 1.0 and key[0] == "landmarks" and total.passes < LEAST_PASSES:
        few = f"{total.passes} passes by landmarks, fewer than {LEAST_PASSES}: smaller sigmas are not believed"
        return replace(scale, reason=few)
    return replace(scale, factor=float(np.clip(factor, SMALLEST, LARGEST)))
