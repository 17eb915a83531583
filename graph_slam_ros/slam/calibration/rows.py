"""A graph's edges at an estimate as whitened rows, with columns for parameters.

Each sighting is seen from a pose of its own, which is no unknown: it lies on the path at the stamp plus the clock's
correction, between two keyframes whose steps move it. So a clock may be off by more than the time between keyframes.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from scipy import sparse

from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.calibration.model import Edges, MeasurementModel, Sightings, factors_of, groups_of, kind_of
from graph_slam_ros.slam.calibration.parameters import BEND, FACTORS, Parameter, Values, only_ranges, parameters_of
from graph_slam_ros.slam.calibration.path import EstimatedPath
from graph_slam_ros.slam.frontend.odometry_track import OdometryTrack
from graph_slam_ros.slam.frontend.sighting_edges import SightingEdges
from graph_slam_ros.solver import LossKey, Settings
from graph_slam_ros.solver.linearization import Block, Losses, linearize
from graph_slam_ros.typing import Array, Index

_LEAST_KEYFRAMES = 3  # fewer have no motion between motions
_PROBE = 1e-4  # step of a numerical derivative


@dataclass(frozen=True, slots=True)
class TrialProblem:
    """A graph to be fitted: copies that nothing else changes.

    Attributes
    ----------
    graph : its weights say what is believed
    vertices, held : of the problem, and those of them that stay where they are
    values : stored numbers of all vertices, where the fit begins
    origins : of its sightings
    keyframes, stamps_ns, segments : vertex and stamp of each keyframe, and where odometry does not lead to
    track : odometry between the keyframes
    first_edge : edges before are of a map that is held, and not corrected
    slips : of each stretch in which odometry counts for less, its edges, each with the one that replaces it
    is_noise_measured : as of ``MeasurementModel``
    """

    space: Geometry
    graph: Graph
    vertices: Index
    held: Index
    values: Array
    settings: Settings
    origins: SightingEdges
    keyframes: Index
    stamps_ns: Index
    segments: tuple[int, ...]
    track: OdometryTrack
    first_edge: int
    slips: tuple[tuple[tuple[int, int], ...], ...] = ()
    is_noise_measured: bool = False

    def without_slips(self) -> "TrialProblem":
        """The same with odometry as it was stated, in a copy of the graph."""
        graph, pairs = self.graph.copy(), np.array([pair for slip in self.slips for pair in slip], dtype=np.int64)
        graph.set_weights(pairs[:, 0], 1.0)
        graph.set_weights(pairs[:, 1], 0.0)
        return replace(self, graph=graph, slips=())

    @property
    def edges(self) -> range:
        """Edges whose measurements may be corrected."""
        return range(self.first_edge, self.graph.edge_ids.next)

    def model(self) -> MeasurementModel:
        """Its measurements as functions of parameters."""
        of = self.space, self.graph, self.origins, self.keyframes, self.stamps_ns, self.edges
        return MeasurementModel(*of, is_noise_measured=self.is_noise_measured)

    def kinds(self) -> dict[str, set[str]]:
        """The kinds of edges of each input of landmarks."""
        found: dict[str, set[str]] = {}
        for table, label, source, _ in groups_of(self.graph, self.edges):
            if label == "landmarks":
                found.setdefault(source, set()).add(kind_of(table))
        return found

    def parameters(self, groups: Collection[str]) -> list[Parameter]:
        """The parameters of some groups that its edges depend on."""
        if len(self.keyframes) < _LEAST_KEYFRAMES:
            return []
        odometries = {source for _, label, source, _ in groups_of(self.graph, self.edges) if label == "odometry"}
        has_scale = bool(set(self.graph.labels) - {"anchor", "odometry", "landmarks"}) or len(self.held) > 1
        n = self.space.dimensions
        return parameters_of(odometries, self.kinds(), groups, dimensions=n, has_scale=has_scale)

    def places(self) -> list[Parameter]:
        """The place (x, y) on the robot of each sensor whose sightings have a direction."""
        seen = [source for source, kinds in self.kinds().items() if not only_ranges(kinds)]
        return [Parameter(source, axis) for source in seen for axis in ("x", "y")]

    def range_offsets(self) -> list[Parameter]:
        """The offset of the ranges of each sensor that measures bearings, too."""
        return [Parameter(s, "range_offset") for s, kinds in self.kinds().items() if "range and bearing" in kinds]

    def poses(self, x: Array, vertices: Index) -> Array:
        """The poses (n, size) of some vertices at stored values x."""
        return np.asarray(x[self.graph.begins(vertices)[:, None] + np.arange(self.space.pose.size)])


@dataclass(frozen=True, slots=True)
class Rows:
    """All whitened rows at an estimate.

    Attributes
    ----------
    jacobian, columns, residual : (r, unknowns), (r, p), (r,)
    landmark, stamp_ns, weight : (r,) landmark or -1, when, and the part of their weight that the loss leaves
    cost : (edges,) with the losses, and with the noise: minus twice the logarithm of the likelihood, but for a constant
    """

    jacobian: sparse.csr_matrix
    columns: Array
    residual: Array
    landmark: Index
    stamp_ns: Index
    weight: Array
    cost: Array


_COLUMNS = ("columns", "residual", "landmark", "stamp_ns", "weight", "cost")


class _Eyes:
    """The poses from which the sightings of one group were taken, as vertices of the copy.

    Attributes
    ----------
    ids : (n,) of these vertices
    first, second, fraction : (n,) vertices of the keyframes around, and how far each is from one to the other
    steps : (n, dof, p) how they move with each parameter
    """

    def __init__(self, problem: TrialProblem, edges: Sightings, count: int) -> None:
        self._p, self._edges = problem, edges
        self._own = edges.table.at(edges.rows).vertices[:, 0]
        start = np.tile(np.array(problem.space.identity), (len(self._own), 1))
        self.ids = problem.graph.add_vertices(problem.space.pose, start)
        edges.table.vertex_rows.values[edges.rows, 0] = problem.graph.vertex_ids.existing(self.ids)
        self.first, self.second, self.fraction = self._own, self._own, np.zeros(len(self._own))
        self.steps = np.zeros((len(self._own), problem.space.dof, count))
        self._weight = edges.table.weight.values[edges.rows].copy()

    def place(self, x: Array, values: Values, model: MeasurementModel, path: EstimatedPath) -> None:
        """Move these edges along the path to corrected stamps, or by odometry from keyframes. It changes ``x``."""
        edges, p, group = self._edges, self._p, self._p.space.group
        at = p.graph.begins(self.ids)[:, None] + np.arange(p.space.pose.size)
        self.first, self.second, self.fraction = self._own.copy(), self._own.copy(), np.zeros(len(self._own))
        self.steps[:] = 0.0
        known = np.zeros(len(self._own), dtype=bool)
        if (clock := Parameter(edges.source, "clock")) in values:
            after_s = values[clock]
            known = path.knows(edges.stamps_ns, abs(after_s))
            before, self.fraction[known], x[at[known]] = path.at(edges.stamps_ns[known], after_s)
            self.first[known] = p.keyframes[before]
            self.second[known] = p.keyframes[np.minimum(before + 1, len(p.keyframes) - 1)]
            self.steps[known, :, list(values).index(clock)] = path.velocity(edges.stamps_ns[known], after_s)
            # Where the path is not known, a sighting that is not brought to its time would contradict the others.
            edges.table.weight.values[edges.rows] = np.where(known | (after_s == 0.0), self._weight, 0.0)
        if known.all():
            return
        moved = tuple(edges.T_keyframe_base[~known].T)
        for k, one in enumerate(values):
            if one.name in (*FACTORS, BEND):
                sides = [model.scaled(moved, there) for there in _beside(values, one)]
                self.steps[~known, :, k] = np.stack(group.local(*sides), axis=-1) / (2.0 * _PROBE)
        own = tuple(p.poses(x, self._own[~known]).T)
        x[at[~known]] = np.stack(group.compose(own, model.scaled(moved, values)), axis=-1)


class Linearization:
    """Linearises a problem at any estimate and parameters.

    Parameters
    ----------
    free : (vertices,) the unknowns, in this order in the columns of the Jacobian
    """

    def __init__(self, problem: TrialProblem, parameters: tuple[Parameter, ...], free: Index) -> None:
        self._p, self._parameters = problem, parameters
        graph = problem.graph
        self._edges = _weighted_edges(problem)
        self._model = problem.model()
        self._known = graph.vertex_ids.next
        self._eyes = [_Eyes(problem, edges, len(parameters)) for edges in self._model.sightings]
        self.column = np.full(graph.vertex_ids.next, -1)
        dof = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)[graph.kind_codes(free)]
        self.column[free] = np.cumsum(dof) - dof
        self.unknowns = int(dof.sum())
        self._stamp_of = np.zeros(graph.vertex_ids.next, dtype=np.int64)
        self._stamp_of[problem.keyframes] = problem.stamps_ns
        for eyes, edges in zip(self._eyes, self._model.sightings, strict=True):
            self._stamp_of[eyes.ids] = edges.stamps_ns
        tables = graph.tables.values()  # how likely what odometry measured is does not change with its factors
        self._path = EstimatedPath(problem.space, problem.stamps_ns, problem.segments, problem.track)
        self._log_roots = {one.code: np.linalg.slogdet(one.sqrt_information.values)[1] for one in tables}

    def rows(self, x: Array, theta: Array, losses: Mapping[LossKey, Loss]) -> Rows:
        """The rows at stored values x of the vertices, and corrections theta (p,)."""
        graph = self._p.graph
        values = dict(zip(self._parameters, theta.tolist(), strict=True))
        all_x = np.concatenate((x, graph.initial.values[len(x) :]))
        self._path.poses, track = self._p.poses(x, self._p.keyframes), self._p.track
        distance, turn = factors_of(values)
        self._path.factors = track.distance * distance, track.turn * turn
        for eyes in self._eyes:
            eyes.place(all_x, values, self._model, self._path)
        derivative = self._correct(all_x, values)
        blocks = linearize(graph, all_x, graph.by_table(self._edges), Losses(graph, losses))
        parts = [self._of_block(block, derivative, all_x) for block in _by_table(blocks)]
        return Rows(
            sparse.vstack([part.jacobian for part in parts], format="csr"),
            *(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS),
        )

    # -- measurements ----------------------------------------------------------------------------------------------

    def _correct(self, x: Array, values: Values) -> dict[tuple[int, int], Array]:
        """Correct the measurements of the copy; returns derivatives of whitened residuals, by table and parameter."""
        out: dict[tuple[int, int], Array] = {}
        concerned: list[Edges] = [*self._model.odometry, *self._model.sightings]
        for edges in concerned:
            for k, parameter in enumerate(values):
                if parameter.source == edges.source and parameter.name != "clock":
                    key = edges.table.code, k
                    out.setdefault(key, np.zeros((len(edges.table), edges.table.type.residual_size)))
                    out[key][edges.rows] = self._derivative(edges, parameter, values, x)
            edges.table.measured.values[edges.rows] = self._model.measured(edges, values)
            edges.table.sqrt_information.values[edges.rows] = self._model.roots(edges, values)
        return out

    def _derivative(self, edges: Edges, parameter: Parameter, values: Values, x: Array) -> Array:
        """Central difference of the whitened residuals (n, m) with respect to one parameter.

        The noise of a position is turned with the sensor. Without that part, errors along and across the line of sight
        that go together would pass for a turned sensor.
        """
        at, model = self._p.graph.begins(edges.table.at(edges.rows).vertices), self._model
        beside = _beside(values, parameter)
        sides = [edges.table.type.linearize(x, at, model.measured(edges, there))[0] for there in beside]
        sides[0] -= 2.0 * np.pi * np.round((sides[0] - sides[1]) / (2.0 * np.pi))  # of an angle
        plus, minus = (
            np.einsum("nij,nj->ni", model.roots(edges, there), side) for there, side in zip(beside, sides, strict=True)
        )
        return np.asarray((plus - minus) / (2.0 * _PROBE))

    # -- blocks to rows --------------------------------------------------------------------------------------------

    def _of_block(self, block: Block, derivative: Mapping[tuple[int, int], Array], x: Array) -> Rows:
        table, rows = block.table, block.rows
        n, m, _ = block.jacobian.shape
        norm = np.sum(block.residual**2, axis=1)
        slope = np.where(block.chi2 > 1e-12, norm / np.maximum(block.chi2, 1e-12), 1.0)
        kept = np.sqrt(slope * table.weight.values[rows])[:, None]
        columns = np.zeros((n, m, len(self._parameters)))
        for (code, k), of_table in derivative.items():
            if code == table.code:
                columns[:, :, k] = kept * of_table[rows]
        ends, jacobian, dofs = table.at(rows).vertices, block.jacobian, table.type.dofs
        is_seen, stamps, landmark = ends[:, 0] >= self._known, self._stamp_of[ends[:, 0]], np.full(n, -1)
        if is_seen.any():
            ends, jacobian = self._through_eyes(ends, jacobian, columns, x)
            dofs, landmark = (dofs[0], *dofs), np.where(is_seen, ends[:, 2], -1)
        each = [np.repeat(one, m) for one in (landmark, stamps, slope)]
        each.append(block.cost - 2.0 * self._log_roots[table.code][rows])
        here = self._sparse(ends, jacobian, dofs), columns.reshape(n * m, -1), block.residual.ravel()
        return Rows(*here, *each)

    def _sparse(self, ends: Index, jacobian: Array, dofs: Sequence[int]) -> sparse.csr_matrix:
        n, m, width = jacobian.shape
        slots, within = np.repeat(np.arange(len(dofs)), dofs), np.concatenate([np.arange(d) for d in dofs])
        begin = self.column[ends][:, slots]
        column = np.where(begin >= 0, begin + within, -1)[:, None, :].repeat(m, axis=1)
        row = np.arange(n * m).reshape(n, m, 1).repeat(width, axis=2)
        free = column >= 0
        return sparse.csr_matrix((jacobian[free], (row[free], column[free])), shape=(n * m, self.unknowns))

    def _through_eyes(self, ends: Index, jacobian: Array, columns: Array, x: Array) -> tuple[Index, Array]:
        """Ends and Jacobians with the two neighbouring keyframes instead of the pose between them.

        For ``X = A Exp(f Log(A^-1 B))``, a step of X is that of A times 1 - f plus that of B times f, each in the frame
        of X, to first order in the motion from A to B.
        """
        space, begins, size = self._p.space, self._p.graph.begins, np.arange(self._p.space.pose.size)
        dof = space.dof
        first, second, fraction = ends[:, 0].copy(), ends[:, 0].copy(), np.zeros(len(ends))
        for eyes in self._eyes:
            at = ends[:, 0] - eyes.ids[0] if len(eyes.ids) else np.full(len(ends), -1)
            mine = (at >= 0) & (at < len(eyes.ids))
            k = at[mine]
            first[mine], second[mine], fraction[mine] = eyes.first[k], eyes.second[k], eyes.fraction[k]
            columns[mine] += np.einsum("nij,njk->nik", jacobian[mine, :, :dof], eyes.steps[k])
        here = tuple(x[begins(ends[:, 0])[:, None] + size].T)
        parts = []
        for keyframe, part in ((first, 1.0 - fraction), (second, fraction)):
            seen = space.group.between(here, tuple(x[begins(keyframe)[:, None] + size].T))
            parts.append(part[:, None, None] * (jacobian[:, :, :dof] @ _adjoints(space, seen)))
        return np.column_stack((first, second, ends[:, 1:])), np.concatenate((*parts, jacobian[:, :, dof:]), axis=2)


def _beside(values: Values, parameter: Parameter) -> tuple[Values, Values]:
    """The same values with one a little larger, and smaller."""
    plus, minus = (values.get(parameter, 0.0) + side for side in (_PROBE, -_PROBE))
    return {**values, parameter: plus}, {**values, parameter: minus}


def _adjoints(space: Geometry, poses: Any) -> Array:
    """Adjoint matrices (n, dof, dof) of poses that are arrays."""
    group, back = space.group, space.group.inverse(poses)
    columns = []
    for probe in np.eye(space.dof):
        step = group.exp(tuple(1e-6 * probe))
        columns.append(np.stack(group.log(group.compose(group.compose(poses, step), back)), axis=-1) * 1e6)
    return np.stack(columns, axis=-1)


def _by_table(blocks: Iterable[Block]) -> Iterator[Block]:
    """Join the blocks of each table, which follow one another."""
    for table, some in groupby(blocks, key=attrgetter("table")):
        columns = zip(*((one.rows, one.residual, one.jacobian, one.chi2, one.cost) for one in some), strict=True)
        yield Block(table, *map(np.concatenate, columns))


def _weighted_edges(problem: TrialProblem) -> Index:
    graph = problem.graph
    inside = np.zeros(graph.vertex_ids.next, dtype=bool)
    inside[problem.vertices] = True
    chosen = []
    for table in graph.tables.values():
        fits = (table.weight.values > 0.0) & inside[table.vertices].all(axis=1)
        chosen.append(table.ids[fits])
    return np.sort(np.concatenate(chosen))
