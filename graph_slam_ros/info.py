"""What a recording holds, and the replay command that fits."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from graph_slam_ros.replay import TF_TOPIC, choose_inputs
from graph_slam_ros.ros.bag import Bag, BagError
from graph_slam_ros.ros.definitions import recorded_decoder
from graph_slam_ros.ros.from_msg import TRANSFORMS
from graph_slam_ros.ros.inputs import CONVERTERS
from graph_slam_ros.slam import Config

_ARROW = " -> "
_TRANSFORMS_READ = 1000  # of /tf, to see what it tells of
_TAG = re.compile(r"((?:.*[/_])?(?:tag|aruco|marker|fiducial).*?)[:_]?\d+", re.IGNORECASE)
# Other types may be truth or debugging just as well: these are inputs if they are there at all.
_SUGGESTED = {
    "sensor_msgs/msg/NavSatFix": "gps",
    "apriltag_msgs/msg/AprilTagDetectionArray": "tags",
    "aruco_msgs/msg/MarkerArray": "tags",
    "ros2_aruco_interfaces/msg/ArucoMarkers": "tags",
    "aruco_opencv_msgs/msg/ArucoDetection": "tags",
    "rtabmap_msgs/msg/LandmarkDetections": "tags",
    "cartographer_ros_msgs/msg/LandmarkList": "reflectors",
    "mrpt_msgs/msg/ObservationRangeBearing": "beacons",
    "mrpt_msgs/msg/ObservationRangeBeacon": "beacons",
}


def describe(bag: Bag, path: Path) -> list[str]:
    """Topics, types, rates, frames and span of a recording, and the replay command that fits."""
    span: dict[str, tuple[int, int]] = {}
    frames: dict[str, str] = {}
    decoders = _decoders(bag)
    links: dict[str, str] = {}
    transforms_left = _TRANSFORMS_READ
    for message in bag.messages(set(bag.topics)):
        first, _ = span.get(message.topic, (message.log_ns, 0))
        span[message.topic] = (first, message.log_ns)
        if message.topic == TF_TOPIC and message.topic in decoders:
            if transforms_left:
                transforms_left -= 1
                links.update(_links(decoders[message.topic], message.cdr))
        elif message.topic in decoders and message.topic not in frames:
            frames[message.topic] = _frames(decoders[message.topic], message.cdr)
    lines = []
    for name, topic in sorted(bag.topics.items()):
        first, last = span.get(name, (0, 0))
        rate = f"{(topic.count - 1) / ((last - first) * 1e-9):.1f} Hz" if last > first else "-"
        lines.append(f"{name:28s} {topic.type:40s} {topic.count:8d}  {rate:>10s}  {frames.get(name, '')}".rstrip())
    if span:
        first, last = min(a for a, _ in span.values()), max(b for _, b in span.values())
        lines.append(f"span {(last - first) * 1e-9:.3f} s, from {first * 1e-9:.3f}")
    lines.append(_suggestion(bag, path, frames, links))
    return lines


def _decoders(bag: Bag) -> dict[str, Callable[[bytes], Any]]:
    out = {}
    for topic in bag.topics.values():
        if topic.type in CONVERTERS:
            try:
                out[topic.name] = recorded_decoder(topic)
            except BagError:  # replay says so where the topic is used
                continue
    return out


def _frames(decode: Callable[[bytes], Any], cdr: bytes) -> str:
    try:
        message = decode(cdr)
    except Exception:  # damaged bytes: replay counts them
        return "(undecodable)"
    if not hasattr(message, "header"):
        return ""
    child = getattr(message, "child_frame_id", "")
    return f"{message.header.frame_id}{_ARROW + child if child else ''}"


def _links(decode: Callable[[bytes], Any], cdr: bytes) -> dict[str, str]:
    try:
        return {t.child_frame_id.lstrip("/"): t.header.frame_id.lstrip("/") for t in decode(cdr).transforms}
    except Exception:
        return {}


def _suggestion(bag: Bag, path: Path, frames: dict[str, str], links: dict[str, str]) -> str:
    usual = Config()
    settings: dict[str, str] = {}
    try:
        inputs = choose_inputs(bag, usual)
        options = ["--odom", inputs.topics["odom"]]
        if "detections" in inputs.topics:
            options += ["--landmarks", inputs.topics["detections"]]
        parent, _, child = frames.get(inputs.topics["odom"], "").partition(_ARROW)
        if parent not in ("", usual.frames.odom):
            settings["frames.odom"] = parent
        if child not in ("", usual.frames.base):
            settings["frames.base"] = child
    except BagError as error:
        if links.get(usual.frames.base) != usual.frames.odom or "--odom" in str(error):
            return f"not ready for replay: {error}"
        options, settings = [], {"odom.type": TRANSFORMS, "odom.topic": TF_TOPIC}
    more = _more(bag, links)
    if more:
        settings["inputs.names"] = " ".join([usual.inputs.names, *more])
    for name, chosen in more.items():
        settings |= {f"{name}.{key}": value for key, value in chosen.items()}
    for key, value in settings.items():
        options += ["--set", f"{key}={value}"]
    return shlex.join(["graph_slam", "replay", str(path), *options, "--out", "run"])


def _more(bag: Bag, links: dict[str, str]) -> dict[str, dict[str, str]]:
    """Inputs that are there besides the usual ones: name to settings."""
    out: dict[str, dict[str, str]] = {}
    for topic in bag.topics.values():
        if topic.type in _SUGGESTED:
            out[_free(_SUGGESTED[topic.type], out)] = {"type": topic.type, "topic": topic.name}
    prefixes = {found[1] for found in map(_TAG.fullmatch, links) if found}
    if not any(name.startswith("tags") for name in out):
        for prefix in sorted(prefixes):
            chosen = {"type": TRANSFORMS, "topic": TF_TOPIC, "use": "landmarks", "frame_prefix": prefix}
            out[_free("tags", out)] = chosen
    return out


def _free(name: str, taken: dict[str, Any]) -> str:
    return name if name not in taken else f"{name}_{sum(other.startswith(name) for other in taken) + 1}"
