"""The records of landmarks: of the graph, or not determined yet; and of their sightings."""

from dataclasses import dataclass, field

from graph_slam_ros.measurements.types import Sighting
from graph_slam_ros.slam.frontend.motion_compensation import PoseAtStamp
from graph_slam_ros.slam.landmarks.triangulation import PositionHypothesis


@dataclass(frozen=True, slots=True)
class LandmarkEdge:
    """One sighting of a landmark, and its edge."""

    edge: int
    topic: str
    sighting: Sighting
    where: PoseAtStamp


@dataclass(slots=True)
class Landmark:
    """A landmark of the graph.

    Attributes
    ----------
    is_unnamed : whether no sighting of it tells which it is
    is_tentative : whether it is too new to be believed: it may be given up
    sort : its class, by its sightings; empty where none has one
    size : the mean of the sizes of its sightings [m]; zero where none has one
    sized : sightings with a size
    seen : its sightings that do not tell which it is: they may change hands
    stamps : of these; a landmark is never seen twice at once
    """

    name: str
    vertex: int
    is_unnamed: bool = False
    is_tentative: bool = False
    sightings: int = 0
    first_seen_ns: int = 0
    last_seen_ns: int = 0
    sort: str = ""
    size: float = 0.0
    sized: int = 0
    seen: list[LandmarkEdge] = field(default_factory=list)
    stamps: set[int] = field(default_factory=set)

    def note_features(self, sort: str, size: float, sized: int = 1) -> None:
        """Take over class and size of a sighting, or the mean size of several."""
        self.sort = self.sort or sort
        if size and sized:
            self.sized += sized
            self.size += (size - self.size) * sized / self.sized

    def take_over(self, other: "Landmark") -> None:
        """Add the counts, stamps, class and size of a landmark that is the same one."""
        self.note_features(other.sort, other.size, other.sized)
        self.sightings += other.sightings
        self.first_seen_ns = min(self.first_seen_ns, other.first_seen_ns)
        self.last_seen_ns = max(self.last_seen_ns, other.last_seen_ns)

    def reset_features(self) -> None:
        """Compute class and size anew from its sightings."""
        self.sort, self.size, self.sized = "", 0.0, 0
        for one in self.seen:
            self.note_features(one.sighting.sort, one.sighting.size)


@dataclass(slots=True)
class UndeterminedLandmark:
    """A landmark without a vertex yet: its sightings, its possible positions, and why they are not enough."""

    topic: str
    seen: list[tuple[PoseAtStamp, Sighting]] = field(default_factory=list)
    places: list[PositionHypothesis] = field(default_factory=list)
    reason: str = ""
