"""Faults of drivers, clocks and frames, put into the messages of a recording: what ``graph_slam check`` finds."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.lie import se3
from graph_slam_ros.tools.simulation.drive import DETECTIONS, POINTS, TRANSFORMS, Drive, Message, Sightings
from graph_slam_ros.tools.simulation.odometry_faults import AT, CHANGED, ODOMETRY_KINDS
from graph_slam_ros.tools.simulation.options import Kind, option
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC
from graph_slam_ros.tools.simulation.recording_faults import RECORDING_KINDS
from graph_slam_ros.typing import Array

_IMU = "sensor_msgs/msg/Imu"
_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_OF_THE_ROBOT = (_IMU, "sensor_msgs/msg/NavSatFix", DETECTIONS, POINTS, TRANSFORMS, *_POSES)


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """Landmarks that are stamped too late, or too early where it is negative."""

    seconds: float = option(0.1, "by so much", "s", -1e10, 1e10)


@dataclass(frozen=True, slots=True)
class ClockDrift:
    """Landmarks whose clock runs too fast."""

    ppm: float = option(500.0, "by so many millionths", "ppm", -1e5, 1e5)


@dataclass(frozen=True, slots=True)
class ClockJump:
    """Landmarks whose clock is set on the way."""

    seconds: float = option(0.2, "by so much", "s", -1e5, 1e5)
    at: float = option(0.5, AT, "", 0, 1)


@dataclass(frozen=True, slots=True)
class Uptime:
    """Landmarks that are stamped by the time since their computer was started."""

    seconds: float = option(1000.0, "at the first message", "s", 0, 1e9)


@dataclass(frozen=True, slots=True)
class ZeroStamps:
    """Landmarks whose driver leaves stamps at zero."""

    rate: float = option(0.3, CHANGED, "", 0, 1)


@dataclass(frozen=True, slots=True)
class ClockSetBack:
    """A clock of the whole robot that is set back."""

    seconds: float = option(30.0, "by so much", "s", 0, 1e9)
    at: float = option(0.5, AT, "", 0, 1)


@dataclass(frozen=True, slots=True)
class WrongFrames:
    """Messages with the names of other frames."""

    odometry: str = option("kept", "frame of odometry", choices=("kept", "map", "world"))
    landmarks: str = option("camera_link", "frame of landmarks", choices=("kept", "camera_link", "odom", "map"))


@dataclass(frozen=True, slots=True)
class TwoParents:
    """A frame of the sensor that two nodes publish, below two frames."""


@dataclass(frozen=True, slots=True)
class WrongMount:
    """A sensor that is turned on the robot, or sits elsewhere, and nobody says so."""

    yaw_deg: float = option(5.0, "turned to the left", "degrees", -180, 180)
    x_m: float = option(0.0, "ahead of where it should be", "m", -10, 10)
    y_m: float = option(0.0, "to the left of it", "m", -10, 10)


@dataclass(frozen=True, slots=True)
class WrongAxes:
    """Landmarks in other axes than x ahead and y to the left."""

    how: str = option("mirrored", "which", choices=("mirrored", "exchanged", "optical", "backwards", "left", "right"))


@dataclass(frozen=True, slots=True)
class WrongUnits:
    """Landmarks in other units than metres or radians."""

    factor: float = option(1000.0, "so many for each metre or radian", "", 1e-6, 1e6)
    of: str = option("lengths", "which numbers", choices=("lengths", "bearings"))


@dataclass(frozen=True, slots=True)
class TinyCovariance:
    """Landmarks whose covariance is smaller than any sensor's."""

    sigma: float = option(1e-6, "its standard deviations", "m, rad", 0, 1e3)


@dataclass(frozen=True, slots=True)
class Noisy:
    """Landmarks that are worse than their covariance."""

    factor: float = option(8.0, "so many times, at least of 5 cm", "", 0, 1e3)


@dataclass(frozen=True, slots=True)
class TrackIds:
    """Landmarks with ids of tracks: after a few sightings a new one."""

    sightings: int = option(2, "of one id", "", 1, 1e6)


@dataclass(frozen=True, slots=True)
class RandomIds:
    """Landmarks with ids of other landmarks, at random."""

    rate: float = option(1.0, "of all sightings", "", 0, 1)


