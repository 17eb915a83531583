"""Factors of odometry that the association of landmarks without identities finds: they correct all measurements.

Landmarks without identities are recognised by odometry, so the association leaves its two scales open. What each
explanation of all scans finds of them corrects what edges have measured, and what comes.
"""

from collections.abc import Mapping

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.slam.association.landmark_frontend import LandmarkFrontend
from graph_slam_ros.slam.backend import Backend
from graph_slam_ros.slam.calibration.answers import Fitted
from graph_slam_ros.slam.calibration.model import MeasurementModel, factors_of
from graph_slam_ros.slam.calibration.parameters import Parameter, Values
from graph_slam_ros.slam.frontend.keyframe_frontend import KeyframeFrontend
from graph_slam_ros.slam.levels import DIGITS, SIGMAS
from graph_slam_ros.slam.revision import Remeasured, Revision
from graph_slam_ros.slam.snapshot import MapSnapshot
from graph_slam_ros.solver import Report, Settings
from graph_slam_ros.typing import Array, Index

_FOLLOWED = 0.1  # of a sigma: what is left of a correction that is used is followed from there on


class FoundFactors:
    """Applies these factors.

    Parameters
    ----------
    start : the map to go on in: its odometry keeps the factors that were found

    Attributes
    ----------
    corrected : findings that were used, in order
    """

    def __init__(
        self,
        config: Config,
        backend: Backend,
        frontend: KeyframeFrontend,
        landmarks: LandmarkFrontend,
        start: MapSnapshot,
    ) -> None:
        self._config, self._backend, self._frontend = config, backend, frontend
        self._origins, self._anonymous = landmarks.map.origins, landmarks.anonymous
        self.corrected: list[Fitted] = []
        self._is_new = not len(start.keyframes)
        frontend.corrections.restore(start.calibration)
        self._used: Mapping[str, tuple[float, float]] = landmarks.anonymous.hindsight.found_scales

    def after_solve(self, everything: Settings | None) -> Report | None:
        """Apply what the last explanation of all scans has found, if it is new. Returns the report of a solve."""
        scales = self._anonymous.hindsight.found_scales
        if scales is self._used or not self._is_new:
            return None
        graph, keyframes = self._backend.graph, self._frontend.path.keyframes
        edges = range(self._backend.first_free_edge, graph.edge_ids.next)
        space, ids, stamps_ns = self._config.space, keyframes.ids, keyframes.stamps_ns
        self._used, model = scales, MeasurementModel(space, graph, self._origins, ids, stamps_ns, edges)
        sources = {edges.source for edges in model.odometry}
        if len(sources) != 1:
            return None
        (source,) = sources
        names = [name for name in scales if name != "turn" or not self._config.gyro_input]  # its turn is the gyro's
        before = self._frontend.corrections.found
        used = list[Fitted]()
        for name in names:
            one, (value, sigma) = Parameter(source, name), scales[name]
            if _is_used(one, value, sigma, is_corrected=(source, name) in before):
                used.append(Fitted.of(one, value, sigma, "admitted", "{}"))
        # Six digits, because the last ones of a sine depend on the memory alignment of an array.
        values = {one.parameter: float(f"{one.value:.6g}") for one in used}
        report = self._correct(model, values, everything) if values else None
        if report is not None:
            self.corrected += used
        return report

    def _correct(self, model: MeasurementModel, values: Values, everything: Settings | None) -> Report | None:
        """Correct all measurements, present and future, and solve. A failure is undone."""
        origins = list[tuple[Index, Array]]()

        def proposed() -> Revision:
            return Revision(remeasured=self._remeasured(model, values, origins), solves="all", settings=everything)

        applied = self._backend.apply("calibration", proposed)
        if applied is None:
            return None
        corrections, before = self._frontend.corrections, self._frontend.corrections.found
        now = {(one.source, one.name): value for one, value in values.items()}
        corrections.found = before | {key: before.get(key, 1.0) * (1.0 + value) for key, value in now.items()}
        for rows, poses in origins:
            self._origins.rows["T_keyframe_base"][rows] = poses
        self._anonymous.rescale(factors_of(values))
        return applied.report

    def _remeasured(
        self, model: MeasurementModel, values: Values, origins: list[tuple[Index, Array]]
    ) -> list[Remeasured]:
        """What all edges measure with corrected odometry; ``origins`` gets where sightings were measured from then."""
        out = list[Remeasured]()
        for odometry in model.odometry:
            measured = _exact(model.measured(odometry, values))
            out.append(Remeasured(odometry.table, odometry.rows, measured, odometry.roots))
        for seen in model.sightings:
            T_keyframe_base = model.scaled(tuple(seen.T_keyframe_base.T), values)
            z = _exact(model.from_pose(seen, seen.seen, T_keyframe_base))
            roots = _exact(model.roots_from_pose(seen, T_keyframe_base))
            out.append(Remeasured(seen.table, seen.rows, z, roots))
            places = self._origins.places(seen.table.at(seen.rows).ids)
            known = places >= 0
            origins.append((places[known], _exact(np.stack(T_keyframe_base, axis=-1)[known])))
        return out


def _is_used(one: Parameter, value: float, sigma: float, *, is_corrected: bool) -> bool:
    """The first two questions of ``answers``: its search compares whole explanations, which answers the others."""
    if is_corrected:
        return abs(value) >= _FOLLOWED * sigma
    return sigma < one.quantity.determined_below and abs(value) >= max(SIGMAS * sigma, one.quantity.least)


def _exact(numbers: Array) -> Array:
    return np.round(numbers, DIGITS)
