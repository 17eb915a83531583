"""Faults of a recording as a whole: what is missing in it, cannot be read, or is there twice."""

from numpy.random import Generator

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.messages.to_msg import encode, transform
from graph_slam_ros.tools.simulation.drive import MESSAGE_KINDS, TRANSFORMS, Drive, Message, Sightings
from graph_slam_ros.tools.simulation.odometry_faults import CHANGED
from graph_slam_ros.tools.simulation.options import option

_CAMERA = "camera_link"


@MESSAGE_KINDS.add
def brief(drive: Drive, _rng: Generator, *, part: float = option(0.1, "of its time", "", 0, 1)) -> None:
    """A recording of the beginning of a drive."""
    first_ns, last_ns = drive.messages[0].log_ns, drive.messages[-1].log_ns
    end_ns = first_ns + part * (last_ns - first_ns)
    drive.drop([m for m in drive.messages if m.log_ns > end_ns])


@MESSAGE_KINDS.add
def cut_off(
    drive: Drive, _rng: Generator, *, part: float = option(0.7, "of its bytes that are left", "", 0.01, 1)
) -> None:
    """A file that ends too early, as where a disk was full or the power failed."""
    drive.part_of_file = part


@MESSAGE_KINDS.add
def missing(
    drive: Drive, _rng: Generator, *, what: str = option("landmarks", "which", choices=("landmarks", "odometry"))
) -> None:
    """A recording without one of its topics."""
    drive.drop(drive.landmarks if what == "landmarks" else drive.odometry)


@MESSAGE_KINDS.add
def unreadable(drive: Drive, rng: Generator, *, rate: float = option(1.0, CHANGED, "", 0, 1)) -> None:
    """Landmarks whose bytes end too early, as those of another definition of the type."""
    for m in drive.landmarks:
        if rng.random() < rate:
            whole = encode(m.content)
            m.content = whole[: len(whole) // 3]


@MESSAGE_KINDS.add
def other_tf(
    drive: Drive,
    _rng: Generator,
    *,
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


@MESSAGE_KINDS.add
def static_changes(
    drive: Drive, _rng: Generator, *, x_m: float = option(0.1, "how far the second is from the first", "m", -100, 100)
) -> None:
    """A static transform of the sensor that is published twice, with different values."""
    parent = str(drive.odometry[0].content.child_frame_id)
    for m in drive.landmarks:
        m.frame = _CAMERA
    first_ns = drive.messages[0].log_ns
    for k, ahead_m in enumerate((0.0, x_m)):
        content = transform(first_ns, parent, _CAMERA, (ahead_m, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        drive.messages.insert(k, Message("/tf_static", TRANSFORMS, first_ns + k * NS // 1000, content))


@MESSAGE_KINDS.add
def same_ids(drive: Drive, rng: Generator, *, rate: float = option(0.2, CHANGED, "", 0, 1)) -> None:
    """Messages in which two landmarks have one id."""
    for m in drive.landmarks:
        seen = Sightings(m)
        if len(seen.ids) > 1 and rng.random() < rate:
            seen.ids[1] = seen.ids[0]
            seen.store()
