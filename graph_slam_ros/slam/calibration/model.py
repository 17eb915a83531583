"""The measurements of a graph as they would be with other parameters.

An edge of odometry between two keyframes is ``Exp(S Log z)``, with the factors in S: over its few centimetres the
motion is taken for one of constant velocity. A sighting is brought to the stamp plus the clock's correction along the
estimated path, never by single twists: their noise would be taken for signal; and its sensor is turned about its own
origin and moved, in the axes of the base. A range becomes ``factor * range + offset``.

The noise of odometry is that of the motion: the robot does not do exactly what was commanded (Berkson). If it is that
of z instead, as with encoders, a fitted factor is too small by noise over motion, both squared (Fuller, "Measurement
error models", 1987, section 1.1: attenuation). With ``is_noise_measured`` noise grows with the factors, which mends it.
The noise of a range is always that of what was measured.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.graph.tables import EdgeTable
from graph_slam_ros.lie import so3
from graph_slam_ros.slam.calibration.parameters import BEND, OF_ODOMETRY, Values
from graph_slam_ros.slam.frontend.corrections import moved_with_sensor, scaled
from graph_slam_ros.slam.frontend.sighting_edges import SightingEdges
from graph_slam_ros.typing import Array, Index, Numbers

_POINTS = ("landmark position", "tag position")

_BEND_RAD = 0.1  # of a step, at which half of the factor for bends counts
_MOVED_M = 0.01  # of a step: with less, noise is not for its metres


@dataclass(frozen=True, slots=True)
class OdometryEdges:
    """Edges of odometry in one table.

    Attributes
    ----------
    measured : (n, size)
    roots : (n, m, m) square roots of the information of what was measured
    seconds : (n,) that each lasts
    """

    table: EdgeTable
    rows: Index
    source: str
    measured: Array
    roots: Array
    seconds: Array


@dataclass(frozen=True, slots=True)
class Sightings:
    """Edges of sightings in one table, of one input.

    Attributes
    ----------
    seen : (n, p) what was measured, from the base at the stamp instead of from the keyframe
    roots : (n, m, m) square roots of its information, in the axes of the base there
    stamps_ns : (n,); T_keyframe_base : (n, size) there; sensor : (n, dimensions) position on the base
    """

    table: EdgeTable
    rows: Index
    source: str
    seen: Array
    roots: Array
    stamps_ns: Index
    T_keyframe_base: Array
    sensor: Array

    @property
    def kind(self) -> str:
        """The name of the edge type, without the number of dimensions."""
        return kind_of(self.table)


Edges = OdometryEdges | Sightings


def kind_of(table: EdgeTable) -> str:
    """The name of a table's edge type, without the number of dimensions."""
    return table.type.name.removesuffix(" 3D")


def groups_of(graph: Graph, edges: range) -> Iterator[tuple[EdgeTable, str, str, Index]]:
    """Yield table, class, input and rows of the edges that parameters may affect."""
    labels = {"odometry", "landmarks"} & set(graph.labels)
    for table in graph.tables.values():
        here = (table.ids >= edges.start) & (table.ids < edges.stop)
        for label in sorted(labels):
            of_label = here & (table.label.values == graph.labels.index(label))
            origins = np.unique(table.source.values[of_label]).tolist()
            for origin in sorted(origins, key=lambda one: graph.sources[one]):
                yield table, label, graph.sources[origin], np.flatnonzero(of_label & (table.source.values == origin))


