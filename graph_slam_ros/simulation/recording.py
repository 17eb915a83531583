"""A simulated recording, and the truth it does not know."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph_slam_ros.slam import Closure, Odometry, Sightings
from graph_slam_ros.typing import Array, Numbers

Stamps = NDArray[np.int64]

START_NS = 1_700_000_000 * 10**9  # a plausible date: stamps near zero would hide faults of precision
LANDMARKS_TOPIC = "/landmarks"
CLOSURES_TOPIC = "/closures"


@dataclass(frozen=True, slots=True, eq=False)
class Gnss:
    """The measurements of a satellite receiver.

    Attributes
    ----------
    stamps_ns : (n,)
    geodetic : (n, 3) latitude [deg], longitude [deg] and height above the ellipsoid [m] of the antenna
    covariance : (3, 3) of each: the truth about the noise that was added, east, north and up [m^2]
    has_fix : (n,) where it does not, it says so
    antenna : in base_link [m]; None where no transform tells
    """

    stamps_ns: Stamps
    geodetic: Array
    covariance: Array
    has_fix: NDArray[np.bool_]
    antenna: Numbers | None


@dataclass(frozen=True, slots=True, eq=False)
class Imu:
    """The measurements of an inertial measurement unit.

    Attributes
    ----------
    stamps_ns : (n,)
    orientation : (n, 4) quaternions (x, y, z, w) of R_world_imu
    covariance : (3, 3) of each about the axes of world, without its drift [rad^2]
    rate, acceleration : (n, 3) in its own axes [rad/s, m/s^2]
    T_base_imu : where it is
    """

    stamps_ns: Stamps
    orientation: Array
    covariance: Array
    rate: Array
    acceleration: Array
    T_base_imu: Numbers


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A drive or flight: odometry and sightings as measured, poses and landmarks as they are.

    Poses have 3 numbers in the plane and 7 in space, velocities 3 and 6 (d), in tangent order.

    Attributes
    ----------
    stamps_ns : (n,) stamps of odometry and of the true poses
    T_odom_base : (n, 3) or (n, 7) dead-reckoned poses, from the origin [m, rad]
    twist : (n, d) measured velocity in base_link since the stamp before; the first is zero [m/s, rad/s]
    twist_covariance : (d, d) of each twist: the truth about the noise that was added
    odom_covariance : (n, d, d) of ``T_odom_base`` in its tangent space
    seen : in order of stamp, each at a stamp of odometry
    T_world_base : (n, 3) or (n, 7) true poses
    landmarks : true poses in world by id; of points the position alone
    closures : in order of their later stamp; both are stamps of odometry
    gnss, imu : None where the robot has none
    """

    stamps_ns: Stamps
    T_odom_base: Array
    twist: Array
    twist_covariance: Array
    odom_covariance: Array
    seen: tuple[Sightings, ...]
    T_world_base: Array
    landmarks: dict[str, Numbers]
    closures: tuple[Closure, ...] = ()
    gnss: Gnss | None = None
    imu: Imu | None = None

    def closures_at(self) -> dict[int, list[Closure]]:
        """The closures of each later stamp."""
        out: dict[int, list[Closure]] = {}
        for closure in self.closures:
            out.setdefault(closure.stamp_ns, []).append(closure)
        return out


def measurements(recording: Recording) -> Iterator[Odometry | Sightings | Closure]:
    """Return what ``GraphSlam.process`` takes, in order of stamp, odometry before what was seen at the same stamp.

    What a satellite receiver or an IMU says is not among it: that becomes a fix at the border, from a bag.
    """
    twist_covariance = tuple(recording.twist_covariance.ravel().tolist())
    seen = {s.stamp_ns: s for s in recording.seen}
    closed = recording.closures_at()
    for stamp_ns, pose in zip(recording.stamps_ns.tolist(), recording.T_odom_base.tolist(), strict=True):
        yield Odometry(stamp_ns, tuple(pose), twist_covariance)
        if stamp_ns in seen:
            yield seen[stamp_ns]
        yield from closed.get(stamp_ns, ())
