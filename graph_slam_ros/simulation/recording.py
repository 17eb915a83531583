"""What a simulated robot records, and the truth it does not know."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.lie import se2
from graph_slam_ros.slam import Odometry, Sighting, Sightings

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

START_NS = 1_700_000_000 * 10**9  # a plausible date: stamps near zero would hide faults of precision
LANDMARKS_TOPIC = "/landmarks"


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Landmarks seen at one stamp, in frame base_link.

    Attributes
    ----------
    measured : (k, 2) positions [m], or (k, 3) poses where orientation is seen too [m, rad]
    covariance : (k, 2, 2) or (k, 3, 3) in the axes of base_link, as a ROS message carries it
    """

    stamp_ns: int
    ids: tuple[str, ...]
    measured: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A drive: odometry and sightings as measured, poses and landmarks as they are.

    Attributes
    ----------
    stamps_ns : (n,) stamps of odometry and of the true poses
    T_odom_base : (n, 3) dead-reckoned poses, from (0, 0, 0) [m, rad]
    twist : (n, 3) measured velocity in base_link since the stamp before; the first is zero [m/s, rad/s]
    twist_covariance : (3, 3) of each twist: the truth about the noise that was added
    odom_covariance : (n, 3, 3) of ``T_odom_base`` in its tangent space
    seen : in order of stamp, each at a stamp of odometry
    T_world_base : (n, 3) true poses
    landmarks : true poses (x, y, theta) in world by id; theta is 0 for a point
    """

    stamps_ns: Stamps
    T_odom_base: Array
    twist: Array
    twist_covariance: Array
    odom_covariance: Array
    seen: tuple[Seen, ...]
    T_world_base: Array
    landmarks: dict[str, se2.Pose]


def measurements(recording: Recording) -> Iterator[Odometry | Sightings]:
    """What ``GraphSlam.process`` takes, in order of stamp, odometry before what was seen at the same stamp."""
    twist_covariance = tuple(recording.twist_covariance.ravel().tolist())
    seen = {s.stamp_ns: s for s in recording.seen}
    for stamp_ns, pose in zip(recording.stamps_ns.tolist(), recording.T_odom_base.tolist(), strict=True):
        yield Odometry(stamp_ns, tuple(pose), twist_covariance)
        if stamp_ns in seen:
            yield _sightings(seen[stamp_ns])


def _sightings(seen: Seen) -> Sightings:
    rows = zip(seen.ids, seen.measured.tolist(), seen.covariance, strict=True)
    kind = "position" if seen.measured.shape[1] == 2 else "pose"
    found = [Sighting(name, kind, tuple(z), tuple(_in_tangent(z, c).ravel().tolist())) for name, z, c in rows]
    return Sightings(seen.stamp_ns, LANDMARKS_TOPIC, tuple(found))


def _in_tangent(measured: list[float], covariance: Array) -> Array:
    """A pose's covariance from the axes of base_link to its own; a point's stays."""
    if len(measured) == 2:
        return covariance
    c, s = np.cos(measured[2]), np.sin(measured[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T
