"""Faults of a recording as a whole: what is missing in it, cannot be read, or is there twice."""

from dataclasses import dataclass

from numpy.random import Generator

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.cdr import NS
from graph_slam_ros.messages.to_msg import encode, transform
from graph_slam_ros.tools.simulation.drive import TRANSFORMS, Drive, Message, Sightings
from graph_slam_ros.tools.simulation.odometry_faults import CHANGED
from graph_slam_ros.tools.simulation.options import Kind, option

_CAMERA = "camera_link"


@dataclass(frozen=True, slots=True)
class Brief:
    """A recording of the beginning of a drive."""

    part: float = option(0.1, "of its time", "", 0, 1)


@dataclass(frozen=True, slots=True)
class CutOff:
    """A file that ends too early, as where a disk was full or the power failed."""

    part: float = option(0.7, "of its bytes that are left", "", 0.01, 1)


@dataclass(frozen=True, slots=True)
class Missing:
    """A recording without one of its topics."""

    what: str = option("landmarks", "which", choices=("landmarks", "odometry"))


@dataclass(frozen=True, slots=True)
class Unreadable:
    """Landmarks whose bytes end too early, as those of another definition of the type."""

    rate: float = option(1.0, CHANGED, "", 0, 1)


@dataclass(frozen=True, slots=True)
class OtherTf:
    """A transform from odom to the robot on /tf that is of another odometry."""

    distance: float = option(0.8, "metres on /tf for each metre in the topic", "", -1e3, 1e3)


@dataclass(frozen=True, slots=True)
class StaticChanges:
    """A static transform of the sensor that is published twice, with different values."""

    x_m: float = option(0.1, "how far the second is from the first", "m", -100, 100)


@dataclass(frozen=True, slots=True)
class SameIds:
    """Messages in which two landmarks have one id."""

    rate: float = option(0.2, CHANGED, "", 0, 1)


def _brief(drive: Drive, fault: Brief, _rng: Generator) -> None:
    first_ns, last_ns = drive.messages[0].log_ns, drive.messages[-1].log_ns
    end_ns = first_ns + fault.part * (last_ns - first_ns)
    drive.drop([m for m in drive.messages if m.log_ns > end_ns])


def _cut_off(drive: Drive, fault: CutOff, _rng: Generator) -> None:
    drive.part_of_file = fault.part


def _missing(drive: Drive, fault: Missing, _rng: Generator) -> None:
    drive.drop(drive.landmarks if fault.what == "landmarks" else drive.odometry)


def _unreadable(drive: Drive, fault: Unreadable, rng: Generator) -> None:
    for m in drive.landmarks:
        if rng.random() < fault.rate:
            whole = encode(m.content)
            m.content = whole[: len(whole) // 3]


def _other_tf(drive: Drive, fault: OtherTf, _rng: Generator) -> None:
    odometry = {id(m): pose for m, pose in zip(drive.odometry, drive.poses, strict=True)}
    if not odometry:
        raise GraphSlamError("other_tf: there is no odometry")
    messages = []
    for m in drive.messages:
        if m.topic != "/tf":
            messages.append(m)
        if id(m) in odometry:
            pose = odometry[id(m)].copy()
            pose[:3] *= fault.distance
            content = transform(m.stamp_ns, m.frame, str(m.content.child_frame_id), tuple(pose.tolist()))
            messages.append(Message("/tf", TRANSFORMS, m.log_ns, content))
    drive.messages = messages


def _static_changes(drive: Drive, fault: StaticChanges, _rng: Generator) -> None:
    parent = str(drive.odometry[0].content.child_frame_id)
    for m in drive.landmarks:
        m.frame = _CAMERA
    first_ns = drive.messages[0].log_ns
    for k, x_m in enumerate((0.0, fault.x_m)):
        content = transform(first_ns, parent, _CAMERA, (x_m, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        drive.messages.insert(k, Message("/tf_static", TRANSFORMS, first_ns + k * NS // 1000, content))


def _same_ids(drive: Drive, fault: SameIds, rng: Generator) -> None:
    for m in drive.landmarks:
        seen = Sightings(m)
        if len(seen.ids) > 1 and rng.random() < fault.rate:
            seen.ids[1] = seen.ids[0]
            seen.store()


RECORDING_KINDS: dict[str, Kind] = {
    "brief": Kind(Brief, _brief),
    "cut_off": Kind(CutOff, _cut_off),
    "missing": Kind(Missing, _missing),
    "unreadable": Kind(Unreadable, _unreadable),
    "other_tf": Kind(OtherTf, _other_tf),
    "static_changes": Kind(StaticChanges, _static_changes),
    "same_ids": Kind(SameIds, _same_ids),
}
"""Faults of whole recordings."""
