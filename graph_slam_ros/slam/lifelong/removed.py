"""Keyframes that left the map: each is stored relative to a frame or another pose, its base, and moves with it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.errors import FormatError
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.slam.lifelong.frames import Frames, PresentLandmarks
from graph_slam_ros.typing import Array, Index, Numbers

Records = NDArray[np.void]
"""Rows of ``record_type``."""


def record_type(space: Geometry) -> np.dtype[np.void]:
    """Return the type of a record: of a keyframe, or of the pose at which something was seen.

    ``stamp_ns``; ``of``, the lasting id of the keyframe's vertex; ``base``, that of the vertex relative to which
    ``T_base`` is, or -1 - n of frame n (of what was seen from a keyframe its number, in both); ``T_odom``, the pose by
    odometry alone.
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


@dataclass(frozen=True, slots=True)
class Left:
    """The part that has left a map: keyframes, poses at which something was seen from them, and their frames.

    Attributes
    ----------
    attached : of each keyframe a row of ``attached.attached_type``; None where no closure may begin at them
    """

    keyframes: Records
    sightings: Records
    frames: Frames
    attached: Records | None = None

    @classmethod
    def joined(cls, space: Geometry, several: Sequence["Left"]) -> "Left":
        """Return all of several, in order of time."""
        keyframes = [no_records(space), *(one.keyframes for one in several)]
        sightings = [no_records(space), *(one.sightings for one in several)]
        frames = Frames.joined(space, [one.frames for one in several])
        return cls(np.concatenate(keyframes), np.concatenate(sightings), frames)

    def path(self, space: Geometry, ids: Index, poses: Array, landmarks: PresentLandmarks) -> Array:
        """Return the present poses ``T_map`` of removed keyframes, (n, size).

        Parameters
        ----------
        ids, poses : lasting ids of the vertices that are in the graph, ascending, and their estimates

        Raises
        ------
        FormatError
            The base of one of them is neither in the graph nor removed, or a frame is missing.
        """
        records, frames = self.keyframes, self.frames
        out, known = np.empty((len(records), space.pose.size)), np.zeros(len(records), dtype=bool)
        if len(frames):
            at, is_there = _found(ids, frames.rows["base"])
            if not is_there.all():
                raise FormatError(f"frame {int(np.argmin(is_there))}: its base is not there")
            of_frames = frames.poses(space, poses[at], landmarks)
            known = records["base"] < 0
            number = -1 - records["base"][known]
            if len(number) and number.max() >= len(frames):
                raise FormatError(f"frame {int(number.max())} is not there")
            out[known] = _moved(space, of_frames[number], records["T_base"][known])
        at, is_there = _found(ids, records["base"])
        out[is_there] = _moved(space, poses[at[is_there]], records["T_base"][is_there])
        known = known | is_there
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


def _found(ids: Index, wanted: Index) -> tuple[Index, NDArray[np.bool_]]:
    """Return where some ids are among others, which ascend, and whether they are."""
    return np.minimum(np.searchsorted(ids, wanted), max(len(ids) - 1, 0)), np.isin(wanted, ids)


def seen_from(space: Geometry, seen: Records, poses: Array) -> Array:
    """Return the present poses at which something was seen from removed keyframes, whose poses (n, size) are given."""
    return _moved(space, poses[seen["of"]], seen["T_base"])


def _moved(space: Geometry, base: Array, relative: Array) -> Array:
    return np.stack(space.group.compose(tuple(base.T), tuple(relative.T)), axis=-1)
