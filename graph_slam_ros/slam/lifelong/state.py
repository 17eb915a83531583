"""The state of a condensed map that is not in its graph."""

from collections import Counter
from dataclasses import dataclass, field

from graph_slam_ros.slam.frontend.attached import AttachedKeyframes
from graph_slam_ros.slam.lifelong.condenser import Cell
from graph_slam_ros.slam.lifelong.fit import VisitScale
from graph_slam_ros.slam.lifelong.place_edge import PlaceEdge
from graph_slam_ros.slam.lifelong.removed import OldKeyframe
from graph_slam_ros.slam.lifelong.skeleton import Skeleton


@dataclass(slots=True)
class BoundedState:
    """The state of a condensed map that is not in its graph.

    Attributes
    ----------
    places : by cell
    scale : of the variances of visits
    old : the keyframes in the graph that are in no list of keyframes any more, in order of time
    skeleton : where keyframes of visits that are in no place have stayed
    attached : the keyframes that have left the map, where closures may begin at them
    keyframes, sightings, frames : how many have left the map
    accepted : of each drive, by its first keyframe, how many accepted measurements of each input have left the map
    begins : of each drive, by its first keyframe, if that has left: how many poses of sightings are before it
    made : lasting ids of the closures in the graph that condensing has made of others: they are no measurements
    """

    places: dict[Cell, list[PlaceEdge]] = field(default_factory=dict)
    scale: VisitScale = field(default_factory=VisitScale)
    old: list[OldKeyframe] = field(default_factory=list)
    skeleton: Skeleton = field(default_factory=Skeleton)
    attached: AttachedKeyframes = field(default_factory=AttachedKeyframes)
    keyframes: int = 0
    sightings: int = 0
    frames: int = 0
    accepted: dict[int, Counter[str]] = field(default_factory=dict)
    begins: dict[int, int] = field(default_factory=dict)
    made: set[int] = field(default_factory=set)
