"""Faults of recordings, drivers, clocks and frames, put into messages: what ``graph_slam check`` finds."""

from collections import Counter
from collections.abc import Iterator
from copy import deepcopy

import numpy as np
from numpy.random import Generator

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.messages.to_msg import encode, transform
from graph_slam_ros.tools.simulation.drive import DETECTIONS, POINTS, TRANSFORMS, Drive, Message, Sightings
from graph_slam_ros.tools.simulation.options import option
from graph_slam_ros.tools.simulation.recording import CLOSURES_TOPIC, integrate, moved_from

_IMU = "sensor_msgs/msg/Imu"
_POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
_OF_THE_ROBOT = (_IMU, "sensor_msgs/msg/NavSatFix", DETECTIONS, POINTS, TRANSFORMS, *_POSES)
_BEGIN, _LASTING = "when, as a part of the messages: 0 the first, 1 the last", "for how long, as a part of the messages"


# -- odometry ----------------------------------------------------------------------------------------------------------


def recorded_twice(drive: Drive, _rng: Generator) -> None:
    """Odometry of which each message is in the recording twice."""
    again = []
    for m in drive.messages:
        again += [m] * (2 if m.topic == drive.odometry_topic else 1)
    drive.messages = again


def out_of_order(drive: Drive, rng: Generator) -> None:
    """Odometry of which one message in fifty is stamped 0.2 s too early."""
    for m in drive.odometry:
        m.stamp_ns -= NS // 5 if rng.random() < 0.02 else 0


def slow_odometry(drive: Drive, _rng: Generator, hz: float = option(2.0, "so many a second", "Hz", 1e-3, 1e4)) -> None:
    """Odometry of which few messages are left."""
    number, out = -1, []
    for m in drive.odometry:
        now = int(m.stamp_ns * 1e-9 * hz)
        out += [m] if now == number else []
        number = now
    drive.drop(out)


def wrong_scale(
    drive: Drive,
    _rng: Generator,
    distance: float = option(1.05, "distance in odometry for each metre driven", "", -1e6, 1e6),
    turn: float = option(1.0, "and turn for each radian turned", "", -1e3, 1e3),
    begin: float = option(0.0, _BEGIN, "", 0, 1),
    lasting: float = option(1.0, _LASTING, "", 0, 1),
) -> None:
    """Odometry that drives and turns more than the robot: wheels, track width, units, sign."""
    poses = drive.poses
    number = np.arange(len(poses))
    is_wrong = (number >= begin * len(poses)) & (number <= (begin + lasting) * len(poses))
    factors = np.stack([np.where(is_wrong, of, 1.0) for of in (distance, turn)], axis=1).repeat(3, axis=1)
    steps = np.stack(se3.local(tuple(poses[1:].T), tuple(poses[:-1].T)), axis=1)
    drive.poses = integrate(tuple(poses[0].tolist()), steps * factors[1:])
    drive.twists = drive.twists * factors


def wrong_twist(
    drive: Drive,
    _rng: Generator,
    linear: float = option(1.0, "factor of the speed", "", -1e6, 1e6),
    angular: float = option(1.0, "factor of the turn rate", "", -1e6, 1e6),
    axes: str = option("base", "along the axes of this frame", choices=("base", "odom")),
) -> None:
    """Odometry whose twist is in other units or axes than its pose."""
    twists = drive.twists
    if axes == "odom":
        twists[:, :3] = np.stack(so3.act(tuple(drive.poses[:, 3:].T), tuple(twists[:, :3].T)), axis=1)
    drive.twists = twists * [*[linear] * 3, *[angular] * 3]


def twist_variance(
    drive: Drive, _rng: Generator, variance: float = option(1e-12, "of each axis", "(m/s)^2", -1e12, 1e12)
) -> None:
    """Odometry whose twist has another covariance."""
    for m in drive.odometry:
        covariance = np.array(m.content.twist.covariance)
        covariance[[0, 7, 35]] = variance
        m.content.twist.covariance = covariance


