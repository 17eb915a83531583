"""The scale of configured noise, estimated from residuals: by class of edges, input and direction.

Variances of a group of residuals are multiplied by chi2 per degree of freedom, where the degrees of freedom are the
number of residuals less the trace of the hat matrix (Hoaglin, Welsch, "The hat matrix in regression and ANOVA", 1978).
Repeated until nothing changes, that is the restricted maximum-likelihood estimate of variance components (Patterson,
Thompson, "Recovery of inter-block information when block sizes are unequal", 1971).

Errors within one pass by a landmark are alike: a bias of the range is the same in all of them. They are worth less than
independent ones. The variance of a sighting is therefore multiplied by the design effect of cluster samples, too (Kish,
"Survey sampling", 1965): the variance of a pass's mean against that of independent errors.

Errors of odometry may last, too, which edges cannot say. Errors of its rotation are therefore also summed over windows
of two seconds, as for an Allan variance. Where they add up to more than single errors say, the noise is that of the
sums. Sums of positions are not used: what the ranges of a pass have in common is also in them.

The variance of an edge of odometry is what is configured times a factor, plus a variance for each radian turned and
each metre driven: components of variance. They are estimated by expectation and maximisation (Dempster, Laird, Rubin,
"Maximum likelihood from incomplete data via the EM algorithm", 1977). The expected square of an error is that of its
residual plus the variance that all measurements together leave to it. The components are the regression of these
squares, none below zero. One that says little of its own noise hardly moves it, and rounds are few. That is wanted:
errors of a sensor that are alike within a pass look like those of odometry.
"""

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import nnls

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import PLANAR, SPATIAL
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.slam.levels import PRIOR_DOF, SINGULAR
from graph_slam_ros.slam.noise.factors import (
    CLASSES,
    PER_M,
    PER_RAD,
    Key,
    components,
    groups,
    grown_with,
    grows,
    motion_parts,
    of_group,
    parts_of,
)
from graph_slam_ros.solver import Solver
from graph_slam_ros.solver.linearization import Losses, loss_weights
from graph_slam_ros.typing import Array, Index

ALIKE_NS = 2_000_000_000  # errors that are alike last less: a landmark not seen for so long is passed again
LEAST_IN_PASS, LEAST_PASSES = 3, 10  # sightings, and passes: of fewer no variance is told
LEAST_DOF = 200.0  # of a group: below it says too little
LEAST_DOF_OF_MOTION = PRIOR_DOF  # of odometry, whose estimate changes the less the less is known
MOST_OUTLIERS = 0.05  # part of a group: with more, its residuals are not those of noise
LEAST_WEIGHT = 0.1  # by the loss: an edge with less is an outlier
SMALLEST, LARGEST = 0.3, 3.0  # factor of a sigma; an error that is larger, squared, counts as its variance
_MOST_WINDOWS = 100  # the same of windows
_MOST_SAMPLED = 200  # edges of a group whose leverage is computed: their joint covariances cost most of all
CONFIGURED_COUNT = 50.0  # steps of odometry: its configured noise counts as that of so many
_ROUNDS = 4  # of the regression, each weighted by the variances of the last
_LEAST = 0.1  # factor of the configured sigma
_CONFIGURED = np.array([1.0, 0.0, 0.0])  # components of variance: what is configured, and nothing is added
_ONLY_LARGER = {
    "fixes": "errors of fixes that last leave no residuals",
    "closures": "closures that fit worst are not among the residuals",
}
"""Classes whose sigmas may be larger than configured and not smaller, and the reason."""


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
    per_rad, per_m : of odometry: the variance [m^2 or rad^2, summed over the directions of the part] that should be
        added for each radian turned and each metre driven; where that is not known, what is added
    per_s : of odometry: the rest of the variance, for each second
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
    per_rad: float = 0.0
    per_m: float = 0.0
    per_s: float = 0.0

    @property
    def key(self) -> Key:
        """The key of its group."""
        return self.label, self.source, self.part

    def as_dict(self) -> dict[str, Any]:
        """Plain values; a number that JSON has not is null."""
        return asdict(self) | {"per_dof": self.per_dof if math.isfinite(self.per_dof) else None}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "NoiseScale":
        """Read the values of ``as_dict``."""
        return cls(**{**values, "per_dof": math.nan if values["per_dof"] is None else values["per_dof"]})


