"""Faults of recordings, drivers, clocks and frames, put into messages: what ``graph_slam check`` finds."""

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.lie import se3
from graph_slam_ros.messages.to_msg import encode, transform
from graph_slam_ros.tools.simulation.drive import DETECTIONS, POINTS, TRANSFORMS, Drive, Message, Sightings
from graph_slam_ros.tools.simulation.odometry_faults import ODOMETRY_KINDS
from graph_slam_ros.tools.simulation.options import option
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC
from graph_slam_ros.typing import Array

_CAMERA = "camera_link"
_IMU = "sensor_msgs/msg/Imu"
_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_OF_THE_ROBOT = (_IMU, "sensor_msgs/msg/NavSatFix", DETECTIONS, POINTS, TRANSFORMS, *_POSES)


def brief(drive: Drive, _rng: Generator) -> None:
    """A recording of the first tenth of a drive."""
    first_ns, last_ns = drive.messages[0].log_ns, drive.messages[-1].log_ns
    end_ns = first_ns + 0.1 * (last_ns - first_ns)
    drive.drop([m for m in drive.messages if m.log_ns > end_ns])


def cut_off(drive: Drive, _rng: Generator) -> None:
    """A file that ends too early, as where a disk was full or the power failed."""
    drive.part_of_file = 0.7


def missing(
    drive: Drive, _rng: Generator, what: str = option("landmarks", "which", choices=("landmarks", "odometry"))
) -> None:
    """A recording without one of its topics."""
    drive.drop(drive.landmarks if what == "landmarks" else drive.odometry)