@dataclass(frozen=True, slots=True)
class WrongGyro:
    """An IMU whose turn rates are wrong."""

    factor: float = option(1.2, "so many times as large", "", -1e3, 1e3)
    bias_rad_s: float = option(0.0, "larger by so much, about each axis", "rad/s", -10, 10)
    noise_rad_s: float = option(0.0, "wrong by so much at random, for a second at a time", "rad/s", 0, 100)
    late_s: float = option(0.0, "stamped too late by so much", "s", -1e5, 1e5)
    axes: str = option("kept", "which", choices=("kept", "exchanged"))


@dataclass(frozen=True, slots=True)
class NewIds:
    """Landmarks that nobody recognises: after a time all have new ids."""

    seconds: float = option(15.0, "how long", "s", 0.1, 1e6)


@dataclass(frozen=True, slots=True)
class Blind:
    """A sensor that sees nothing after a while."""

    after: float = option(0.25, AT, "", 0, 1)


def _stamped(change: Callable[[Any, Any, Generator], Any]) -> Callable[[Drive, Any, Generator], None]:
    """A fault of the stamps of landmarks."""
    return lambda drive, fault, rng: drive.restamp(drive.landmarks, lambda t: change(t, fault, rng))


def _clock_set_back(drive: Drive, fault: ClockSetBack, _rng: Generator) -> None:
    """All that the robot stamps; closures name an earlier stamp as well. The truth is of another clock."""
    at_ns, back_ns = np.quantile(drive.odometry_ns, fault.at), round(fault.seconds * NS)
    drive.restamp(drive.decoded(_OF_THE_ROBOT), lambda t: np.where(t > at_ns, t - back_ns, t))
    for m in drive.messages:
        for one in m.content.detections if m.topic == CLOSURES_TOPIC else ():
            if one.id.isdecimal() and int(one.id) > at_ns:
                one.id = str(int(one.id) - back_ns)
                for result in one.results:
                    result.hypothesis.class_id = one.id


def _wrong_frames(drive: Drive, fault: WrongFrames, _rng: Generator) -> None:
    for frame, messages in ((fault.odometry, drive.odometry), (fault.landmarks, drive.landmarks)):
        for m in messages if frame != "kept" else ():
            m.frame = frame


def _two_parents(drive: Drive, _fault: TwoParents, _rng: Generator) -> None:
    for m in drive.landmarks:
        m.frame = "camera_link"
    for parent in ("base_link", "lidar_link"):
        drive.add_transform(parent, "camera_link", se3.IDENTITY)


def _each(drive: Drive, change: Callable[[Sightings, Message], Array | None]) -> None:
    for m in drive.landmarks:
        seen = Sightings(m)
        turn = change(seen, m)
        seen.store(turn)


def _wrong_mount(drive: Drive, fault: WrongMount, _rng: Generator) -> None:
    """The sensor is turned to the left: it sees everything turned to the right."""
    angle = -np.radians(fault.yaw_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])

    def change(seen: Sightings, _: Message) -> Array:
        seen.points = (seen.points - [fault.x_m, fault.y_m, 0.0]) @ turn.T
        return turn

    _each(drive, change)


