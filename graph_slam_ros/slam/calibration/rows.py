"""A graph's edges at an estimate as whitened rows, with columns for parameters.

Each sighting is seen from a pose of its own, which is no unknown: it lies on the path at the stamp plus the clock's
correction, between two keyframes whose steps move it. So a clock may be off by more than the time between keyframes.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from scipy import sparse

from graph_slam_ros.graph import Graph, Loss
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.calibration.model import MeasurementModel, OdometryEdges, Sightings, Values, clock_of
from graph_slam_ros.slam.calibration.parameters import BEND, FACTORS, OF_ODOMETRY, Parameter
from graph_slam_ros.slam.calibration.path import EstimatedPath
from graph_slam_ros.slam.frontend.odometry_track import OdometryTrack
from graph_slam_ros.slam.frontend.sighting_edges import SightingEdges
from graph_slam_ros.solver import LossKey, Settings
from graph_slam_ros.solver.linearization import Block, Losses, linearize, rows_of
from graph_slam_ros.typing import Array, Index, Mask, Numbers


@dataclass(frozen=True, slots=True)
class TrialProblem:
    """A graph to be fitted: copies that nothing else changes.

    Attributes
    ----------
    graph : its measurements and ends of edges are overwritten; its weights say what is believed
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

    def model(self) -> MeasurementModel:
        """Its measurements as functions of parameters."""
        edges = range(self.first_edge, self.graph.edge_count)
        of = self.space, self.graph, self.origins, self.keyframes, self.stamps_ns, edges
        return MeasurementModel(*of, is_noise_measured=self.is_noise_measured)

    def path(self, x: Array, values: Values, like: EstimatedPath | None = None) -> EstimatedPath:
        """The path at stored values x and with other parameters.

        Parameters
        ----------
        like : another path of this problem, whose stamps are taken over
        """
        named, track = {p.name: value for p, value in values.items() if p.name in OF_ODOMETRY}, self.track
        distance, turn = (1.0 + named.get(name, 0.0) for name in ("distance", "turn"))
        track = replace(track, distance=track.distance * distance, turn=track.turn * turn)
        poses = self.poses(x, self.keyframes)
        if like is not None:
            return like.moved(poses, track)
        return EstimatedPath(self.space, self.stamps_ns, poses, self.segments, track)

    def poses(self, x: Array, vertices: Index) -> Array:
        """The poses (n, size) of some vertices at stored values x."""
        return np.asarray(x[self.graph.offset.values[vertices][:, None] + np.arange(self.space.pose.size)])


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
        self._own = edges.table.vertices.values[edges.rows, 0].copy()
        start = np.tile(np.array(problem.space.identity), (len(self._own), 1))
        self.ids = problem.graph.add_vertices(problem.space.pose, start)
        edges.table.vertices.values[edges.rows, 0] = self.ids
        self.first, self.second, self.fraction = self._own, self._own, np.zeros(len(self._own))
        self.steps = np.zeros((len(self._own), problem.space.dof, count))
        self._weight = edges.table.weight.values[edges.rows].copy()

    def place(
        self, x: Array, values: Values, model: MeasurementModel, path: EstimatedPath, parameters: tuple[Parameter, ...]
    ) -> None:
        """Move them to the path at the corrected stamps. It changes x."""
        edges, offset = self._edges, self._p.graph.offset.values
        at = offset[self.ids][:, None] + np.arange(self._p.space.pose.size)
        self.first, self.second, self.fraction = self._own.copy(), self._own.copy(), np.zeros(len(self._own))
        self.steps[:] = 0.0
        known = np.zeros(len(self._own), dtype=bool)
        if (clock := Parameter(edges.source, "clock")) in parameters:
            after_s = clock_of(values, edges.source)
            known = path.knows(edges.stamps_ns, abs(after_s))
            x[at[known]] = self._place_on_path(known, after_s, path, parameters.index(clock))
            # Where the path is not known, a sighting that is not brought to its time would contradict the others.
            edges.table.weight.values[edges.rows] = np.where(known | (after_s == 0.0), self._weight, 0.0)
        if not known.all():
            x[at[~known]] = self._place_by_odometry(~known, x, values, model, parameters)

    def _place_on_path(self, rows: Mask, after_s: float, path: EstimatedPath, clock: int) -> Array:
        """The poses of some on the path. It is as it is, whatever odometry says of it."""
        stamps_ns, keyframes = self._edges.stamps_ns[rows], self._p.keyframes
        there = path.at(stamps_ns, after_s)
        self.first[rows] = keyframes[there.first]
        self.second[rows] = keyframes[np.minimum(there.first + 1, len(keyframes) - 1)]
        self.fraction[rows] = there.fraction
        self.steps[rows, :, clock] = path.velocity(stamps_ns, after_s)
        return there.poses

    def _place_by_odometry(
        self, rows: Mask, x: Array, values: Values, model: MeasurementModel, parameters: tuple[Parameter, ...]
    ) -> Array:
        """The poses of some by odometry since their keyframes."""
        group, moved = self._p.space.group, tuple(self._edges.T_keyframe_base[rows].T)
        for k, one in enumerate(parameters):
            if one.name in (*FACTORS, BEND):
                self.steps[rows, :, k] = self._scaled_steps(one, moved, values, model)
        own = tuple(self._p.poses(x, self._own[rows]).T)
        return np.stack(group.compose(own, model.scaled(moved, values)), axis=-1)

    def _scaled_steps(self, parameter: Parameter, moved: Numbers, values: Values, model: MeasurementModel) -> Array:
        probe = parameter.quantity.probe
        sides = [
            model.scaled(moved, {**values, parameter: values.get(parameter, 0.0) + side}) for side in (probe, -probe)
        ]
        return np.stack(self._p.space.group.local(*sides), axis=-1) / (2.0 * probe)


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
        known = graph.vertex_count
        self._eyes = [_Eyes(problem, edges, len(parameters)) for edges in self._model.sightings]
        self.column = np.full(graph.vertex_count, -1)
        dof = np.array([kind.dof for kind in graph.kinds], dtype=np.int64)[graph.kind.values[free]]
        self.column[free] = np.cumsum(dof) - dof
        self.unknowns = int(dof.sum())
        self._stamp_of = np.zeros(graph.vertex_count, dtype=np.int64)
        self._stamp_of[problem.keyframes] = problem.stamps_ns
        for eyes, edges in zip(self._eyes, self._model.sightings, strict=True):
            self._stamp_of[eyes.ids] = edges.stamps_ns
        self._known = known
        tables = graph.tables.values()  # how likely what odometry measured is does not change with its factors
        self._path = problem.path(problem.values, {})
        self._log_roots = {one.code: np.linalg.slogdet(one.sqrt_information.values)[1] for one in tables}

    def rows(self, x: Array, theta: Array, losses: Mapping[LossKey, Loss]) -> Rows:
        """The rows at stored values x of the vertices, and corrections theta (p,)."""
        graph = self._p.graph
        values = dict(zip(self._parameters, theta.tolist(), strict=True))
        all_x = np.concatenate((x, graph.initial.values[len(x) :]))
        path = self._p.path(x, values, self._path)
        for eyes in self._eyes:
            eyes.place(all_x, values, self._model, path, self._parameters)
        derivative = self._correct(all_x, values)
        blocks = linearize(graph, all_x, rows_of(graph, self._edges), Losses(graph, losses))
        parts = [self._of_block(block, derivative, all_x) for block in _by_table(blocks)]
        return Rows(
            sparse.vstack([part.jacobian for part in parts], format="csr"),
            *(np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS),
        )

    # -- measurements ----------------------------------------------------------------------------------------------

    def _correct(self, x: Array, values: Values) -> dict[tuple[int, int], Array]:
        """Correct the measurements of the copy; returns derivatives (n, m) of residuals, by table and parameter."""
        out: dict[tuple[int, int], Array] = {}
        concerned: list[OdometryEdges | Sightings] = [*self._model.odometry, *self._model.sightings]
        for edges in concerned:
            for k, parameter in enumerate(self._parameters):
                if parameter.source == edges.source and parameter.name != "clock":
                    key = edges.table.code, k
                    out.setdefault(key, np.zeros((len(edges.table), edges.table.type.residual_size)))
                    out[key][edges.rows] = self._derivative(edges, parameter, values, x)
            edges.table.measured.values[edges.rows] = self._measured(edges, values)
            edges.table.sqrt_information.values[edges.rows] = self._roots(edges, values)
        return out

    def _roots(self, edges: OdometryEdges | Sightings, values: Values) -> Array:
        if isinstance(edges, OdometryEdges):
            return self._model.odometry_roots(edges, values)
        return self._model.fitted_roots(edges, values)

    def _measured(self, edges: OdometryEdges | Sightings, values: Values) -> Array:
        if isinstance(edges, OdometryEdges):
            return self._model.corrected_odometry(edges, values)
        return self._model.seen(edges, values)

    def _derivative(self, edges: OdometryEdges | Sightings, parameter: Parameter, values: Values, x: Array) -> Array:
        """Central difference of the residuals (n, m) with respect to one parameter, and what it makes of their noise.

        The noise of a position is turned with the sensor. Without that part, errors along and across the line of sight
        that go together would pass for a turned sensor.
        """
        at = self._p.graph.offset.values[edges.table.vertices.values[edges.rows]]
        probe, sides, roots = parameter.quantity.probe, [], []
        for side in (probe, -probe):
            there = {**values, parameter: values.get(parameter, 0.0) + side}
            sides.append(edges.table.type.linearize(x, at, self._measured(edges, there))[0])
            roots.append(self._roots(edges, there))
        difference = sides[0] - sides[1]
        wrapped = np.abs(difference) > np.pi
        out = difference - wrapped * np.sign(difference) * 2.0 * np.pi
        if not np.array_equal(roots[0], roots[1]):
            of_noise = np.einsum("nij,nj->ni", roots[0] - roots[1], 0.5 * (sides[0] + sides[1]))
            out += np.linalg.solve(self._roots(edges, values), of_noise[..., None])[..., 0]
        return np.asarray(out / (2.0 * probe))

    # -- blocks to rows --------------------------------------------------------------------------------------------

    def _of_block(self, block: Block, derivative: Mapping[tuple[int, int], Array], x: Array) -> Rows:
        table, rows = block.table, block.rows
        n, m, _ = block.jacobian.shape
        norm = np.sum(block.residual**2, axis=1)
        slope = np.where(block.chi2 > 1e-12, norm / np.maximum(block.chi2, 1e-12), 1.0)
        root = table.sqrt_information.values[rows] * np.sqrt(slope * table.weight.values[rows])[:, None, None]
        columns = np.zeros((n, m, len(self._parameters)))
        for (code, k), of_table in derivative.items():
            if code == table.code:
                columns[:, :, k] = np.einsum("nij,nj->ni", root, of_table[rows])
        ends, jacobian, dofs = table.vertices.values[rows], block.jacobian, table.type.dofs
        is_seen, stamps, landmark = ends[:, 0] >= self._known, self._stamp_of[ends[:, 0]], np.full(n, -1)
        if is_seen.any():
            ends, jacobian = self._through_eyes(ends, jacobian, columns, x)
            dofs, landmark = (dofs[0], *dofs), np.where(is_seen, ends[:, 2], -1)
        each = [np.repeat(one, m) for one in (landmark, stamps, slope)]
        each.append(block.cost - 2.0 * self._log_roots[table.code][rows])
        here = self._sparse(ends, jacobian, dofs), columns.reshape(n * m, -1), block.residual.ravel()
        return Rows(*here, *each)

    def _sparse(self, ends: Index, jacobian: Array, dofs: Sequence[int]) -> sparse.csr_matrix:
        """The Jacobians of some edges in the columns of their unknowns."""
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
        space, offset, size = self._p.space, self._p.graph.offset.values, np.arange(self._p.space.pose.size)
        dof = space.dof
        first, second, fraction = ends[:, 0].copy(), ends[:, 0].copy(), np.zeros(len(ends))
        for eyes in self._eyes:
            at = ends[:, 0] - eyes.ids[0] if len(eyes.ids) else np.full(len(ends), -1)
            mine = (at >= 0) & (at < len(eyes.ids))
            k = at[mine]
            first[mine], second[mine], fraction[mine] = eyes.first[k], eyes.second[k], eyes.fraction[k]
            columns[mine] += np.einsum("nij,njk->nik", jacobian[mine, :, :dof], eyes.steps[k])
        here = tuple(x[offset[ends[:, 0]][:, None] + size].T)
        parts = []
        for keyframe, part in ((first, 1.0 - fraction), (second, fraction)):
            seen = space.group.between(here, tuple(x[offset[keyframe][:, None] + size].T))
            parts.append(part[:, None, None] * (jacobian[:, :, :dof] @ _adjoints(space, seen)))
        return np.column_stack((first, second, ends[:, 1:])), np.concatenate((*parts, jacobian[:, :, dof:]), axis=2)


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
    """Edges of the problem that have a weight."""
    graph = problem.graph
    inside = np.zeros(graph.vertex_count, dtype=bool)
    inside[problem.vertices] = True
    chosen = []
    for table in graph.tables.values():
        fits = (table.weight.values > 0.0) & inside[table.vertices.values].all(axis=1)
        chosen.append(table.id.values[fits])
    return np.sort(np.concatenate(chosen))