def unreadable(drive: Drive, _rng: Generator) -> None:
    """Landmarks whose bytes end too early, as those of another definition of the type."""
    for m in drive.landmarks:
        whole = encode(m.content)
        m.content = whole[: len(whole) // 3]


def other_tf(
    drive: Drive,
    _rng: Generator,
    distance: float = option(0.8, "metres on /tf for each metre in the topic", "", -1e3, 1e3),
) -> None:
    """A transform from odom to the robot on /tf that is of another odometry."""
    odometry = {id(m): pose for m, pose in zip(drive.odometry, drive.poses, strict=True)}
    if not odometry:
        raise GraphSlamError("other_tf: there is no odometry")
    messages = []
    for m in drive.messages:
        if m.topic != "/tf":
            messages.append(m)
        if id(m) in odometry:
            pose = odometry[id(m)].copy()
            pose[:3] *= distance
            content = transform(m.stamp_ns, m.frame, str(m.content.child_frame_id), tuple(pose.tolist()))
            messages.append(Message("/tf", TRANSFORMS, m.log_ns, content))
    drive.messages = messages


def same_ids(drive: Drive, rng: Generator) -> None:
    """A fifth of the messages in which two landmarks have one id."""
    for m in drive.landmarks:
        seen = Sightings(m)
        if len(seen.ids) > 1 and rng.random() < 0.2:
            seen.ids[1] = seen.ids[0]
            seen.store()


def clock_offset(drive: Drive, _rng: Generator, seconds: float = option(0.1, "by so much", "s", -1e10, 1e10)) -> None:
    """Landmarks that are stamped too late, or too early where it is negative."""
    drive.restamp(drive.landmarks, lambda t: t + round(seconds * NS))


def clock_jump(drive: Drive, _rng: Generator, seconds: float = option(0.2, "by so much", "s", -1e5, 1e5)) -> None:
    """Landmarks whose clock is set half-way."""
    drive.restamp(drive.landmarks, lambda t: t + np.where(t > np.quantile(t, 0.5), round(seconds * NS), 0))


def uptime(drive: Drive, _rng: Generator) -> None:
    """Landmarks that are stamped by the time since their computer was started."""
    drive.restamp(drive.landmarks, lambda t: t - t[0] + 1000 * NS)


def zero_stamps(drive: Drive, rng: Generator) -> None:
    """Landmarks whose driver leaves three stamps in ten at zero."""
    drive.restamp(drive.landmarks, lambda t: np.where(rng.random(len(t)) < 0.3, 0, t))


def clock_set_back(drive: Drive, _rng: Generator) -> None:
    """A clock of the whole robot that is set back by 30 s half-way."""
    at_ns, back_ns = np.quantile(drive.odometry_ns, 0.5), 30 * NS
    drive.restamp(drive.decoded(_OF_THE_ROBOT), lambda t: np.where(t > at_ns, t - back_ns, t))
    for m in drive.messages:
        for one in m.content.detections if m.topic == CLOSURES_TOPIC else ():
            if one.id.isdecimal() and int(one.id) > at_ns:
                one.id = str(int(one.id) - back_ns)
                for result in one.results:
                    result.hypothesis.class_id = one.id


def wrong_frames(
    drive: Drive,
    _rng: Generator,
    odometry: str = option("kept", "frame of odometry", choices=("kept", "map", "world")),
    landmarks: str = option("camera_link", "frame of landmarks", choices=("kept", "camera_link", "odom", "map")),
) -> None:
    """Messages with the names of other frames."""
    for frame, messages in ((odometry, drive.odometry), (landmarks, drive.landmarks)):
        for m in messages if frame != "kept" else ():
            m.frame = frame


def two_parents(drive: Drive, _rng: Generator) -> None:
    """A frame of the sensor that two nodes publish, below two frames."""
    for m in drive.landmarks:
        m.frame = "camera_link"
    for parent in ("base_link", "lidar_link"):
        drive.add_transform(parent, "camera_link", se3.IDENTITY)


def _each(drive: Drive, change: Callable[[Sightings, Message], Array | None]) -> None:
    for m in drive.landmarks:
        seen = Sightings(m)
        turn = change(seen, m)
        seen.store(turn)


def wrong_mount(
    drive: Drive,
    _rng: Generator,
    yaw_deg: float = option(5.0, "turned to the left", "degrees", -180, 180),
    x_m: float = option(0.0, "ahead of where it should be", "m", -10, 10),
    y_m: float = option(0.0, "to the left of it", "m", -10, 10),
) -> None:
    """A sensor that is turned on the robot, or sits elsewhere, and nobody says so."""
    angle = -np.radians(yaw_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])

    def change(seen: Sightings, _: Message) -> Array:
        seen.points = (seen.points - [x_m, y_m, 0.0]) @ turn.T
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


def wrong_axes(
    drive: Drive,
    _rng: Generator,
    how: str = option("mirrored", "which", choices=("mirrored", "exchanged", "optical", "backwards", "left", "right")),
) -> None:
    """Landmarks in other axes than x ahead and y to the left."""
    turn = np.array(_AXES[how], dtype=float)

    def change(seen: Sightings, _: Message) -> Array:
        seen.points = seen.points @ turn.T
        return turn

    _each(drive, change)


def wrong_units(
    drive: Drive,
    _rng: Generator,
    factor: float = option(1000.0, "so many for each metre or radian", "", 1e-6, 1e6),
    of: str = option("lengths", "which numbers", choices=("lengths", "bearings")),
) -> None:
    """Landmarks in other units than metres or radians."""
    for m in drive.landmarks:
        seen = Sightings(m)
        if of == "bearings":
            seen.scale_bearings(factor)
        else:
            seen.points = seen.points * factor
            seen.store()


def tiny_covariance(drive: Drive, _rng: Generator) -> None:
    """Landmarks whose covariance is smaller than any sensor's."""
    for m in drive.landmarks:
        Sightings(m).set_noise(1e-6)


def noisy(drive: Drive, rng: Generator) -> None:
    """Landmarks that are eight times worse than their covariance."""

    def change(seen: Sightings, _: Message) -> None:
        sigmas = np.maximum(seen.sigmas, 0.05)[:, None] * [8.0, 8.0, 0.0]
        seen.points = seen.points + sigmas * rng.standard_normal(seen.points.shape)

    _each(drive, change)