def restarted(drive: Drive, _rng: Generator) -> None:
    """Odometry whose driver is restarted half-way, and begins at zero again."""
    poses = drive.poses
    first = min(round(0.5 * len(poses)), len(poses) - 1)
    moved = moved_from(poses, first, se3.IDENTITY)
    moved[first] = se3.IDENTITY
    drive.poses = moved


def corrected(drive: Drive, rng: Generator) -> None:
    """Odometry that a localiser corrects every 20 s, by some 0.3 m and 0.05 rad."""
    poses, stamps_ns = drive.poses, drive.odometry_ns
    for at_ns in np.arange(stamps_ns[0] + 20.0 * NS, stamps_ns[-1], 20.0 * NS):
        at = int(np.searchsorted(stamps_ns, at_ns))
        by = (*(0.3 * rng.standard_normal(2)), 0.0, *so3.exp((0.0, 0.0, 0.05 * rng.normal())))
        poses = moved_from(poses, at, se3.compose(tuple(poses[at].tolist()), by))
    drive.poses = poses


def other_publisher(drive: Drive, _rng: Generator) -> None:
    """Odometry that a second node publishes on the same topic, a little later, from an origin of its own."""
    messages, later_ns, x_m, distance = [], NS // 100, 8.0, 0.98
    for m in drive.messages:
        messages.append(m)
        if m.topic == drive.odometry_topic:
            other = Message(m.topic, m.type, m.log_ns + later_ns, deepcopy(m.content))
            other.stamp_ns = m.stamp_ns + later_ns
            at, twist = other.content.pose.pose.position, other.content.twist.twist.linear
            at.x, at.y = x_m + distance * at.x, distance * at.y
            twist.x, twist.y = distance * twist.x, distance * twist.y
            messages.append(other)
    drive.messages = sorted(messages, key=lambda m: m.log_ns)


def not_a_number(drive: Drive, rng: Generator) -> None:
    """Odometry with one position in a hundred that is no number."""
    for m in drive.odometry:
        if rng.random() < 0.01:
            m.content.pose.pose.position.x = float("nan")


# -- recordings, landmarks and the IMU ---------------------------------------------------------------------------------


def cut_off(drive: Drive, _rng: Generator) -> None:
    """A file that ends too early, as where a disk was full or the power failed."""
    drive.part_of_file = 0.7


def missing(
    drive: Drive,
    _rng: Generator,
    what: str = option("landmarks", "which messages", choices=("landmarks", "odometry", "all")),
    begin: float = option(0.0, _BEGIN, "", 0, 1),
    lasting: float = option(1.0, _LASTING, "", 0, 1),
) -> None:
    """A recording without its landmarks, its odometry or all, for a while or to the end."""
    messages = {"landmarks": drive.landmarks, "odometry": drive.odometry, "all": drive.messages}[what]
    drive.drop(messages[round(begin * len(messages)) : round((begin + lasting) * len(messages))])


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
    for seen in _seen(drive):
        if len(seen.ids) > 1 and rng.random() < 0.2:
            seen.ids[1] = seen.ids[0]


def clock_offset(
    drive: Drive,
    _rng: Generator,
    seconds: float = option(0.1, "by so much", "s", -1e10, 1e10),
    begin: float = option(0.0, _BEGIN, "", 0, 1),
) -> None:
    """Landmarks that are stamped too late, or too early where it is negative, all the time or from some time on."""
    later = drive.landmarks[round(begin * len(drive.landmarks)) :]
    drive.restamp(later, lambda t: t + round(seconds * NS))


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


def _seen(drive: Drive, begin: float = 0.0) -> Iterator[Sightings]:
    """The landmarks of each message from a part of the messages on. What is changed in them is written back."""
    for m in drive.landmarks[round(begin * len(drive.landmarks)) :]:
        seen = Sightings(m)
        yield seen
        seen.store()


