"""A map that a run can continue: everything of a run except unfinished work."""

from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graph_slam_ros.graph import Graph
from graph_slam_ros.measurements.edits import AppliedEdit
from graph_slam_ros.slam.frontend.gyro import SavedBias
from graph_slam_ros.slam.frontend.keyframes import Keyframe, SightingPose
from graph_slam_ros.slam.frontend.stamped_poses import StampedPoses
from graph_slam_ros.slam.landmarks.landmark import Landmark
from graph_slam_ros.slam.lifelong.state import BoundedState
from graph_slam_ros.slam.noise.factors import Key
from graph_slam_ros.slam.robust.ledger import Ledger, Reason, Verdict
from graph_slam_ros.typing import Array


@dataclass(slots=True)
class MapSnapshot:
    """A map: its graph, its verdicts, and where it is thought to be; named as in ``GraphSlam``.

    Attributes
    ----------
    values : stored numbers of all vertices, as ``Graph.initial``: where solving begins
    frozen : vertices below this id stay there, and verdicts on what is between them as they are
    held : vertices and edges below these ids were held when localization began (``map.localize``), or zeros
    datum : of fixes on earth, as in ``Fix``
    settings : parameters that were changed on the way, by name
    displacements : alarms by then, of all drives, as in ``run.json``
    processed : records of the ingest sequence that it came of
    used_ns : stamp of the last odometry that was used by then; None before the first
    noise_factors : of the configured sigmas, that the edges have, as ``NoiseScales.factors``
    calibration : factors of odometry that the association found, with those configured, by input and name
    edits : by hand, in order
    gyro_bias : of the gyro, as far as it was learnt; None without a gyro
    bounded : what a condensed map has besides; None where nothing was condensed
    folder : path of the run that it was read of, which has what was condensed; None where it is of none
    drive : what the next odometry continues beside the map, as of ``KeyframeFrontend``
    continues : whether the next odometry belongs to the same drive; else a new one begins
    """

    graph: Graph = field(default_factory=Graph)
    ledger: Ledger = field(default_factory=Ledger)
    values: Array = field(default_factory=lambda: np.zeros(0))
    keyframes: StampedPoses[Keyframe] = field(default_factory=lambda: StampedPoses(Keyframe, 3))
    segments: list[int] = field(default_factory=list)
    drives: list[int] = field(default_factory=list)
    sighting_poses: StampedPoses[SightingPose] = field(default_factory=lambda: StampedPoses(SightingPose, 3))
    landmarks: dict[str, Landmark] = field(default_factory=dict)
    frozen: int = 0
    held: tuple[int, int] = (0, 0)
    datum: tuple[float, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    displacements: list[dict[str, Any]] = field(default_factory=list)
    processed: int = 0
    used_ns: int | None = None
    drive: dict[str, Any] = field(default_factory=dict)
    continues: bool = False
    noise_factors: dict[Key, float] = field(default_factory=dict)
    edits: list[AppliedEdit] = field(default_factory=list)
    calibration: dict[tuple[str, str], float] = field(default_factory=dict)
    gyro_bias: SavedBias | None = None
    bounded: BoundedState | None = None
    folder: Any = None

    def copy(self) -> "MapSnapshot":
        """Return another one, which changes by itself."""
        return deepcopy(self, {id(self.graph): self.graph.copy()})  # kinds are shared

    @property
    def vertices(self) -> list[int]:
        """The vertices of the problem. The others belonged to removed landmarks."""
        poses = set(self.keyframes.ids.tolist())
        poses |= {one.vertex for one in self.bounded.old.values()} if self.bounded else set()
        points = {mark.vertex for mark in self.landmarks.values()}
        return sorted(poses | points)

    def freeze(self) -> None:
        """Fix everything. Landmarks that are too new are removed first.

        All of its edges must have been judged.
        """
        for name in [name for name, mark in self.landmarks.items() if mark.is_tentative]:
            self._prune(name)
        self.frozen = self.graph.vertex_ids.next
        self.ledger.finish(self.graph.edge_ids.next)

    def _prune(self, name: str) -> None:
        mark, last = self.landmarks.pop(name), len(self.keyframes) - 1
        for edge in [one.edge for one in mark.seen]:
            self.graph.set_weights(np.array([edge]), 0.0)
            statistic = float(self.ledger.statistic.values[self.ledger.ids.row(edge)])
            self.ledger.note(edge, last, Verdict.REJECTED, Reason.WITHDRAWN, statistic)