class MeasurementModel:
    """The measurements of a graph as functions of corrections by parameter. A missing correction is 0.

    Parameters
    ----------
    origins : of the sightings
    keyframes, stamps_ns : vertices and stamps of the keyframes
    edges : whose measurements may be corrected
    is_noise_measured : whether the noise of odometry is that of what was measured, and not of the motion
    """

    def __init__(
        self,
        space: Geometry,
        graph: Graph,
        origins: SightingEdges,
        keyframes: Index,
        stamps_ns: Index,
        edges: range,
        *,
        is_noise_measured: bool = False,
    ) -> None:
        self._space, self._is_noise_measured = space, is_noise_measured
        stamp_of = np.zeros(graph.vertex_ids.next, dtype=np.int64)
        stamp_of[keyframes] = stamps_ns
        self.odometry: list[OdometryEdges] = []
        self.sightings: list[Sightings] = []
        for table, label, source, rows in groups_of(graph, edges):
            stamps = stamp_of[table.at(rows).vertices]
            if label == "odometry":
                measured, roots = table.measured.values[rows].copy(), table.sqrt_information.values[rows].copy()
                seconds = (stamps[:, 1] - stamps[:, 0]).astype(np.float64) * 1e-9
                self.odometry.append(OdometryEdges(table, rows, source, measured, roots, seconds))
            else:
                self.sightings.append(self._sightings(table, rows, source, origins, stamps[:, 0]))

    def _sightings(
        self, table: EdgeTable, rows: Index, source: str, origins: SightingEdges, stamps_ns: Index
    ) -> Sightings:
        """Sightings without a known origin, in older maps, are treated as taken at their keyframe."""
        z, places, n = table.measured.values[rows].copy(), origins.places(table.at(rows).ids), self._space.dimensions
        known, roots = places >= 0, table.sqrt_information.values[rows].copy()
        poses = np.tile(np.array(self._space.identity), (len(rows), 1))
        sensor, stamps = np.zeros((len(rows), n)), stamps_ns.copy()
        of = origins.rows[places[known]]
        stamps[known], poses[known], sensor[known] = of["stamp_ns"], of["T_keyframe_base"], of["sensor"]
        found = Sightings(table, rows, source, z, roots, stamps, poses, sensor)
        found.seen[:] = self.from_pose(found, z, self._space.group.inverse(tuple(poses.T)))
        if found.kind in _POINTS:
            roots[:] = roots @ self._turns(tuple(poses.T))
        if found.kind not in (*_POINTS, "relative pose"):
            tail = z.shape[1] - self._space.pose.size
            found.sensor[:] = found.seen[:, tail : tail + n]
        return found

    def measured(self, edges: Edges, values: Values) -> Array:
        """Measurements (n, p): motions by odometry with other factors, or from the base at the stamp by a sensor."""
        if isinstance(edges, Sightings):
            return self._seen(edges, values)
        bias = _of(values, edges.source).get("turn_bias", 0.0)
        return np.stack(self.scaled(tuple(edges.measured.T), values, bias * edges.seconds), axis=-1)

    def roots(self, edges: Edges, values: Values) -> Array:
        """Square roots (n, m, m) of their information; of a turned sensor in the axes of the base."""
        if isinstance(edges, OdometryEdges):
            return edges.roots / self._factors(values) if self._is_noise_measured else edges.roots
        named = _of(values, edges.source)
        if edges.kind in _POINTS:
            turn, _ = self._mount(named)
            return edges.roots @ self._turns(tuple(np.atleast_1d(x) for x in turn)).swapaxes(1, 2)
        if edges.kind.startswith("range") and (factor := 1.0 + named.get("range_factor", 0.0)) != 1.0:
            out = edges.roots.copy()
            out[:, :, 0] /= factor
            return out
        return edges.roots

    def scaled(self, motion: Numbers, values: Values, turned: Any = 0.0) -> Numbers:
        """A motion by odometry with other factors; that for bends counts by half in a step of ``_BEND_RAD``."""
        distance, turn = factors_of(values)
        if bend := of_odometry(values).get(BEND, 0.0):
            bent = abs(turn * self._space.group.log(motion)[-1])
            distance = distance * (1.0 + bend * bent / (bent + _BEND_RAD))
        return scaled(self._space, motion, distance, turn, turned)

    def _factors(self, values: Values) -> Array:
        """The factor (dof,) of each component of a motion."""
        n = self._space.dimensions
        distance, turn = factors_of(values)
        return np.array([distance] * n + [turn] * (self._space.dof - n))

    def _seen(self, edges: Sightings, values: Values) -> Array:
        named, z, space = _of(values, edges.source), edges.seen.copy(), self._space
        turn, shift = self._mount(named)
        begin, end = (0, space.dimensions) if edges.kind in _POINTS else (z.shape[1] - space.pose.size, z.shape[1])
        moved = moved_with_sensor(space, tuple(z[:, begin:end].T), tuple(edges.sensor.T), turn, shift)
        z[:, begin:end] = np.stack(moved, axis=-1)
        if edges.kind.startswith("range"):
            z[:, 0] = (1.0 + named.get("range_factor", 0.0)) * z[:, 0] + named.get("range_offset", 0.0)
        return z

    def _turns(self, poses: Any) -> Array:
        """Rotation matrices (n, d, d) of poses that are arrays."""
        n = self._space.dimensions
        rotation = (*(0.0 * x for x in poses[:n]), *poses[n:])
        columns = [np.stack(self._space.group.act(rotation, tuple(axis)), axis=-1) for axis in np.eye(n)]
        return np.stack(columns, axis=-1)

    def _mount(self, named: Mapping[str, float]) -> tuple[Numbers, Array]:
        """The rotation of a sensor as a pose, and its translation."""
        shift = np.array([named.get(axis, 0.0) for axis in "xyz"])
        if self._space.dimensions == 2:
            return (0.0, 0.0, named.get("yaw", 0.0)), shift
        turned = so3.exp((named.get("roll", 0.0), named.get("pitch", 0.0), named.get("yaw", 0.0)))
        return (0.0, 0.0, 0.0, *turned), shift

    def from_pose(self, edges: Sightings, z: Array, T_a_b: Numbers) -> Array:
        """Measurements (n, p) seen from pose b, converted to pose a. The poses are arrays."""
        out, n, group = z.copy(), self._space.dimensions, self._space.group
        if edges.kind in _POINTS:
            out[:, :n] = np.stack(group.act(T_a_b, tuple(z[:, :n].T)), axis=-1)
        else:
            tail = z.shape[1] - self._space.pose.size
            out[:, tail:] = np.stack(group.compose(T_a_b, tuple(z[:, tail:].T)), axis=-1)
        return out

    def roots_from_pose(self, edges: Sightings, T_a_b: Numbers) -> Array:
        """Square roots (n, m, m) of the information of what was seen from pose b, in the axes of pose a."""
        return edges.roots @ self._turns(T_a_b).swapaxes(1, 2) if edges.kind in _POINTS else edges.roots