def wrong_mount(
    drive: Drive,
    _rng: Generator,
    yaw_deg: float = option(5.0, "turned to the left", "degrees", -180, 180),
    x_m: float = option(0.0, "ahead of where it should be", "m", -10, 10),
    y_m: float = option(0.0, "to the left of it", "m", -10, 10),
    begin: float = option(0.0, _BEGIN, "", 0, 1),
) -> None:
    """A sensor that is turned on the robot, or sits elsewhere, and nobody says so."""
    angle = -np.radians(yaw_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    for seen in _seen(drive, begin):
        seen.points = seen.points - [x_m, y_m, 0.0]
        seen.turn(turn)


_AXES = {
    "mirrored": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "exchanged": [[0, 1, 0], [1, 0, 0], [0, 0, 1]],
    "optical": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
    "backwards": [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
}


def wrong_axes(drive: Drive, _rng: Generator, how: str = option("mirrored", "which", choices=tuple(_AXES))) -> None:
    """Landmarks in other axes than x ahead and y to the left."""
    for seen in _seen(drive):
        seen.turn(np.array(_AXES[how], dtype=float))


def wrong_units(
    drive: Drive,
    _rng: Generator,
    factor: float = option(1000.0, "so many for each metre or radian", "", 1e-6, 1e6),
    of: str = option("lengths", "which numbers", choices=("lengths", "bearings")),
) -> None:
    """Landmarks in other units than metres or radians."""
    if of == "bearings":
        for m in drive.landmarks:
            Sightings(m).scale_bearings(factor)
        return
    for seen in _seen(drive):
        seen.points = seen.points * factor


def tiny_covariance(drive: Drive, _rng: Generator) -> None:
    """Landmarks whose covariance is smaller than any sensor's."""
    for m in drive.landmarks:
        Sightings(m).set_noise(1e-6)


def noisy(drive: Drive, rng: Generator) -> None:
    """Landmarks that are eight times worse than their covariance."""
    for seen in _seen(drive):
        sigmas = np.maximum(seen.sigmas, 0.05)[:, None] * [8.0, 8.0, 0.0]
        seen.points = seen.points + sigmas * rng.standard_normal(seen.points.shape)


def track_ids(drive: Drive, _rng: Generator, sightings: int = option(2, "of one id", "", 1, 1e6)) -> None:
    """Landmarks with ids of tracks: after a few sightings a new one."""
    times = Counter[str]()
    names: dict[tuple[str, int], str] = {}
    for seen in _seen(drive):
        times.update(seen.ids)
        seen.ids = [names.setdefault((name, times[name] // sightings), str(len(names))) for name in seen.ids]


def random_ids(drive: Drive, rng: Generator, rate: float = option(1.0, "of all sightings", "", 0, 1)) -> None:
    """Landmarks with ids of other landmarks, at random."""
    names = sorted({name for m in drive.landmarks for name in Sightings(m).ids})
    if len(names) < 2:
        raise GraphSlamError("random_ids: needs two ids")
    for seen in _seen(drive):
        seen.ids = [names[rng.integers(len(names))] if rng.random() < rate else name for name in seen.ids]


def new_ids(drive: Drive, _rng: Generator, seconds: float = option(15.0, "how long", "s", 0.1, 1e6)) -> None:
    """Landmarks that nobody recognises: after a time all have new ids."""
    first_ns = drive.landmarks[0].stamp_ns
    names: dict[tuple[str, int], str] = {}
    for seen in _seen(drive):
        period = int((seen.stamp_ns - first_ns) / (seconds * NS))
        seen.ids = [names.setdefault((name, period), str(len(names))) for name in seen.ids]


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


_KINDS = (
    *(recorded_twice, out_of_order, slow_odometry, wrong_scale, wrong_twist, twist_variance),
    *(restarted, corrected, other_publisher, not_a_number, missing, cut_off, unreadable, other_tf, same_ids),
    *(clock_offset, zero_stamps, clock_set_back, wrong_frames, two_parents),
    *(wrong_mount, wrong_axes, wrong_units, tiny_covariance, noisy, track_ids, random_ids, new_ids, wrong_gyro),
)
MESSAGE_KINDS = {put.__name__: put for put in _KINDS}
"""Faults that any recording can have; those of worlds (``faults.KINDS``) need its truth."""
