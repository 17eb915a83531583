"""Conversion of incoming messages: CDR bytes in, measurements out. What is refused is counted.

It works on the bytes of live subscriptions and of bags, and needs no ROS. Every refusal and every repair adds to a
counter by input and reason.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.formats.cdr import CdrReader
from graph_slam_ros.measurements.counters import Counters
from graph_slam_ros.measurements.types import InitialPose, Measured, Odometry
from graph_slam_ros.messages.inputs import checks, converters, fixes, odometry, uses
from graph_slam_ros.messages.inputs.checks import MessageError
from graph_slam_ros.messages.inputs.odometry_bytes import OdometryReader
from graph_slam_ros.messages.inputs.plugins import PluginFault
from graph_slam_ros.messages.inputs.source import InputContext, NotYet, Origin
from graph_slam_ros.messages.inputs.transforms import Transforms, pose
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.one_publisher import OnePublisher

Decoder = Callable[[bytes], Any]

TRANSFORMS = "tf2_msgs/msg/TFMessage"
TF_STATIC, TF, INITIAL_POSE = "tf_static", "tf", "initialpose"
_TF_BUFFER_NS = 10 * 10**9  # transforms of /tf are kept for so long, as tf2 does
_POSE_NUMBERS = 7 + 36  # of a geometry_msgs/PoseWithCovariance


@cache
def own_decoder(type_name: str) -> Decoder:
    """A decoder from CDR bytes to a message object of our own type store; the same each time."""
    return partial(typestore().deserialize_cdr, typename=type_name)


def is_correction(cdr: bytes, map_frame: str) -> bool:
    """Return whether a tf2_msgs/TFMessage has the map frame in its first transform, without decoding it."""
    reader = CdrReader(cdr)
    try:
        reader.numbers("I")
        reader.stamp_ns()
        return reader.text().lstrip(b"/") == map_frame.encode()
    except struct.error:
        return False


def twist_of(cdr: bytes, base_frame: str) -> bytes | None:
    """The geometry_msgs/TwistWithCovariance, little endian, of a nav_msgs/Odometry, without decoding the rest.

    None if its frame is not the base, because the motion of a wheel or a sensor is not that of the robot.
    """
    reader = CdrReader(cdr)
    try:
        reader.stamp_ns()
        reader.text()
        child = reader.text().lstrip(b"/")
        reader.numbers("d", _POSE_NUMBERS)
        twist = reader.numbers("d", 42)
    except struct.error:
        return None
    return struct.pack("<42d", *twist) if child == base_frame.encode() else None


@dataclass(slots=True)
class _Input:
    """How the messages of an input are read: the decoder, the converter and, of odometry, the publisher in use."""

    source: InputContext
    decode: Decoder
    convert: Callable[[InputContext, Any], Iterable[Any]]
    publisher: OnePublisher | None = None
    reader: OdometryReader | None = None  # of messages that need no decoding


class MessageConverter:
    """Converts messages into measurements.

    Parameters
    ----------
    config : the inputs, frames, and the defaults for what messages leave unknown
    counters : where refusals and repairs are counted
    decoders : by message type, where a recording's own definition or an installed package is to be used

    Attributes
    ----------
    on_fault : is called with the first error of a plugin in each input, in one line
    decoded : the last message, or what was read of several at once; None where it could not be decoded

    Raises
    ------
    ConfigError
        An input of a type, or for a use, that is not there.
    """

    def __init__(self, config: Config, counters: Counters, decoders: Mapping[str, Decoder] | None = None) -> None:
        self._config, self._counters, self._decoders = config, counters, dict(decoders or {})
        self.on_fault: Callable[[str], object] = lambda line: None
        self.decoded: Any = None
        self._transforms = Transforms(_TF_BUFFER_NS, partial(counters.count, TF, "far_in_time"))
        self._links, self._awaits_stamp = 0, False  # of the last try of what waits
        self._inputs: dict[str, _Input] = {}
        self._pending: deque[tuple[_Input, Any]] = deque()  # for /tf to tell where their sensors were
        by_name = {settings.name: settings for settings in config.sources}
        datums = (settings.numbers("datum", 3) for settings in config.sources)
        self._origin = Origin(next(filter(None, datums), ()))
        for name, use in uses(config).items():
            counters.received[name] += 0
            type_name = by_name[name].type
            self._add(by_name[name], type_name, use, (converters(type_name) or {})[use])
        for name, add in ((TF_STATIC, self._add_static), (TF, self._add_moving)):
            self._add(InputConfig(name), TRANSFORMS, "none", partial(self._transforms_of, add))
        given = InputConfig(INITIAL_POSE, sigma_m=config.initialpose.sigma_m, sigma_rad=config.initialpose.sigma_rad)
        self._add(given, "geometry_msgs/msg/PoseWithCovarianceStamped", "none", fixes.initial_pose)

    def _add(self, settings: InputConfig, type_name: str, use: str, convert: Callable[..., Any]) -> None:
        name, source = settings.name, InputContext(settings, use, self._config, self._transforms, self._origin)
        decode = self._decoders.get(type_name) or own_decoder(type_name)
        one = self._inputs[name] = _Input(source, decode, convert)
        if use == "odometry":
            refuse = (partial(self._counters.count, name, reason) for reason in ("other_publisher", "future"))
            one.publisher = OnePublisher(self._config.odometry.timeout_s, *refuse)
            if type_name == odometry.TYPE and decode is own_decoder(type_name):  # else its bytes may have other places
                one.reader = OdometryReader()

    def convert(self, name: str, cdr: bytes) -> list[Measured]:
        """Convert one message; returns its measurements and those that its transforms complete."""
        one = self._inputs[name]
        self._counters.received[name] += 1
        try:
            self.decoded = None
            self.decoded = message = one.decode(cdr)
        except Exception:  # of damaged bytes rosbags raises struct, index, unicode and assertion errors
            self._counters.count(name, "undecodable")
            return []
        out = self._converted(one, message)
        if one.publisher is not None:
            accept = one.publisher.accept
            out = [m for given in out if isinstance(given, Odometry) for m in accept(given)]
            for m in out:
                if m.stamp_ns > (self._transforms.now_ns or 0):
                    self._transforms.now_ns = m.stamp_ns
        if (name == TF or one.publisher is not None) and self._may_be_usable():
            self._awaits_stamp = False
            for _ in range(len(self._pending)):
                out += self._converted(*self._pending.popleft())
        elif len(self._pending) > self._config.ordering.max_waiting:
            out += self._hurried(*self._pending.popleft())
        return out

    def _may_be_usable(self) -> bool:
        """Return whether a message that waits may be usable now: not while odometry and a link are missing."""
        before, self._links = self._links, self._transforms.links
        return self._awaits_stamp or self._transforms.now_ns is not None or before != self._links

    def convert_run(self, name: str, cdrs: Sequence[bytes], after_ns: int) -> list[Odometry]:
        """Convert messages that follow one another, from the first on, as far as all of them are plain odometry.

        That is what ``convert`` does of nearly all odometry, for many messages at once. It is for the message after
        those that are returned.

        Parameters
        ----------
        after_ns : a stamp that the first must be later than
        """
        one = self._inputs[name]
        if one.reader is None or one.publisher is None or self._pending:
            return []
        read = one.reader.read_run(cdrs)
        run = [] if read is None else odometry.of_run(one.source, read, after_ns)
        count = one.publisher.accept_run(run)
        if read is None or not count:
            return []
        odometry.count_repairs(one.source, count)
        self._count_tally(one.source)
        self._counters.received[name] += count
        self._transforms.now_ns = max(run[count - 1].stamp_ns, self._transforms.now_ns or 0)
        self.decoded = read.first(count)
        return run[:count]

    def finish(self, *, is_end: bool = True) -> list[Measured]:
        """Use or refuse what still needs a transform; at the end of all messages also the odometry that is kept."""
        publishers = self._publishers() if is_end else ()
        out: list[Measured] = [m for one in publishers for m in one.finish()]
        out += [one for pending in self._pending for one in self._hurried(*pending)]
        self._pending.clear()
        return out

    def unlinked(self, name: str) -> tuple[tuple[str, str], ...]:
        """Frames of an input, each with the frame that it is not linked to, from the last messages refused for that."""
        return tuple(self._inputs[name].source.unlinked)

    def not_found(self, name: str) -> str:
        """The odometry on /tf whose transform has never come, and the remedy; else empty."""
        source = self._inputs[name].source
        return odometry.not_found(source) if source.use == "odometry" else ""

    def initial_pose(self, cdr: bytes) -> list[InitialPose]:
        """Convert a geometry_msgs/PoseWithCovarianceStamped of ``initialpose`` if it can be used."""
        out: list[Any] = self.convert(INITIAL_POSE, cdr)
        return out

    def begin_at(self, datum: tuple[float, ...]) -> None:
        """Set the datum: the latitude, longitude and height for inputs that have no datum of their own."""
        self._origin.datum = datum

    def forget_time(self) -> None:
        """Begin anew with the stamps: earlier transforms of moving joints belong to another time."""
        self._pending.clear()
        for publisher in self._publishers():
            publisher.forget_time()
        self._transforms.forget_time()

    def _publishers(self) -> list[OnePublisher]:
        return [one.publisher for one in self._inputs.values() if one.publisher is not None]

    def _hurried(self, one: _Input, message: Any) -> list[Measured]:
        before, one.source.hurried = one.source.hurried, True
        out = self._converted(one, message)
        one.source.hurried = before
        return out

    @np.errstate(invalid="ignore")  # a signalling NaN warns where it is compared; it is refused by name
    def _converted(self, one: _Input, message: Any) -> list[Any]:
        out: list[Any] = []
        source = one.source
        try:
            out += one.convert(source, message)
        except NotYet as why:
            self._awaits_stamp |= why.is_linked
            source.tally.clear()
            self._pending.append((one, message))
            return []
        except PluginFault as fault:
            source.count("plugin_failed")
            if source.state.setdefault("first fault", fault) is fault:
                self.on_fault(f"{source.name}: {fault}")
        except MessageError as reason:
            source.count(str(reason))
        if source.tally:
            self._count_tally(source)
        return out

    def _count_tally(self, source: InputContext) -> None:
        for why, times in source.tally.items():
            self._counters.count(source.name, why, times)
        source.tally.clear()

    # -- transforms --------------------------------------------------------------------------------------------------

    def _transforms_of(
        self, add: Callable[[Any, str, str, Any], None], source: InputContext, message: Any
    ) -> list[Measured]:
        for t in message.transforms:
            try:
                checks.point(t.transform.translation)
                q = source.unit(t.transform.rotation)
                parent, child = source.frame(t.header.frame_id), source.frame(t.child_frame_id)
                if parent == child:
                    raise MessageError("frame_in_itself")
                add(t, parent, child, pose(t.transform.translation, q))
            except MessageError as reason:
                source.count(str(reason))
        return []

    def _add_static(self, t: Any, parent: str, child: str, T_parent_child: Any) -> None:
        self._transforms.add(parent, child, T_parent_child)

    def _add_moving(self, t: Any, parent: str, child: str, T_parent_child: Any) -> None:
        if parent != self._config.frames.map:  # that is what we estimate: nothing may be measured by it
            self._transforms.add_at(checks.stamp_ns(t.header.stamp), parent, child, T_parent_child)
