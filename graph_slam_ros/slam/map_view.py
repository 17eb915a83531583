"""What can be read of a pipeline: path, landmarks, covariances, statistics and health."""

from collections.abc import Sequence, Set
from copy import deepcopy
from dataclasses import asdict
from typing import Any

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.graph import Graph
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.measurements.edits import AppliedEdit
from graph_slam_ros.measurements.types import Value
from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.calibration.answers import Fitted
from graph_slam_ros.slam.calibration.fit import TrialFit
from graph_slam_ros.slam.calibration.parameters import AUTO
from graph_slam_ros.slam.doubt.detector import OdometryDoubt
from graph_slam_ros.slam.doubt.record import Doubt
from graph_slam_ros.slam.frontend.gyro import GyroState
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.landmarks.renewed_ids import LEAST, RenewedIds, renewed_ids
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.robust.ledger import Ledger
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.slam.solution import Correction, Solution
from graph_slam_ros.solver import Report, Solver
from graph_slam_ros.typing import Array, Index, Numbers

_LATELY_NS = 10_000_000_000  # as long as health says that odometry is frozen


class MapView:
    """The map, the path and the health of a pipeline, read from its parts.

    Attributes
    ----------
    backend : the graph, its solver and the verdicts on its edges
    trials : trial fits in the background: what is off
    corrections : factors of odometry that the association found, and what is configured
    """

    def __init__(
        self,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        doubt: OdometryDoubt,
        solution: Solution,
        settings: dict[str, Value],
    ) -> None:
        self.backend, self._frontend, self._landmarks = backend, frontend, landmarks
        self._doubt, self._solution, self._settings = doubt, solution, settings
        self.trials, self.corrections = solution.trials, frontend.corrections

    def __repr__(self) -> str:
        counts = f"{len(self.keyframes)} keyframes, {len(self.landmarks)} landmarks, {self.graph.edge_count} edges"
        return f"{type(self).__name__}({counts}, {self.solves} solves)"

    # -- the path --------------------------------------------------------------------------------------------------

    @property
    def config(self) -> Config:
        """The present parameters."""
        return self._frontend.config

    @property
    def space(self) -> Geometry:
        """The plane or space."""
        return self.config.space

    @property
    def graph(self) -> Graph:
        """The graph of vertices and edges."""
        return self.backend.graph

    @property
    def solver(self) -> Solver:
        """The solver of the graph."""
        return self.backend.solver

    @property
    def keyframes(self) -> StampedPoses[Keyframe]:
        """The keyframes, in order of time."""
        return self._frontend.path.keyframes

    @property
    def began_ns(self) -> int:
        """The stamp of the first keyframe of all."""
        return next(iter(self.bounded.old.values())).stamp_ns if self.bounded else self.keyframes[0].stamp_ns

    @property
    def bounded(self) -> BoundedState | None:
        """The state of a condensed map that is not in its graph; None where nothing was condensed."""
        return self.backend.bounded if self.keyframes.first else None

    @property
    def segments(self) -> list[int]:
        """The indices of the keyframes at which a segment begins: odometry started there, or jumped."""
        return self._frontend.path.segments

    @property
    def drives(self) -> list[int]:
        """The index of the first keyframe of each drive; the last drive is the present one."""
        return self._frontend.path.drives

    @property
    def sighting_poses(self) -> StampedPoses[SightingPose]:
        """The poses at the stamps of the sightings, each relative to a keyframe."""
        return self._frontend.sighting_poses

    def trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` of all keyframes, (n, 3) or (n, 7)."""
        return self.solver.estimate(self.keyframes.ids).reshape(-1, self.space.pose.size)

    def shown_path(self) -> tuple[Index, Array]:
        """Stamps and estimated poses of all keyframes that are in the graph, in order of time."""
        old = self.bounded.old.values() if self.bounded else ()
        vertices = [*(one.vertex for one in old), *self.keyframes.ids.tolist()]
        stamps_ns = [*(one.stamp_ns for one in old), *self.keyframes.stamps_ns.tolist()]
        poses = self.solver.estimate(vertices).reshape(-1, self.space.pose.size)
        return np.array(stamps_ns, dtype=np.int64), poses

    def sighting_trajectory(self) -> Array:
        """Estimated poses ``T_map_base`` at the stamps of the sightings, (n, 3) or (n, 7).

        The correction of odometry between two keyframes is spread evenly over the time between them.
        """
        poses, group = self.trajectory(), self.space.group
        found, stamps_ns = self._at_sightings(poses), self.keyframes.stamps_ns
        since_ns = self.sighting_poses.stamps_ns - stamps_ns[self._sighting_rows]
        ends = np.isin(self.sighting_poses.ids + 1, [*self.segments, len(self.keyframes)])
        a = self._sighting_rows[~ends]
        motion = self._motions(a)
        wrong = group.local(tuple(poses[a + 1].T), group.compose(tuple(poses[a].T), motion))
        part = np.minimum(since_ns[~ends] / np.maximum(stamps_ns[a + 1] - stamps_ns[a], 1), 1.0)
        found[~ends] = np.stack(group.retract(tuple(found[~ends].T), tuple(part * d for d in wrong)), axis=-1)
        return found

    @property
    def _sighting_rows(self) -> Index:
        return self.sighting_poses.ids - self.keyframes.first

    def _motions(self, keyframes: Index) -> Numbers:
        """The motion from each of some keyframes, by their rows, to the next as measured, in arrays."""
        odometry, group = self.keyframes.poses, self.space.group
        motion: Numbers = group.between(tuple(odometry[keyframes].T), tuple(odometry[keyframes + 1].T))
        if self._frontend.gyro is None:
            return self.corrections.motion(motion)
        out, ids = np.stack(motion, axis=-1), self.keyframes.ids
        edges = map(self.graph.edge, self.graph.edges_of("odometry").tolist())
        measured = {tuple(edge.vertices): edge.measured for edge in edges}
        for k, ends in enumerate(zip(ids[keyframes].tolist(), ids[keyframes + 1].tolist(), strict=True)):
            out[k] = measured.get(ends, out[k])
        return tuple(out.T)

    def sighting_odometry(self) -> Array:
        """Return the poses of odometry alone, ``T_odom_base`` at the stamps of the sightings, (n, 3) or (n, 7)."""
        return self._at_sightings(self.keyframes.poses)

    def _at_sightings(self, keyframe_poses: Array) -> Array:
        keyframes = keyframe_poses[self._sighting_rows]
        return np.stack(self.space.group.compose(tuple(keyframes.T), tuple(self.sighting_poses.poses.T)), axis=-1)

    # -- odometry -------------------------------------------------------------------------------------------------

    @property
    def T_map_odom(self) -> Numbers:
        """The transform ``map -> odom``: it corrects odometry's drift at the newest keyframe."""
        return self._solution.T_map_odom if self.keyframes else self.space.identity

    @property
    def odometry_source(self) -> str:
        """The name of the odometry input in use; empty before the first odometry."""
        return self._frontend.source

    @property
    def odometry_sources(self) -> Set[str]:
        """The names of the odometry inputs that have been used."""
        return self._frontend.odometry.sources

    @property
    def odometry_is_frozen(self) -> bool:
        """Return whether landmarks have shown lately that the robot moves while odometry stands still."""
        frozen_ns = self._frontend.frozen_ns
        return frozen_ns is not None and 0 <= self._frontend.now_ns - frozen_ns < _LATELY_NS

    @property
    def gyro(self) -> GyroState | None:
        """The present estimate of the gyro; None where no input is one."""
        return self._frontend.gyro.state if self._frontend.gyro else None

    # -- landmarks -------------------------------------------------------------------------------------------------

    @property
    def landmarks(self) -> dict[str, Landmark]:
        """The landmarks of the graph, by identity, without tentative ones."""
        return {name: mark for name, mark in self._landmarks.map.known.items() if not mark.is_tentative}

    @property
    def waiting(self) -> dict[str, str]:
        """The landmarks that were seen but are not in ``landmarks`` yet: identity and reason."""
        tentative = {
            name: f"seen {mark.sightings} times, without an identity: not believed yet"
            for name, mark in self._landmarks.map.known.items()
            if mark.is_tentative
        }
        return {name: mark.reason for name, mark in self._landmarks.map.undetermined.items()} | tentative

    def trial_fit(
        self, groups: Sequence[str] = (AUTO,), *, is_to_correct: bool = False
    ) -> tuple[TrialFit, list[Fitted]]:
        """Fit the calibration of odometry and sensors with the map, on a copy: nothing is changed.

        Parameters
        ----------
        groups : of ``slam.calibration.parameters.GROUPS``, or ``auto``
        is_to_correct : whether somebody sets what is found: what a gyro measures, and factors that landmarks without
            identities merely confirm, are left out. Else the places of sensors are fitted, too, where one is so far off
            that it passes for other parameters.

        Returns
        -------
        The fit: ``parameters``, ``values`` (corrections, 0 is what is configured), ``sigmas``, ``correlation``. And the
        finding of each: ``verdict``, ``text``, ``is_determined``. Both are empty where no edge depends on any.

        Raises
        ------
        SingularError
            The edges do not determine the estimate.
        """
        return self.trials.fit(groups, is_to_correct=is_to_correct)

    def uncorrected(self) -> list[Fitted]:
        """A clock, a mount or a scale that is off by so much that the poses are worse than their covariances say.

        A trial fit finds it, on a copy: nothing is changed.
        """
        return self.trials.uncorrected() if self.is_solved else []

    @property
    def association_report(self) -> dict[str, Any]:
        """The report on the last explanation of all sightings without identity; empty if there was none."""
        return self._landmarks.anonymous.hindsight.report

    def renewed_ids(self) -> RenewedIds | None:
        """Return which ids are new from some time on though landmarks are not, as after a detector began anew."""
        named = [one for one in self.landmarks.values() if not one.is_unnamed and one.sightings >= LEAST]
        if len(named) < 2 * LEAST or not self.is_solved:
            return None
        at = self._landmarks.map.positions([one.vertex for one in named])
        names, *ends_ns = zip(*((one.name, one.first_seen_ns, one.last_seen_ns) for one in named), strict=True)
        return renewed_ids(names, at, *map(np.array, ends_ns))

    @property
    def corrected(self) -> Sequence[Fitted]:
        """The findings of these factors, in order."""
        return self._solution.found_factors.corrected

    @property
    def landmark_changes(self) -> int:
        """The number of changes of landmarks."""
        return self._landmarks.map.changes

    # -- covariances -----------------------------------------------------------------------------------------------

    @property
    def pose_covariance(self) -> Array:
        """Covariance (3, 3) or (6, 6) of the newest keyframe's pose in its tangent space.

        It is the marginal of the last solve, propagated with the odometry since then.
        """
        covariance = self._frontend.covariance.copy()
        return self.trials.widened(covariance, int(self.keyframes.ids[-1])) if self.keyframes else covariance

    def landmark_covariances(self, names: Sequence[str] | None = None) -> list[Array]:
        """Marginals of all or some landmarks: of points in map's axes, of poses in tangent space; NaN if unknown."""
        known = self.landmarks
        return self._marginals([known[name].vertex for name in (known if names is None else names)])

    def keyframe_covariances(self) -> Array:
        """Marginal of every keyframe in its tangent space, (n, 3, 3) or (n, 6, 6); NaN if unknown."""
        dof = self.space.dof
        return np.array(self._marginals(self.keyframes.ids.tolist())).reshape(-1, dof, dof)

    def _marginals(self, vertices: list[int]) -> list[Array]:
        """Vertices added since the last solve are unknown until the next; if the last solve failed, all are."""
        out = [np.full((dof, dof), np.nan) for dof in (self.graph.kind_of(vertex).dof for vertex in vertices)]
        solved = self._solution.vertices if self.is_solved else 0
        known = [k for k, vertex in enumerate(vertices) if vertex < solved]
        for k, marginal in zip(known, self.solver.marginal([vertices[k] for k in known]), strict=True):
            out[k] = self.trials.widened(marginal, vertices[k])
        return out

    # -- the graph and its solution --------------------------------------------------------------------------------

    @property
    def ledger(self) -> Ledger:
        """The ledger of decisions on all edges."""
        return self.backend.ledger

    @property
    def is_solved(self) -> bool:
        """Return whether the last solve succeeded and no edge is pending, so that covariances exist."""
        return self._solution.vertices > 0 and self.solver.is_current

    @property
    def solves(self) -> int:
        """The number of solves that succeeded."""
        return self._solution.solves

    @property
    def report(self) -> Report | None:
        """The report of the last solve of everything."""
        return self._solution.report

    @property
    def correction(self) -> Correction:
        """The correction of the last solve."""
        return self._solution.correction

    @property
    def edits(self) -> list[AppliedEdit]:
        """The edits by hand, in order."""
        return self.backend.edits

    @property
    def datum(self) -> tuple[float, ...]:
        """Latitude, longitude [deg] and height [m] of the map's origin, from the first fix; empty: no fix had them."""
        return self._frontend.gates.datum

    def snapshot(self, folder: Any = None) -> MapSnapshot:
        """A copy of the map as it is now. What was condensed is in the run folder that is given."""
        ledger = self.ledger.copy()
        ledger.history = list(self.ledger.history)
        ledger.finish(self.backend.frozen_edges)
        return MapSnapshot(
            graph=self.graph.copy(),
            ledger=ledger,
            values=self.solver.values,
            keyframes=self.keyframes.since(self.keyframes.first),
            segments=list(self.segments),
            drives=list(self.drives),
            sighting_poses=self.sighting_poses.since(0),
            landmarks=self._landmarks.map.copies(),
            frozen=self.backend.frozen,
            held=self.backend.held,
            datum=self.datum,
            settings=dict(self._settings),
            displacements=self.displacements,
            used_ns=self._frontend.odometry.newest_ns,
            drive=self._frontend.drive,
            noise_factors=dict(self.backend.noise.factors),
            edits=list(self.edits),
            calibration=self.corrections.totals(),
            gyro_bias=self._frontend.gyro.saved if self._frontend.gyro else None,
            bounded=deepcopy(self.bounded),
            folder=folder,
        )

    # -- health ----------------------------------------------------------------------------------------------------

    @property
    def failing(self) -> str:
        """The reason why the last solve failed; empty if it succeeded."""
        return self._solution.guard.failing

    @property
    def alarms(self) -> tuple[Doubt, ...]:
        """The times when the landmarks contradicted odometry, in order: displacements and slips. Some may go on."""
        return tuple(sorted(self._doubt.doubts, key=lambda one: one.began_ns))

    @property
    def displacements(self) -> list[dict[str, Any]]:
        """The same as records for files, each with its sentence; first those of the map that it began in."""
        own = [asdict(alarm) | {"text": str(alarm)} for alarm in self.alarms]
        return [*self._doubt.earlier, *own]

    @property
    def displaced(self) -> Doubt | None:
        """The alarm that goes on, a displacement before a slip; or None."""
        return self._doubt.now