def stated_sigma_per_m(space: Geometry, graph: Graph, first_edge: int) -> float:
    """The stated noise of odometry's way for each metre, in the middle of all steps; infinite where it stands."""
    n, found = space.dimensions, [np.empty(0)]
    for table, label, _, rows in groups_of(graph, range(first_edge, graph.edge_ids.next)):
        if label == "odometry":
            roots, measured = table.sqrt_information.values[rows], table.measured.values[rows, :n]
            covariance = np.linalg.inv(np.swapaxes(roots, 1, 2) @ roots)[:, :n, :n]
            way_m = np.linalg.norm(measured, axis=1)
            along = measured / np.maximum(way_m, _MOVED_M)[:, None]
            variance = np.einsum("ni,nij,nj->n", along, covariance, along)
            is_moving = way_m > _MOVED_M
            found.append(np.sqrt(np.maximum(variance[is_moving], 0.0)) / way_m[is_moving])
    every = np.concatenate(found)
    return float(np.median(every)) if len(every) else float("inf")


def factors_of(values: Values) -> tuple[float, float]:
    """The factors of odometry's distance and turn."""
    named = of_odometry(values)
    return 1.0 + named.get("distance", 0.0), 1.0 + named.get("turn", 0.0)


def of_odometry(values: Values) -> dict[str, float]:
    """Corrections of odometry by name, whatever its input."""
    return {p.name: value for p, value in values.items() if p.name in OF_ODOMETRY}


def _of(values: Values, source: str) -> dict[str, float]:
    """Corrections of an input by name."""
    return {p.name: value for p, value in values.items() if p.source == source}