def factors_of(scales: Sequence[NoiseScale]) -> dict[Key, float]:
    """The factors and added variances of the groups for which they are known."""
    out = dict[Key, float]()
    for one in scales:
        if not one.reason:
            out[one.key] = one.factor
            if one.label == "odometry":
                out[one.label, one.source, one.part + PER_RAD] = one.per_rad
                out[one.label, one.source, one.part + PER_M] = one.per_m
    return out


@dataclass(frozen=True, slots=True)
class _Errors:
    """Errors of a part of odometry, of edges or of windows.

    Attributes
    ----------
    motions : (n, 3) what the variance of each grows with: what is configured, radians turned and metres driven
    square : (n,) square of each residual, or sum of residuals
    left : (n,) the variance that all measurements together leave to its error
    count : number of edges or windows, of which these are a sample; what is configured counts as
        ``CONFIGURED_COUNT`` of them
    """

    motions: Array
    square: Array
    left: Array
    count: int

    def components(self, now: Array, *, is_rotation: bool) -> Array:
        """One step of expectation and maximisation of the components (3,), drawn to what is configured.

        Turning adds to a rotation; a position grows with the way alone.
        """
        motions, at = self.motions * [1.0, float(is_rotation), 1.0], self.motions @ now
        expected = np.minimum(self.square + self.left, LARGEST**2 * at)
        for _ in range(_ROUNDS):
            columns = motions / at[:, None]
            size = np.linalg.norm(columns, axis=0)
            size[size == 0.0] = 1.0
            now = _bounded(nnls(columns / size, expected / at)[0] / size, motions)
            at = self.motions @ now
        part = self.count / (self.count + CONFIGURED_COUNT)
        return part * now + (1.0 - part) * _CONFIGURED


def _bounded(components: Array, motions: Array) -> Array:
    """Components (3,) whose factor and added variance are within their limits."""
    own, added = motions.sum(axis=0)[0], float((motions[:, 1:] @ components[1:]).sum())
    share = min(1.0, LARGEST**2 * own / added) if added > 0.0 else 1.0
    return np.array([np.clip(components[0], _LEAST**2, LARGEST**2), *(share * components[1:])])


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
    own_per_s: float = 0.0  # of odometry: configured variance for each second
    errors: list[_Errors] = field(default_factory=list)


