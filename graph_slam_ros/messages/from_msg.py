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
from graph_slam_ros.messages.inputs.transforms import Transforms
from graph_slam_ros.messages.interfaces import typestore
from graph_slam_ros.messages.one_publisher import OnePublisher

Decoder = Callable[[bytes], Any]

TRANSFORMS = "tf2_msgs/msg/TFMessage"
TF_STATIC, TF, INITIAL_POSE = "tf_static", "tf", "initialpose"


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


def twist_of(message: Any, base_frame: str) -> bytes | None:
    """The geometry_msgs/TwistWithCovariance, little endian, of a nav_msgs/Odometry.

    None if its frame is not the base, because the motion of a wheel or a sensor is not that of the robot.
    """
    if message.child_frame_id.lstrip("/") != base_frame:
        return None
    v, w = message.twist.twist.linear, message.twist.twist.angular
    return struct.pack("<6d", v.x, v.y, v.z, w.x, w.y, w.z) + message.twist.covariance.astype("<f8").tobytes()


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
        self._transforms = Transforms(refuse=partial(counters.count, TF, "far_in_time"))
        self._links, self._awaits_stamp = 0, False  # of the last try of what waits
        self._inputs: dict[str, _Input] = {}
        self._pending: deque[tuple[_Input, Any]] = deque()  # for /tf to tell where their sensors were
        by_name = {settings.name: settings for settings in config.sources}
        datums = (settings.numbers("datum", 3) for settings in config.sources)
        self._origin = Origin(next(filter(None, datums), ()))
        for name, use in uses(config).items():
            counters.received[name] += 0
            self._add(by_name[name], use, (converters(by_name[name].type) or {})[use])
        for name in (TF_STATIC, TF):
            self._add(InputConfig(name, type=TRANSFORMS), "none", self._add_transforms)
        posed, person = "geometry_msgs/msg/PoseWithCovarianceStamped", config.initialpose
        given = InputConfig(INITIAL_POSE, type=posed, sigma_m=person.sigma_m, sigma_rad=person.sigma_rad)
        self._add(given, "none", fixes.initial_pose)

    def _add(self, settings: InputConfig, use: str, convert: Callable[..., Any]) -> None:
        name, source = settings.name, InputContext(settings, use, self._config, self._transforms, self._origin)
        decode = self._decoders.get(settings.type) or own_decoder(settings.type)
        one = self._inputs[name] = _Input(source, decode, convert)
        if use == "odometry":
            refuse = (partial(self._counters.count, name, reason) for reason in ("other_publisher", "future"))
            one.publisher = OnePublisher(self._config.odometry.timeout_s, *refuse)
            if decode is own_decoder(odometry.TYPE):  # else its bytes may have other places
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
            if out:
                self._transforms.now_ns = max(self._transforms.now_ns or 0, *(m.stamp_ns for m in out))
        if (name == TF or one.publisher is not None) and self._may_be_usable():
            self._awaits_stamp = False
            for _ in range(len(self._pending)):
                out += self._converted(*self._pending.popleft())
        elif len(self._pending) > self._config.ordering.max_waiting:
            out += self._converted(*self._pending.popleft(), is_hurried=True)
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
        run, repairs = ([], []) if read is None else odometry.of_run(one.source, read, after_ns)
        run = run[: one.publisher.accept_run(run)]
        if read is None or not run:
            return []
        for repair in repairs:
            self._counters.count(name, repair, len(run))
        self._counters.received[name] += len(run)
        self._transforms.now_ns = max(run[-1].stamp_ns, self._transforms.now_ns or 0)
        self.decoded = read.first(len(run))
        return run

    def finish(self, *, is_end: bool = True) -> list[Measured]:
        """Use or refuse what still needs a transform; at the end of all messages also the odometry that is kept."""
        publishers = self._publishers() if is_end else ()
        out: list[Measured] = [m for one in publishers for m in one.finish()]
        out += [m for pending in self._pending for m in self._converted(*pending, is_hurried=True)]
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

    @np.errstate(invalid="ignore")  # a signalling NaN warns where it is compared; it is refused by name
    def _converted(self, one: _Input, message: Any, *, is_hurried: bool = False) -> list[Any]:
        out, source = list[Any](), one.source
        source.is_hurried = is_hurried or not self._config.inputs.tf
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
        for what, times in source.tally.items():
            self._counters.count(source.name, what, times)
        source.tally.clear()
        return out

    def _add_transforms(self, source: InputContext, message: Any) -> list[Measured]:
        def add(t: Any) -> None:
            T_parent_child = source.placed(t.transform.translation, t.transform.rotation)
            parent, child = source.frame(t.header.frame_id), source.frame(t.child_frame_id)
            if parent == child:
                raise MessageError("frame_in_itself")
            if source.name == TF_STATIC:
                self._transforms.add(parent, child, T_parent_child)
            elif parent != self._config.frames.map:  # that is what we estimate: nothing may be measured by it
                self._transforms.add_at(checks.stamp_ns(t.header.stamp), parent, child, T_parent_child)

        for _ in source.each(message.transforms, add):
            pass
        return []
