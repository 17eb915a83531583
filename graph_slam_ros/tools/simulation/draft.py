"""A draft of measurements, into which faults are put before it becomes a recording, and the tables of what is wrong."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Literal

import numpy as np

from graph_slam_ros.formats.g2o_writer import write_text
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Closure, Sighting
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC
from graph_slam_ros.typing import Array, Index, Numbers

Measured = Literal["odometry", "sighting", "closure"]


@dataclass(slots=True)
class Draft:
    """Odometry, sightings and closures of n poses, in order of time.

    Attributes
    ----------
    truth : (n, 3) or (n, 7) true poses
    odometry : the same by dead reckoning
    twist : (n, d) velocity since the pose before
    sightings, seen_at : what was seen, and (m,) from which pose
    landmarks : true places by id
    stamps_ns : (n,)
    closures : true ones; false ones are added
    wrong : by what was measured and its number (of odometry the later pose's), the faults that hit it
    true_ids : of the landmarks that were really seen, whatever ids the sightings have now
    """

    space: Geometry
    truth: Array
    odometry: Array
    twist: Array
    sightings: list[Sighting]
    seen_at: Index
    landmarks: Mapping[str, Numbers]
    stamps_ns: Index
    closures: list[Closure]
    wrong: dict[tuple[Measured, int], list[str]] = field(default_factory=dict)
    true_ids: list[str] = field(init=False)

    def __post_init__(self) -> None:
        self.true_ids = [s.id for s in self.sightings]

    def __len__(self) -> int:
        return len(self.odometry)

    def pose_at(self, fraction: float) -> int:
        """The pose at a fraction of the drive: 0 is the first, 1 the last."""
        return round(fraction * (len(self) - 1))

    def mark(self, what: Measured, number: int, fault: str) -> None:
        """Note that a fault has hit a measurement."""
        faults = self.wrong.setdefault((what, number), [])
        if fault not in faults:
            faults.append(fault)

    def spoil(self, number: int, fault: str, sighting: Sighting) -> None:
        """Replace a sighting by a wrong one."""
        self.mark("sighting", number, fault)
        self.sightings[number] = sighting

    def spoil_odometry(self, later: Sequence[int], fault: str) -> None:
        """Mark the motion up to some poses as wrong."""
        for pose in later:
            self.mark("odometry", pose, fault)

    def add_closures(self, ends: Index, measured: Array, root: Array, fault: str) -> None:
        """Append false closures."""
        for (earlier, later), z, one in zip(self.stamps_ns[ends].tolist(), measured.tolist(), root, strict=True):
            self.mark("closure", len(self.closures), fault)
            covariance = np.linalg.inv(one.T @ one)
            flat = tuple((0.5 * (covariance + covariance.T)).ravel().tolist())
            self.closures.append(Closure(later, earlier, CLOSURES_TOPIC, tuple(z), flat))

    def seen_from(self, number: int, displaced: Array) -> Sighting:
        """A sighting as it would have been, with its noise, if the landmark had been elsewhere.

        Parameters
        ----------
        displaced : (2,) or (3,) by how much, in world
        """
        old, T_world_base = self.sightings[number], self.truth[self.seen_at[number]]
        n = self.space.dimensions
        if old.kind in ("position", "pose"):
            moved = np.array(old.measured)
            moved[:n] += self.space.turn(tuple(T_world_base)).T @ displaced
            return replace(old, measured=tuple(moved.tolist()))
        edge, at = self.space.sightings[old.kind], np.array([[0, len(T_world_base)]])
        whole = edge.whole(np.array([*old.measured, *(old.T_base_sensor or ())])[None])
        true = np.array(self.landmarks[self.true_ids[number]][:n])
        before, after = (
            edge.linearize(np.concatenate([T_world_base, place]), at, whole)[0][0] for place in (true, true + displaced)
        )
        moved = old.measured + after - before
        angles = slice("range" in old.kind, None)
        moved[angles] = se2.wrap(moved[angles])
        return replace(old, measured=tuple(moved.tolist()))


@dataclass(frozen=True, slots=True)
class WrongMessage:
    """A row of a recording's table: a wrong message, or one of its detections.

    Attributes
    ----------
    index : of the detection or point in its message; empty of odometry
    id : that it carries; of a closure, the earlier stamp
    true_id : the landmark that was seen
    """

    topic: str
    stamp_ns: int
    index: int | str
    id: str
    fault: str
    true_id: str


@dataclass(frozen=True, slots=True)
class WrongLine:
    """A row of a graph's table: a wrong edge.

    Attributes
    ----------
    line : of the file, from 1
    first, second : ids of its vertices, as in the file
    true_second : empty of a closure
    """

    line: int
    tag: str
    first: int
    second: int
    fault: str
    true_second: str = ""


def write_table(path: Path | str, of: type, rows: Sequence[WrongMessage] | Sequence[WrongLine]) -> None:
    """Write a table as CSV, below the names of the fields. Raises FormatError."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(of))
    writer.writerows(astuple(row) for row in rows)
    write_text(path, text.getvalue())
