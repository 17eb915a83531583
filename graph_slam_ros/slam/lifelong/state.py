"""The state of a condensed map that is not in its graph, and the keyframes that have left it.

Each of these is stored relative to its base, a vertex that stays, and moves with it.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import FormatError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.frontend.keyframes import Keyframe
from graph_slam_ros.slam.lifelong.place import Cell, PlaceEdge, VisitScale
from graph_slam_ros.typing import Array, Index

Records = NDArray[np.void]
"""Rows of ``record_type``."""


def record_type(space: Geometry) -> np.dtype[np.void]:
    """Return the type of a record: of a keyframe, or of the pose at which something was seen.

    ``stamp_ns``; ``of``, the lasting id of the keyframe's vertex; ``base``, that of the vertex relative to which
    ``T_base`` is (of what was seen from a keyframe its number, in both); ``T_odom``, the pose by odometry alone.
    """
    size = space.pose.size
    poses = [("T_base", "<f8", (size,)), ("T_odom", "<f8", (size,))]
    return np.dtype([("stamp_ns", "<i8"), ("of", "<i8"), ("base", "<i8"), *poses])


@dataclass(slots=True)
class BoundedState:
    """The state of a condensed map that is not in its graph.

    Attributes
    ----------
    places : by cell
    scale : of the variances of visits
    old : by number, the keyframes in the graph that are in no list of keyframes any more, in order of time: bases of
        places, and those that were kept
    keyframes, sightings : how many have left the map
    accepted : of each drive, by its first keyframe, how many accepted measurements of each input have left the map
    begins : of each drive, by its first keyframe, if that has left: how many poses of sightings are before it
    """

    places: dict[Cell, list[PlaceEdge]] = field(default_factory=dict)
    scale: VisitScale = field(default_factory=VisitScale)
    old: dict[int, Keyframe] = field(default_factory=dict)
    keyframes: int = 0
    sightings: int = 0
    accepted: dict[int, Counter[str]] = field(default_factory=dict)
    begins: dict[int, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Left:
    """The part that has left a map: keyframes, and poses at which something was seen from them."""

    keyframes: Records
    sightings: Records

    @classmethod
    def joined(cls, space: Geometry, several: Sequence["Left"]) -> "Left":
        """Return all of several, in order of time."""
        none = np.empty(0, dtype=record_type(space))
        keyframes, sightings = [one.keyframes for one in several], [one.sightings for one in several]
        return cls(np.concatenate([none, *keyframes]), np.concatenate([none, *sightings]))

    def path(self, space: Geometry, ids: Index, poses: Array) -> Array:
        """Return the present poses ``T_map`` of removed keyframes, (n, size).

        Parameters
        ----------
        ids, poses : lasting ids of the vertices that are in the graph, ascending, and their estimates

        Raises
        ------
        FormatError
            The base of one of them is not in the graph.
        """
        base = self.keyframes["base"]
        if len(lost := np.flatnonzero(~np.isin(base, ids))):
            raise FormatError(f"keyframe {lost[0]}: its base, vertex {base[lost[0]]}, is not there")
        return _moved(space, poses[np.searchsorted(ids, base)], self.keyframes["T_base"])


def seen_from(space: Geometry, seen: Records, poses: Array) -> Array:
    """Return the present poses at which something was seen from removed keyframes, whose poses (n, size) are given."""
    return _moved(space, poses[seen["of"]], seen["T_base"])


def _moved(space: Geometry, base: Array, relative: Array) -> Array:
    return np.stack(space.group.compose(tuple(base.T), tuple(relative.T)), axis=-1)