def track_ids(drive: Drive, _rng: Generator, sightings: int = option(2, "of one id", "", 1, 1e6)) -> None:
    """Landmarks with ids of tracks: after a few sightings a new one."""
    times: dict[str, int] = {}
    names: dict[tuple[str, int], str] = {}

    def change(seen: Sightings, _: Message) -> None:
        for k, name in enumerate(seen.ids):
            times[name] = times.get(name, 0) + 1
            seen.ids[k] = names.setdefault((name, times[name] // sightings), str(len(names)))

    _each(drive, change)


def random_ids(drive: Drive, rng: Generator, rate: float = option(1.0, "of all sightings", "", 0, 1)) -> None:
    """Landmarks with ids of other landmarks, at random."""
    names = sorted({name for m in drive.landmarks for name in Sightings(m).ids})
    if len(names) < 2:
        raise GraphSlamError("random_ids: needs two ids")

    def change(seen: Sightings, _: Message) -> None:
        seen.ids = [names[rng.integers(len(names))] if rng.random() < rate else name for name in seen.ids]

    _each(drive, change)


def new_ids(drive: Drive, _rng: Generator, seconds: float = option(15.0, "how long", "s", 0.1, 1e6)) -> None:
    """Landmarks that nobody recognises: after a time all have new ids."""
    first_ns = drive.landmarks[0].stamp_ns
    names: dict[tuple[str, int], str] = {}

    def change(seen: Sightings, m: Message) -> None:
        period = int((m.stamp_ns - first_ns) / (seconds * NS))
        seen.ids = [names.setdefault((name, period), str(len(names))) for name in seen.ids]

    _each(drive, change)


def wrong_gyro(
    drive: Drive,
    rng: Generator,
    factor: float = option(1.2, "so many times as large", "", -1e3, 1e3),
    bias_rad_s: float = option(0.0, "larger by so much, about each axis", "rad/s", -10, 10),
    noise_rad_s: float = option(0.0, "wrong by so much at random, for a second at a time", "rad/s", 0, 100),
    late_s: float = option(0.0, "stamped too late by so much", "s", -1e5, 1e5),
    axes: str = option("kept", "which", choices=("kept", "exchanged")),
) -> None:
    """An IMU whose turn rates are wrong, or that lies on its side (axes)."""
    if not (found := drive.decoded((_IMU,))):
        raise GraphSlamError("wrong_gyro: needs an IMU")
    errors: dict[int, float] = {}
    for m in found:
        w = m.content.angular_velocity
        for v in (w, m.content.linear_acceleration) if axes == "exchanged" else ():
            v.x, v.y, v.z = v.z, v.x, v.y
        second, error = m.log_ns // NS, noise_rad_s * rng.standard_normal() if noise_rad_s else 0.0
        wrong = bias_rad_s + errors.setdefault(second, error)
        w.x, w.y, w.z = (factor * rate + wrong for rate in (w.x, w.y, w.z))
        m.stamp_ns += round(late_s * NS)


def blind(drive: Drive, _rng: Generator) -> None:
    """A sensor that sees nothing after a quarter of the drive."""
    at_ns = np.quantile(drive.odometry_ns, 0.25)
    drive.drop([m for m in drive.landmarks if m.stamp_ns >= at_ns])


_KINDS = (
    *(brief, cut_off, missing, unreadable, other_tf, same_ids),
    *(clock_offset, clock_jump, uptime, zero_stamps, clock_set_back, wrong_frames, two_parents),
    *(wrong_mount, wrong_axes, wrong_units, tiny_covariance, noisy, track_ids, random_ids, new_ids, wrong_gyro, blind),
)
MESSAGE_KINDS = {**ODOMETRY_KINDS, **{put.__name__: put for put in _KINDS}}
"""Faults that any recording can have; those of worlds (``faults.KINDS``) need its truth."""
