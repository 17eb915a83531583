"""One input: its settings, the mount of its sensor, and the noise that its messages do not contain."""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import ASSUMED, InputConfig
from graph_slam_ros.lie import se3, so3
from graph_slam_ros.messages.inputs import checks
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.transforms import Transforms, assumed_mount
from graph_slam_ros.typing import Array, Mask, Numbers

Item = TypeVar("Item")
Out = TypeVar("Out")

_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])
_BEYOND_MEANING = 1e12  # [m^2, rad^2]: larger numbers could not be turned into other axes
_ORIENTATION_KNOWN_RAD2 = 0.5**2  # a heading of a larger variance is none: beyond, a residual is not linear
_FLAT = 0.5  # the horizontal part of an x axis that is too short to have a heading
_LITTLE = 0.1  # of a quaternion's x and y: a robot that leans less is upright
_LEVEL_M, _UPRIGHT = 0.5, math.cos(math.radians(20.0))  # of a robot that moves in a plane


@dataclass(slots=True)
class Origin:
    """The datum of the map for all inputs without their own; empty before the first fix."""

    datum: Numbers = ()


class NotYet(Exception):
    """A transform of the message may still come: the message is tried again later.

    Attributes
    ----------
    is_linked : whether its frames are linked at other stamps
    """

    def __init__(self, is_linked: bool = True) -> None:
        super().__init__()
        self.is_linked = is_linked


