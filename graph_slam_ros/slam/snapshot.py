"""A map that a run can continue: everything of a run except unfinished work."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.measurements.edits import AppliedEdit
from graph_slam_ros.slam.calibration.recalibration import Recalibration
from graph_slam_ros.slam.frontend.gyro import SavedBias
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.noise_factors import Key, Rescaling
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.typing import Array


@dataclass(slots=True)
class MapSnapshot:
    """A map: its graph, its verdicts, and where it is thought to be; named as in ``GraphSlam``.

    Attributes
    ----------
    values : stored numbers of all vertices, as ``Graph.initial``: where solving begins
    frozen : the first so many vertices stay there, and verdicts on what is between them as they are
    held : so many vertices and edges were held when localization began (``map.localize``); zeros where the map grows
    datum : of fixes on earth, as in ``Fix``
    settings : parameters that were changed on the way, by name
    displacements : alarms by then, of all drives, as in ``run.json``
    processed : records of the ingest sequence that it came of; None where it does not tell
    used_ns : stamp of the last odometry that was used by then; None before the first
    source : the input of that odometry
    noise_factors : of the configured sigmas, that the edges have, as ``NoiseScales.factors``
    calibration : factors of odometry that the association found, with those configured, by input and name
    edits : by hand, in order
    gyro_bias : of the gyro, as far as it was learnt; None without a gyro
    first_keyframe : the number of the first of ``keyframes``: those before were condensed
    bounded : what a condensed map has besides; None where nothing was condensed
    folder : path of the run that it was read of, which has what was condensed; None where it is of none
    continues_with : the odometry whose next message belongs to the same drive; empty where a new drive begins
    """

    graph: Graph = field(default_factory=Graph)
    ledger: Ledger = field(default_factory=Ledger)
    values: Array = field(default_factory=lambda: np.zeros(0))
    keyframes: list[Keyframe] = field(default_factory=list)
    segments: list[int] = field(default_factory=list)
    drives: list[int] = field(default_factory=list)
    sighting_poses: list[SightingPose] = field(default_factory=list)
    landmarks: dict[str, Landmark] = field(default_factory=dict)
    frozen: int = 0
    held: tuple[int, int] = (0, 0)
    datum: tuple[float, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    displacements: list[dict[str, Any]] = field(default_factory=list)
    processed: int | None = 0
    used_ns: int | None = None
    source: str = ""
    continues_with: str = ""
    noise_factors: dict[Key, float] = field(default_factory=dict)
    edits: list[AppliedEdit] = field(default_factory=list)
    calibration: dict[tuple[str, str], float] = field(default_factory=dict)
    gyro_bias: SavedBias | None = None
    first_keyframe: int = 0
    bounded: BoundedState | None = None
    folder: Any = None

    @property
    def noise_changes(self) -> tuple[Rescaling, ...]:
        """None, because the edges are as they were read."""
        return ()

    @property
    def recalibrations(self) -> tuple[Recalibration, ...]:
        """None, because the edges are as they were read."""
        return ()

    @property
    def path(self) -> tuple[list[Keyframe], list[int], list[int], list[SightingPose]]:
        """Keyframes, segments, drives and poses of sightings."""
        return self.keyframes, self.segments, self.drives, self.sighting_poses

    def newer_keyframes(self, first: int) -> list[Keyframe]:
        """The keyframes from a number on, without those that were condensed."""
        return self.keyframes[max(first - self.first_keyframe, 0) :]

    @property
    def keyframe_count(self) -> int:
        """The number of keyframes, condensed ones included."""
        return self.first_keyframe + len(self.keyframes)

    @property
    def frozen_edges(self) -> int:
        """The number of edges whose verdicts are final."""
        return self.ledger.final

    @property
    def vertices(self) -> list[int]:
        """The vertices of the problem. The others belonged to removed landmarks."""
        poses = {one.vertex for one in self.keyframes}
        poses |= {one.vertex for one in self.bounded.old} if self.bounded else set()
        points = {mark.vertex for mark in self.landmarks.values()}
        return sorted(poses | points)

    def freeze(self) -> None:
        """Fix everything. Landmarks that are too new are removed first.

        All of its edges must have been judged.
        """
        for name in [name for name, mark in self.landmarks.items() if mark.is_tentative]:
            self._prune(name)
        self.frozen = self.graph.vertex_count
        self.ledger.finish(self.graph.edge_count)

    def _prune(self, name: str) -> None:
        mark, last = self.landmarks.pop(name), self.keyframe_count - 1
        for edge in [one.edge for one in mark.seen]:
            self.graph.set_weights(np.array([edge]), 0.0)
            statistic = float(self.ledger.statistic.values[edge])
            self.ledger.note(edge, last, Verdict.REJECTED, Reason.WITHDRAWN, statistic)

    def touched_landmarks(self, first: int) -> dict[str, Landmark | None]:
        """All of them, but for the first so many."""
        return dict(list(self.landmarks.items())[first:])

    @property
    def landmark_changes(self) -> int:
        """The number of landmarks, each of which is one change."""
        return len(self.landmarks)
