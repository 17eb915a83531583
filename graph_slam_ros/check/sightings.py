"""The sightings of one input as columns of numbers, and how they are collected."""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from graph_slam_ros.check.located import located, moved
from graph_slam_ros.lie import se3
from graph_slam_ros.measurements.types import Sightings
from graph_slam_ros.typing import Array, Index, Mask, Numbers

MOST = 200_000
"""Messages of each topic that are collected; a replay looks into no more."""


@dataclass(frozen=True, slots=True, eq=False)
class SightingColumns:
    """The sightings of one input, as a replay uses them.

    Attributes
    ----------
    stamp_ns, message : (k,) stamp, and number of the message
    names, name : identities, and (k,) the number of each sighting's; the empty one is of those without
    points : (k, 3) in the base frame; NaN of a range or bearing alone
    ranges : (k,) of a range alone [m]; NaN of others
    bearings : (k,) of a bearing alone, in the plane or horizontal [rad]; NaN of others
    sigmas : (k,) of the position or range [m], or of a bearing alone [rad]
    frame, T_base_frame : the frame of the first message, and where it is on the robot
    """

    input: str
    topic: str
    stamp_ns: Index
    message: Index
    names: tuple[str, ...]
    name: Index
    points: Array
    ranges: Array
    bearings: Array
    sigmas: Array
    frame: str
    T_base_frame: se3.Pose

    def some(self, which: Mask) -> "SightingColumns":
        """Return the columns of some of the sightings."""
        rows = ("stamp_ns", "message", "name", "points", "ranges", "bearings", "sigmas")
        return replace(self, **{row: getattr(self, row)[which] for row in rows})


class SightingCollector:
    """Collects the sightings of one input.

    Parameters
    ----------
    mount : x, y, z, roll, pitch, yaw by which the sensor's mount is corrected [m, rad]
    """

    def __init__(self, name: str, topic: str, mount: Numbers) -> None:
        self.input, self.topic, self._mount = name, topic, mount
        self.frame, self.T_base_frame = "", se3.IDENTITY
        self.begin_anew()

    def begin_anew(self) -> None:
        """Drop all sightings."""
        self.stamp_ns, self.message, self.name = array("q"), array("q"), array("q")
        self.points, self.ranges, self.bearings, self.sigmas = array("d"), array("d"), array("d"), array("d")
        self.names: dict[str, int] = {}
        self._messages = 0

    def add(self, m: Sightings, heights: Mapping[str, float]) -> None:
        """Collect a message, with the heights of landmarks above the base [m], by id, which the plane does not have."""
        if len(self.stamp_ns) >= MOST:
            return
        self._messages += 1
        for one in m.sightings:
            point, sigma = located(one)
            if one.id in heights:
                point = point[0], point[1], heights[one.id]
            self.stamp_ns.append(m.stamp_ns)
            self.message.append(self._messages)
            self.name.append(self.names.setdefault(one.id, len(self.names)))
            self.points.extend(point)
            self.ranges.append(one.measured[0] if one.kind == "range" else np.nan)
            self.bearings.append(one.measured[0] if one.kind == "bearing" else np.nan)
            self.sigmas.append(sigma)

    def columns(self) -> SightingColumns:
        """Everything that was collected."""
        numbers = (index(self.stamp_ns), index(self.message), tuple(self.names), index(self.name))
        points = moved(np.array(self.points).reshape(-1, 3), self.T_base_frame, self._mount)
        return SightingColumns(
            self.input,
            self.topic,
            *numbers,
            points,
            np.array(self.ranges),
            np.array(self.bearings),
            np.array(self.sigmas),
            self.frame,
            self.T_base_frame,
        )


def index(numbers: "array[int]") -> Index:
    """The same numbers as an array."""
    return np.array(numbers, dtype=np.int64)