class InputContext:
    """The context of a converter: everything it needs besides the message.

    Parameters
    ----------
    use : what the input is used as
    origin : of the map, which all inputs share

    Attributes
    ----------
    offset_ns : what its stamps are moved by
    tally : refusals and repairs of the present message by reason
    is_hurried : whether nothing is waited for any more
    state : what converters have to remember between messages
    unlinked : frames of the last messages and the frames that nothing links them to
    """

    def __init__(self, settings: InputConfig, use: str, config: Config, transforms: Transforms, origin: Origin) -> None:
        self.name = settings.name
        self.settings = settings
        self.use = use
        self.config = config
        self.space = config.space
        self.transforms = transforms
        self.origin = origin
        self.tally: Counter[str] = Counter()
        self.is_hurried = False
        self.state: dict[str, Any] = {}
        self.unlinked: deque[tuple[str, str]] = deque(maxlen=4)
        self.offset_ns = round(settings.offset_s * 1e9)
        self._wait_ns = round(config.inputs.tf_wait_s * 1e9)
        mount = settings.numbers("mount", 6)
        self._mount = se3.from_xyz_rpy(mount) if mount else None

    def count(self, reason: str, times: int = 1) -> None:
        """Count a refusal or a repair."""
        self.tally[reason] += times

    def each(self, items: Iterable[Item], convert: Callable[[Item], Out]) -> Iterator[Out]:
        """What is made of each item of a message; one that is refused is counted, and the others go on."""
        for one in items:
            try:
                yield convert(one)
            except MessageError as reason:
                self.count(str(reason))

    def stamp_ns(self, stamp: Any) -> int:
        """The stamp of a header, in the clock of the robot."""
        return checks.stamp_ns(stamp, self.offset_ns)

    # -- frames ------------------------------------------------------------------------------------------------------

    def frame(self, name: str) -> str:
        """The configured frame, else that of the message."""
        return self.settings.frame or self.named(name)

    def named(self, name: str) -> str:
        """The name of a frame in a message; empty only where the mount is configured."""
        if name.startswith("/"):
            self.count("frame_slash_stripped")
            name = name[1:]
        if not name and self._mount is None:
            raise MessageError("frame_empty")
        return name

    def T_base(self, frame: str, stamp_ns: int) -> se3.Pose:
        """Return the pose of a frame on the robot, by TF, else as configured. Raises NotYet as ``T_sensor`` does."""
        base = self.config.frames.base
        tells = self.transforms.are_linked(base, frame) or self._may_come(stamp_ns)
        if self._mount is None or frame == base or (tells and self.transforms.knows(frame)):
            return self.T_sensor(base, frame, stamp_ns)
        if self.settings.mount != ASSUMED:
            return self._mount
        self.count("mount_assumed")
        return se3.from_xyz_rpy(tuple(map(float, assumed_mount(frame).split())))

    def T_sensor(self, sensor: str, seen: str, stamp_ns: int) -> se3.Pose:
        """Return the pose of a frame by TF in another, such as what a detector publishes in that of its sensor.

        Raises
        ------
        NotYet
            TF does not have it, and odometry is not much newer than the stamp.
        """
        found = self.transforms.lookup(sensor, seen, stamp_ns)
        if found is not None:
            return found
        are_linked = self.transforms.are_linked(sensor, seen)
        if self._may_come(stamp_ns):
            raise NotYet(are_linked)
        raise self._not_linked("transform_gaps" if are_linked else "frame_unknown", seen, sensor)

    def mount_position(self, name: str, stamp_ns: int) -> tuple[float, float, float]:
        """The position of a message's sensor on the robot; the base, which is counted, if its frame is unknown.

        Raises NotYet as ``T_base`` does.
        """
        if name or self.settings.frame or self._mount is not None:
            frame = self.frame(name)
            is_known = frame == self.config.frames.base or self._mount is not None or self.transforms.knows(frame)
            if is_known or self._may_come(stamp_ns):
                return se3.position(self.T_base(frame, stamp_ns))
        self.count("mount_unknown")
        return 0.0, 0.0, 0.0

    def _may_come(self, stamp_ns: int) -> bool:
        now_ns = self.transforms.now_ns
        return not (self.is_hurried or (now_ns is not None and now_ns > stamp_ns + self._wait_ns))

    def T_base_child(self, child: str) -> se3.Pose:
        """Return the fixed pose of a frame on the robot. An empty name is the configured mount, or the base."""
        found = self.transforms.lookup(self.config.frames.base, child) if child else None
        if found is None:
            found = self._mount if self._mount is not None or child else se3.IDENTITY
            if self.settings.mount == ASSUMED:
                self.count("mount_assumed")
        if found is None:
            raise self._not_linked("child_frame_unknown", child, self.config.frames.base)
        return found

    def T_fixed(self, target: str, frame: str) -> se3.Pose:
        """The transform between two frames that do not move: that of a message, and that of odometry or of the map."""
        found = self.transforms.lookup(target, frame)
        if found is None:
            of_odometry = target == self.config.frames.odom
            raise self._not_linked("odom_frame_unknown" if of_odometry else "map_frame_unknown", frame, target)
        return found

    def _not_linked(self, reason: str, frame: str, target: str) -> MessageError:
        if (frame, target) not in self.unlinked:
            self.unlinked.append((frame, target))
        return MessageError(reason)

    # -- rotations ---------------------------------------------------------------------------------------------------

    def placed(self, position: Any, orientation: Any) -> se3.Pose:
        """The pose of a message, from its position or translation, and its orientation or rotation."""
        return (*checks.point(position), *self.unit(orientation))

    def unit(self, q: Any) -> so3.Quaternion:
        """Unit quaternion (x, y, z, w) of a message."""
        out, repaired = checks.quaternion(q)
        if repaired:
            self.count("quaternion_normalized")
        return out

    def projected(self, T: se3.Pose) -> Numbers:
        """A pose of the plane or of space; in the plane the heading is that of the x axis."""
        if self.space.dimensions == 3:
            return tuple(map(float, T))
        ahead = so3.act(se3.rotation(T), (1.0, 0.0, 0.0))
        return float(T[0]), float(T[1]), math.atan2(ahead[1], ahead[0])

    def of_robot(self, T: se3.Pose) -> Numbers:
        """A pose of the robot. In the plane it is counted if it leaves the plane of the first one."""
        if self.space.dimensions == 2:
            up = so3.act(se3.rotation(T), (0.0, 0.0, 1.0))
            if abs(T[2] - self.state.setdefault("height", T[2])) > _LEVEL_M or up[2] < _UPRIGHT:
                self.count("out_of_plane")
        return self.projected(T)

    def of_robots_in_plane(self, numbers: Array, are_wanted: Mask) -> list[Numbers]:
        """The same for the first of several poses (n, 7), as far as they are wanted, and surely are in the plane."""
        if self.space.dimensions == 3:
            return list(map(tuple, numbers[: _first_false(are_wanted)].tolist()))
        height = self.state.get("height")
        if height is None:
            return []
        x, y, z, qx, qy, qz, qw = numbers.T
        count = _first_false(are_wanted & (abs(z - height) <= _LEVEL_M) & (abs(qx) + abs(qy) <= _LITTLE))
        ahead = so3.act((qx[:count], qy[:count], qz[:count], qw[:count]), (1.0, 0.0, 0.0))
        headings = map(math.atan2, ahead[1].tolist(), ahead[0].tolist())
        return list(zip(x[:count].tolist(), y[:count].tolist(), headings, strict=True))

    def has_heading(self, T: se3.Pose) -> bool:
        """Return whether a frame has a heading: in space always; in the plane where the x axis does not point up."""
        ahead = so3.act(se3.rotation(T), (1.0, 0.0, 0.0))
        return self.space.dimensions == 3 or bool(math.hypot(ahead[0], ahead[1]) >= _FLAT)

    # -- noise -------------------------------------------------------------------------------------------------------

    def block(self, covariance: Array) -> Array:
        """The part of a pose's covariance (6, 6) for this space: (3, 3), or all of it."""
        return covariance if self.space.dimensions == 3 else covariance[_PLANAR]

    def orientation_known(self, covariance: Array) -> bool:
        """Return whether a pose's covariance (6, 6) has an orientation: the heading in the plane, all axes in space."""
        variances = np.diag(covariance)[5 if self.space.dimensions == 2 else 3 :]
        return bool(((variances > 0.0) & (variances < _ORIENTATION_KNOWN_RAD2)).all())

    def pose_covariance(self, flat: Any, distance_m: float) -> Array:
        """Covariance (6, 6) in the axes of the frame, from the message, or from the settings if it has none."""
        if flat is None or self.settings.noise == "sigmas":
            sigmas = [self.sigma_m(distance_m)] * 3 + [self.settings.sigma_rad] * 3
            return np.diag(np.square(sigmas))
        covariance: Array = np.asarray(flat, dtype=float).reshape(6, 6)
        if not np.isfinite(covariance).all():
            raise MessageError("nonfinite_covariance")
        return np.clip(covariance, -_BEYOND_MEANING, _BEYOND_MEANING)

    def sigma_m(self, distance_m: float = 0.0) -> float:
        """Standard deviation of a position at a distance, for messages that do not contain it."""
        sigma_m = self.settings.sigma_m
        if sigma_m == 0.0 and self.use == "landmarks":
            sigma_m = self.config.landmarks.sigma_m
        if sigma_m == 0.0:
            raise MessageError("noise_unknown")
        return sigma_m + self.settings.sigma_per_m * distance_m

    def checked(self, block: Array, lengths: int, distance_m: float = 0.0) -> Numbers:
        """Flat covariance. If its position part is all zero, that part is taken from the settings.

        Parameters
        ----------
        block : (n, n), the first ``lengths`` in m^2, the others in rad^2
        """
        if lengths and not block[:lengths, :lengths].any():
            filled = np.zeros_like(block)
            filled[:lengths, :lengths] = np.eye(lengths) * self.sigma_m(distance_m) ** 2
            self.count("covariance_unknown")
            filled[lengths:, lengths:] = block[lengths:, lengths:]
            block = filled
        covariance, repairs = checks.covariance(block, lengths)
        for repair in repairs:
            self.count(repair)
        return tuple(covariance.ravel().tolist())


def _first_false(mask: Mask) -> int:
    return len(mask) if mask.all() else int(mask.argmin())
