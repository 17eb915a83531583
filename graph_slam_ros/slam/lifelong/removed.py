"""Keyframes that left the map: each is told relative to a pose that stays, its base, and moves with it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import FormatError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.typing import Array, Index, Numbers

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


def no_records(space: Geometry) -> Records:
    """Return no record."""
    return np.empty(0, dtype=record_type(space))


@dataclass(frozen=True, slots=True)
class OldKeyframe:
    """A keyframe that is in the graph, and in no list of keyframes any more: the base of a place, or one that was kept.

    Attributes
    ----------
    number : of the keyframe; vertex : its id in the graph
    """

    number: int
    vertex: int
    stamp_ns: int
    T_odom_base: Numbers


def composed(space: Geometry, records: Records, ids: Index, poses: Array) -> Array:
    """Return the present poses ``T_map`` of removed keyframes, (n, size).

    Parameters
    ----------
    records : of all removed keyframes, in order of time
    ids, poses : lasting ids of the vertices that are in the graph, ascending, and their estimates

    Raises
    ------
    FormatError
        The base of one of them is neither in the graph nor removed.
    """
    out, known = np.empty((len(records), space.pose.size)), np.zeros(len(records), dtype=bool)
    at = np.searchsorted(ids, records["base"])
    is_there = (at < len(ids)) & (ids[np.minimum(at, max(len(ids) - 1, 0))] == records["base"] if len(ids) else False)
    out[is_there] = _moved(space, poses[at[is_there]], records["T_base"][is_there])
    known |= is_there
    order = np.argsort(records["of"], kind="stable")
    while not known.all():  # their base was removed later: it is among the records
        wait = np.flatnonzero(~known)
        place = np.minimum(np.searchsorted(records["of"][order], records["base"][wait]), len(order) - 1)
        base = order[place]
        ready = known[base] & (records["of"][base] == records["base"][wait])
        if not ready.any():
            raise FormatError(
                f"keyframe {int(wait[0])}: its base, vertex {int(records['base'][wait[0]])}, is not there"
            )
        out[wait[ready]] = _moved(space, out[base[ready]], records["T_base"][wait[ready]])
        known[wait[ready]] = True
    return out


def seen_from(space: Geometry, seen: Records, poses: Array) -> Array:
    """Return the present poses at which something was seen from removed keyframes, whose poses (n, size) are given."""
    return _moved(space, poses[seen["of"]], seen["T_base"])


def _moved(space: Geometry, base: Array, relative: Array) -> Array:
    return np.stack(space.group.compose(tuple(base.T), tuple(relative.T)), axis=-1)
