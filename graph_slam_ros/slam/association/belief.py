"""The solver's joint Gaussian in the coordinates of the beam, to start the beam and to bring back landmarks."""

from collections.abc import Mapping

import numpy as np

from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.association.beam import Beam, BeamSettings, Ids
from graph_slam_ros.slam.association.scans import Scan
from graph_slam_ros.slam.landmarks.landmark_map import Landmarks
from graph_slam_ros.slam.landmarks.rotations import lever, rotation_vector
from graph_slam_ros.solver import Solver
from graph_slam_ros.typing import Array, Numbers

_MOST_AT_FIRST = 24  # landmarks of a beginning: the nearest
_LOST_RAD = 0.5  # with a heading vaguer than this no landmark is recognised by where it is
_MOST_SHARED = 6  # landmarks that tell where another is that comes back
_REACH_SIGMA, _REACH_M = 3.0, 2.0  # 99.7 %, and beyond it a gap in the stated noise


class SolverBelief:
    """Joint marginals of the solver in the coordinates of the beam."""

    def __init__(self, space: Geometry, solver: Solver, landmarks: Landmarks) -> None:
        self._space, self._solver, self._landmarks = space, solver, landmarks

    def begin(
        self, settings: BeamSettings, scan: Scan, names: Mapping[int, str], scales: Array, scale_sigma: float
    ) -> Beam:
        """Begin a beam with the pose at a scan and the landmarks around it, and their joint covariance.

        Raises
        ------
        GraphSlamError
            The solver has no covariance.
        """
        n, dof = self._space.dimensions, self._space.dof
        position, turn, _ = self._pose(scan)
        numbers = np.array([k for k, name in names.items() if name in self._landmarks.known], dtype=np.int64)
        points = self._points(numbers, names)
        apart = np.linalg.norm(points - position, axis=1)
        near = np.argsort(apart, kind="stable")[:_MOST_AT_FIRST]
        covariance = self._joint(scan, [])
        if np.sqrt(covariance[n:, n:].diagonal().max()) > _LOST_RAD:
            near = near[:0]
        covariance = self._joint(scan, [names[k] for k in numbers[near].tolist()])
        where = np.r_[np.arange(dof), np.arange(dof + 2, len(covariance) + 2)]
        whole = np.zeros((len(covariance) + 2,) * 2)
        whole[np.ix_(where, where)] = covariance
        whole[[dof, dof + 1], [dof, dof + 1]] = scale_sigma**2
        known = self._landmarks.known
        marks = {k: (points[i], known[names[k]].sort) for i, k in zip(near, numbers[near].tolist(), strict=True)}
        return Beam(settings, position, turn, scales, marks, whole)

    def recall(self, beam: Beam, scan: Scan, names: Mapping[int, str]) -> None:
        """Bring back landmarks of the map that the beam lacks, if something is seen near them."""
        inside = set(beam.ids[0].tolist())
        out = np.array(
            [k for k, name in names.items() if k not in inside and name in self._landmarks.known], dtype=np.int64
        )
        if not len(out):
            return
        n = self._space.dimensions
        seen = beam.position[0] + np.array([c.point for c in scan.clusters]) @ beam.turn[0].T
        far = max(float(np.linalg.norm(c.point)) for c in scan.clusters)
        variances = beam.covariance[0].diagonal()
        spread = np.sqrt(variances[:n].max() + far**2 * variances[n : self._space.dof].max())
        apart = np.linalg.norm(self._points(out, names)[:, None] - seen[None], axis=2).min(axis=1)
        for k in out[apart < _REACH_SIGMA * spread + _REACH_M].tolist():
            self._recall(beam, scan, k, names)

    def seen_from(self, scan: Scan, names: list[str]) -> tuple[Array, Array]:
        """Landmarks (k, n) as they should be seen from a scan, and the covariance (k, n, n) of each.

        Raises
        ------
        GraphSlamError
            The solver has no covariance.
        """
        n, dof = self._space.dimensions, self._space.dof
        position, turn, _ = self._pose(scan)
        marks = [self._landmarks.known[name] for name in names]
        points = (self._landmarks.positions([mark.vertex for mark in marks]) - position) @ turn
        joint, covariances = self._joint(scan, names), np.empty((len(points), n, n))
        for k, point in enumerate(points):
            at = np.r_[:dof, dof + n * k : dof + n * (k + 1)]
            j = np.concatenate([-turn.T, -lever(point), turn.T], axis=1)
            covariances[k] = j @ joint[np.ix_(at, at)] @ j.T
        return points, covariances

    def _recall(self, beam: Beam, scan: Scan, number: int, names: Mapping[int, str]) -> None:
        """Bring back a landmark: the solver's conditional given what it shares with each hypothesis."""
        n, dof = self._space.dimensions, self._space.dof
        shared = self._shared(beam, number, names)
        position, turn, _ = self._pose(scan)
        covariance = self._joint(scan, [*(names[k] for k in shared.tolist()), names[number]])
        s, j = slice(0, len(covariance) - n), slice(len(covariance) - n, None)
        given = np.linalg.lstsq(covariance[s, s], covariance[s, j], rcond=1e-12)[0].T
        left = covariance[j, j] - given @ covariance[s, j]
        slots = [(beam.ids == k).argmax(axis=1) for k in shared.tolist()]
        rows = np.arange(len(beam.ids))
        away = [beam.position - position, rotation_vector(turn.T @ beam.turn)]
        away += [
            beam.landmarks[rows, slot] - self._points(np.array([k]), names)
            for k, slot in zip(shared.tolist(), slots, strict=True)
        ]
        columns = [np.broadcast_to(np.arange(dof), (len(rows), dof))]
        columns += [dof + 2 + n * slot[:, None] + np.arange(n) for slot in slots]
        at = np.concatenate(columns, axis=1)
        points = self._points(np.array([number]), names) + np.concatenate(away, axis=1) @ given.T
        cross = given @ beam.covariance[rows[:, None], at]
        own = np.take_along_axis(cross, np.broadcast_to(at[:, None], (len(rows), n, at.shape[1])), axis=2) @ given.T
        beam.recall(number, self._landmarks.known[names[number]].sort, points, cross, own + left)

    def _shared(self, beam: Beam, number: int, names: Mapping[int, str]) -> Ids:
        """The landmarks nearest to one that all hypotheses and the map share."""
        common = set(beam.ids[0].tolist())
        for row in beam.ids[1:].tolist():
            common &= set(row)
        numbers = np.array(sorted(k for k in common if names.get(k) in self._landmarks.known), dtype=np.int64)
        at = self._points(np.array([number]), names)[0]
        apart = np.linalg.norm(self._points(numbers, names) - at, axis=1)
        return numbers[np.argsort(apart, kind="stable")[:_MOST_SHARED]]

    def _points(self, numbers: Ids, names: Mapping[int, str]) -> Array:
        """Positions (k, n) of landmarks in map."""
        marks = [self._landmarks.known[names[k]] for k in numbers.tolist()]
        return self._landmarks.positions([mark.vertex for mark in marks])

    def _pose(self, scan: Scan) -> tuple[Array, Array, Numbers]:
        """Position and rotation of a scan by the solver, and the pose of its keyframe."""
        space, where = self._space, scan.where
        T_map_keyframe: Numbers = tuple(self._solver.estimate([where.vertex])[0].tolist())
        T_map_base = space.group.compose(T_map_keyframe, where.T_keyframe_base)
        return np.array(T_map_base[: space.dimensions]), space.turn(T_map_base), T_map_keyframe

    def _joint(self, scan: Scan, names: list[str]) -> Array:
        """Covariance of position in map, rotation in the robot's frame, and landmarks in map, at a scan."""
        space, where = self._space, scan.where
        n, dof = space.dimensions, space.dof
        _, turn, T_map_keyframe = self._pose(scan)
        marks = [self._landmarks.known[name] for name in names]
        joint = self._solver.joint_marginal([where.vertex, *(mark.vertex for mark in marks)])
        j = np.zeros((dof + n * len(marks), len(joint)))
        at_keyframe, moved = space.turn(T_map_keyframe), where.T_keyframe_base
        j[:n, :n], j[:n, n:dof] = at_keyframe, at_keyframe @ lever(np.array(moved[:n]))
        j[n:dof, n:dof] = space.turn(moved).T if n == 3 else np.eye(1)
        column = dof
        for k, mark in enumerate(marks):
            axes = self._landmarks.axes(mark)
            j[dof + n * k : dof + n * (k + 1), column : column + n] = axes
            column += self._landmarks.kind_of(mark.vertex).dof
        out = np.asarray(j @ joint @ j.T)
        onto = np.eye(dof)
        onto[:n, :n] = turn
        out[:dof, :dof] += onto @ where.covariance @ onto.T
        return out