def estimate_noise(
    graph: Graph,
    solver: Solver,
    factors: Mapping[Key, float],
    stamp_of: Index,
    edges: range,
    labels: Container[str] = CLASSES,
) -> list[NoiseScale]:
    """Estimate the noise of each group of residuals at the solver's estimate.

    Parameters
    ----------
    factors : of the configured sigmas, that the graph's edges have now
    stamp_of : (vertices,) nanoseconds of each pose, 0 elsewhere
    edges : that are looked at, by their ids; the solver has them
    labels : the classes that are looked at

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
        if len(rows) and label in labels:
            block = _Block(table, rows, label, solver, values, losses)
            passes = _passes(block.ends, stamp_of) if label == "landmarks" else []
            does_grow = grows(table.type, label)
            of_type = table.type, block.measured
            parts = motion_parts(*of_type, block.roots) if does_grow else parts_of(*of_type)
            for part, axes in parts.items():
                total, now = sums.setdefault((label, source, part), _Sums()), of_group(factors, label, source)
                if does_grow:
                    block.add_odometry(total, axes, components(now, part), stamp_of, is_rotation=part == "rotation")
                else:
                    block.add_to(total, axes, now.get(part, 1.0), passes)
    scales = [_scale(key, total, factors.get(key, 1.0)) for key, total in sums.items()]
    return [_grown(one, sums[one.key], components(of_group(factors, *one.key[:2]), one.part)) for one in scales]


def _grown(one: NoiseScale, total: _Sums, now: Array) -> NoiseScale:
    """The scale of a part of odometry, with how it grows; any other is as it was."""
    if not total.errors:
        return one
    if not one.reason:
        every = total.errors[0].motions
        fits = [errors.components(now, is_rotation=one.part == "rotation") for errors in total.errors]
        now = max(fits, key=lambda fit: float((every @ fit).sum()))
    variance, per_rad, per_m = now.tolist()
    return replace(one, factor=variance**0.5, per_rad=per_rad, per_m=per_m, per_s=variance * total.own_per_s)


class _Block:
    """Edges of one table, class and input at an estimate."""

    def __init__(
        self, table: EdgeTable, rows: Index, label: str, solver: Solver, values: Array, losses: Losses
    ) -> None:
        self.ends, self.measured = table.at(rows).vertices, table.measured.values[rows]
        begins, code = solver.graph.begins(self.ends), int(losses.codes(table, rows[:1])[0])
        self.residual, self._jacobian = table.type.linearize(values, begins, self.measured)
        self.roots = roots = table.sqrt_information.values[rows]
        chi2 = np.sum(np.einsum("nij,nj->ni", roots, self.residual) ** 2, axis=1)
        self._solver, self._dof = solver, table.type.dofs[0]
        self.weight = loss_weights(int(losses.kind[code]), float(losses.scale[code]), chi2)
        self.covariance = np.linalg.inv(np.swapaxes(roots, 1, 2) @ roots)
        self.sampled = np.arange(0, len(rows), max(1, -(-len(rows) // _MOST_SAMPLED)))
        of = self._jacobian[self.sampled]
        self.hat = of @ solver.edge_marginals(self.ends[self.sampled]) @ np.swapaxes(of, 1, 2)

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
        if passes:
            sizes, ordered = np.array(list(map(len, passes))), white[np.concatenate(passes)]
            sums = np.add.reduceat(ordered, np.cumsum(sizes) - sizes)
            squares = np.add.reduceat(np.sum(ordered**2, axis=1), np.cumsum(sizes) - sizes)
            total.of_means += float(np.sum(np.sum(sums**2, axis=1) / sizes))
            total.of_singles += float(np.sum(squares / sizes))

    def add_odometry(self, total: "_Sums", axes: Array, now: Array, stamp_of: Index, *, is_rotation: bool) -> None:
        """Add a part of odometry's residuals, and how its noise grows."""
        count, kinds = len(self.residual), axes.shape[2]
        variance = np.einsum("nij,nik,nkj->n", axes, self.covariance, axes)
        square = np.sum(np.einsum("nij,ni->nj", axes, self.residual) ** 2, axis=1)
        known = np.einsum("nij,nik,nkj->n", axes[self.sampled], self.hat, axes[self.sampled])
        motions = grown_with(variance, self.measured, now)
        total.edges += count
        total.residuals += float(kinds * count)
        total.leverage += float((known / variance[self.sampled]).mean()) * kinds * count
        total.chi2 += kinds * float(np.sum(square / motions[:, 0]))
        seconds = float(np.sum(np.abs(np.diff(stamp_of[self.ends[:, :2]], axis=1)))) * 1e-9
        total.own_per_s = float(motions[:, 0].sum()) / max(1e-9, seconds)
        total.errors = [_Errors(motions[self.sampled], square[self.sampled], known, count)]
        if is_rotation:
            total.errors.append(self._turns(motions, stamp_of))

    def _turns(self, motions: Array, stamp_of: Index) -> _Errors:
        """Errors of rotation, summed over windows in the axes of the last pose of each."""
        every, dof = _windows(self.ends, stamp_of), self._dof
        space = PLANAR if dof == PLANAR.dof else SPATIAL
        n, axes, square, left = space.dimensions, np.eye(dof - space.dimensions), [], []
        sample = every[:: max(1, -(-len(every) // _MOST_WINDOWS))]
        for rows in sample:
            vertices = [self.ends[rows[0], 0], *self.ends[rows, 1]]
            turns = [space.turn(tuple(one)) for one in self._solver.estimate(vertices[1:])]
            residual, jacobian = np.zeros(len(axes)), np.zeros((len(axes), dof * len(vertices)))
            for k, (row, turn) in enumerate(zip(rows, turns, strict=True)):
                into = turns[-1].T @ turn if len(axes) == n else axes
                residual += into @ self.residual[row, n:]
                jacobian[:, dof * k : dof * (k + 2)] += into @ self._jacobian[row, n:]
            square.append(residual @ residual)
            left.append(np.trace(jacobian @ self._solver.joint_marginal(vertices) @ jacobian.T))
        summed = np.array([motions[rows].sum(axis=0) for rows in sample]).reshape(-1, 3)
        return _Errors(summed, np.array(square), np.array(left), len(every))


def _windows(ends: Index, stamp_of: Index) -> list[Index]:
    """Odometry's edges, one after another from pose to pose, in windows that end after two seconds."""
    order = np.argsort(stamp_of[ends[:, 0]], kind="stable")
    out, begin = [], 0
    for k in range(1, len(order) + 1):
        last = ends[order[k - 1], 1]
        is_over = stamp_of[last] - stamp_of[ends[order[begin], 0]] >= ALIKE_NS
        if is_over or k == len(order) or ends[order[k], 0] != last:
            out.append(order[begin:k])
            begin = k
    return out


def _passes(ends: Index, stamp_of: Index) -> list[Index]:
    """Sightings of each pass by a landmark, those of three or more."""
    stamps = stamp_of[ends[:, 0]]
    order = np.lexsort((stamps, ends[:, 1]))
    landmark, when = ends[order, 1], stamps[order]
    cuts = np.flatnonzero((np.diff(landmark) != 0) | (np.diff(when) > ALIKE_NS)) + 1
    return [those for those in np.split(order, cuts) if len(those) >= LEAST_IN_PASS]


def _scale(key: Key, total: _Sums, factor_now: float) -> NoiseScale:
    dof = max(total.residuals - total.leverage, 0.0)
    per_dof = total.chi2 / dof if dof > SINGULAR else float("nan")
    design_effect = 1.0
    if total.passes >= LEAST_PASSES and total.of_singles > 0.0:
        design_effect = max(1.0, total.of_means / total.of_singles)
    scale = NoiseScale(*key, total.edges, dof, per_dof, design_effect, factor_now)
    least = LEAST_DOF_OF_MOTION if total.errors else LEAST_DOF
    if dof < least:
        return replace(scale, reason=f"{dof:.0f} degrees of freedom, fewer than {least:.0f}")
    if total.outliers > MOST_OUTLIERS * total.edges:
        return replace(scale, reason=f"{total.outliers / total.edges:.0%} outliers, more than {MOST_OUTLIERS:.0%}")
    if total.errors:
        return scale
    factor = float(np.sqrt(per_dof * design_effect))
    if factor < 1.0 and key[0] in _ONLY_LARGER:
        return replace(scale, reason=f"{_ONLY_LARGER[key[0]]}: smaller sigmas are not believed")
    if factor < 1.0 and key[0] == "landmarks" and total.passes < LEAST_PASSES:
        few = f"{total.passes} passes by landmarks, fewer than {LEAST_PASSES}: smaller sigmas are not believed"
        return replace(scale, reason=few)
    return replace(scale, factor=float(np.clip(factor, SMALLEST, LARGEST)))