_AXES = {
    "mirrored": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "exchanged": [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    "optical": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
    "backwards": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "left": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "right": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}


def _wrong_axes(drive: Drive, fault: WrongAxes, _rng: Generator) -> None:
    turn = np.array(_AXES[fault.how], dtype=float)

    def change(seen: Sightings, _: Message) -> Array:
        seen.points = seen.points @ turn.T
        return turn

    _each(drive, change)


def _wrong_units(drive: Drive, fault: WrongUnits, _rng: Generator) -> None:
    for m in drive.landmarks:
        seen = Sightings(m)
        if fault.of == "bearings":
            seen.scale_bearings(fault.factor)
        else:
            seen.points = seen.points * fault.factor
            seen.store()


def _tiny_covariance(drive: Drive, fault: TinyCovariance, _rng: Generator) -> None:
    for m in drive.landmarks:
        Sightings(m).set_noise(fault.sigma)


def _noisy(drive: Drive, fault: Noisy, rng: Generator) -> None:
    def change(seen: Sightings, _: Message) -> None:
        sigmas = np.maximum(seen.sigmas, 0.05)[:, None] * [fault.factor, fault.factor, 0.0]
        seen.points = seen.points + sigmas * rng.standard_normal(seen.points.shape)

    _each(drive, change)


def _track_ids(drive: Drive, fault: TrackIds, _rng: Generator) -> None:
    times: dict[str, int] = {}
    names: dict[tuple[str, int], str] = {}

    def change(seen: Sightings, _: Message) -> None:
        for k, name in enumerate(seen.ids):
            times[name] = times.get(name, 0) + 1
            seen.ids[k] = names.setdefault((name, times[name] // fault.sightings), str(len(names)))

    _each(drive, change)


def _random_ids(drive: Drive, fault: RandomIds, rng: Generator) -> None:
    names = sorted({name for m in drive.landmarks for name in Sightings(m).ids})
    if len(names) < 2:
        raise GraphSlamError("random_ids: needs two ids")

    def change(seen: Sightings, _: Message) -> None:
        seen.ids = [names[rng.integers(len(names))] if rng.random() < fault.rate else name for name in seen.ids]

    _each(drive, change)


def _new_ids(drive: Drive, fault: NewIds, _rng: Generator) -> None:
    first_ns = drive.landmarks[0].stamp_ns
    names: dict[tuple[str, int], str] = {}

    def change(seen: Sightings, m: Message) -> None:
        period = int((m.stamp_ns - first_ns) / (fault.seconds * NS))
        seen.ids = [names.setdefault((name, period), str(len(names))) for name in seen.ids]

    _each(drive, change)


def _wrong_gyro(drive: Drive, fault: WrongGyro, rng: Generator) -> None:
    found = drive.decoded((_IMU,))
    if not found:
        raise GraphSlamError("wrong_gyro: needs an IMU")
    errors: dict[int, float] = {}
    for m in found:
        w = m.content.angular_velocity
        rates = (w.x, w.y, w.z) if fault.axes == "kept" else (w.z, w.x, w.y)
        second, error = m.log_ns // NS, fault.noise_rad_s * rng.standard_normal() if fault.noise_rad_s else 0.0
        wrong = fault.bias_rad_s + errors.setdefault(second, error)
        w.x, w.y, w.z = (fault.factor * rate + wrong for rate in rates)
        m.stamp_ns += round(fault.late_s * NS)


def _blind(drive: Drive, fault: Blind, _rng: Generator) -> None:
    at_ns = np.quantile(drive.odometry_ns, fault.after)
    drive.drop([m for m in drive.landmarks if m.stamp_ns >= at_ns])


MESSAGE_KINDS: dict[str, Kind] = {
    **ODOMETRY_KINDS,
    **RECORDING_KINDS,
    "clock_offset": Kind(ClockOffset, _stamped(lambda t, f, _: t + round(f.seconds * NS))),
    "clock_drift": Kind(ClockDrift, _stamped(lambda t, f, _: t + ((t - t[0]) * f.ppm * 1e-6).astype(np.int64))),
    "clock_jump": Kind(
        ClockJump, _stamped(lambda t, f, _: t + np.where(t > np.quantile(t, f.at), round(f.seconds * NS), 0))
    ),
    "uptime": Kind(Uptime, _stamped(lambda t, f, _: t - t[0] + round(f.seconds * NS))),
    "zero_stamps": Kind(ZeroStamps, _stamped(lambda t, f, rng: np.where(rng.random(len(t)) < f.rate, 0, t))),
    "clock_set_back": Kind(ClockSetBack, _clock_set_back),
    "wrong_frames": Kind(WrongFrames, _wrong_frames),
    "two_parents": Kind(TwoParents, _two_parents),
    "wrong_mount": Kind(WrongMount, _wrong_mount),
    "wrong_axes": Kind(WrongAxes, _wrong_axes),
    "wrong_units": Kind(WrongUnits, _wrong_units),
    "tiny_covariance": Kind(TinyCovariance, _tiny_covariance),
    "noisy": Kind(Noisy, _noisy),
    "track_ids": Kind(TrackIds, _track_ids),
    "random_ids": Kind(RandomIds, _random_ids),
    "new_ids": Kind(NewIds, _new_ids),
    "wrong_gyro": Kind(WrongGyro, _wrong_gyro),
    "blind": Kind(Blind, _blind),
}
"""Faults that any recording can have; those of worlds (``faults.KINDS``) need its truth."""
