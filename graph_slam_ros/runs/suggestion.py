"""The replay command that fits a recording: which topics are inputs, and which only look like inputs.

Users may have chosen some of its parameters and topics: these come before what is suggested.
"""

import re
import shlex
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from graph_slam_ros.check.gyro import upright
from graph_slam_ros.check.pairs import ASSUMED_BEARING_RAD, ASSUMED_RANGE_M
from graph_slam_ros.config import Config
from graph_slam_ros.config.inputs import ASSUMED, default_input
from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.formats.parameters import assignment
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, TRANSFORMS
from graph_slam_ros.messages.inputs import APRILTAGS, CONVERTERS, LANDMARK_TYPES, converters, known_types
from graph_slam_ros.messages.inputs.transforms import MAP_FRAMES
from graph_slam_ros.overview.chosen_inputs import TF_STATIC_TOPIC, TF_TOPIC, Inputs, choose_inputs, is_truth
from graph_slam_ros.overview.contents import Recording, TopicContents, recording_of
from graph_slam_ros.overview.suggested_odometry import DETECTIONS, ESTIMATE, ODOMETRY, POSES, OdometryChoice, readable
from graph_slam_ros.recordings.bag import Bag, BagError, open_bag
from graph_slam_ros.runs.folder import suggested_out

MARKERS = "visualization_msgs/msg/MarkerArray"
CLOUD, GNSS, IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
POSE, POSE_WITH_COVARIANCE = POSES
OF_LANDMARKS = frozenset({DETECTIONS, CLOUD, *LANDMARK_TYPES})
"""Types of messages that have landmarks."""

_TAG = re.compile(r"((?:.*[/_])?(?:tag|aruco|marker|fiducial).*?)[:_]?\d+", re.IGNORECASE)
_TAG_TOPIC = re.compile(r"(?:tag|aruco|marker|fiducial)[_/:]?(\d+)(?:/pose)?$", re.IGNORECASE)
_CORNERS = re.compile(r"^(?!.*map).*(tag|aruco|fiducial)", re.IGNORECASE)
_WITHOUT_ID = re.compile(r"/(PoseArray|Detection2DArray)$")
_OF_ROS = ("/clock", "/rosout", "/parameter_events", "/diagnostics", "/events/write_split", "/robot_description")
_MOST_LISTED = 6
_LEVEL_RAD = 0.1  # of a sensor on a robot that may brake or stand on a slope
_CLOCKS_DIFFER_S = 2.0


class Suggestion:
    """A command, and notes for the user.

    Parameters
    ----------
    odometry, landmarks : topics; the suggestion is that for a recording in which they are the only ones of their kinds
    given : parameters by dotted name that the user has chosen: they come before those that are suggested

    Attributes
    ----------
    recording : its contents
    settings : parameters that differ from their defaults, by dotted name
    assumed : those of them that the user has not chosen; none where the inputs are given
    topics, names : of odom and detections; of all inputs
    notes : sentences: what was chosen and why, and what is assumed
    unused : why a topic that could be an input is not offered, by its name
    perhaps : topics of these that may have landmarks: nobody but the user knows
    trouble : why there is no command; empty where there is one
    """

    def __init__(
        self,
        bag: Bag,
        path: Path,
        odometry: str | None = None,
        landmarks: str | None = None,
        given: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        has_names = "inputs.names" in given
        if not has_names:
            odometry, landmarks = odometry or _topic_of(given, "odom"), landmarks or _topic_of(given, "detections")
        self._bag, self._path, self._asked = bag, path, (odometry, landmarks)
        self.recording = recording_of(bag)
        self._recording = _with_only(self.recording, odometry, landmarks)
        self.unused: dict[str, str] = {}
        self.perhaps: list[str] = []
        chosen = OdometryChoice(self._recording, self.unused)
        self._odometry, self._base, self._odom = chosen.contents, chosen.base, chosen.odom
        self.settings, self.notes, self.trouble = chosen.settings, chosen.notes, chosen.trouble
        self.topics = {"odom": chosen.topic} if chosen.topic else {}
        self.names = [] if self.trouble else ["odom"]
        if not self.trouble:
            self._choose_landmarks()
            self._choose_fixes()
            self._finish()
            try:  # whether the command would be refused
                config = Config.from_mapping(self.settings)
                choose_inputs(bag, config, self.topics.get("odom"), self.topics.get("detections"))
            except GraphSlamError as error:
                self.trouble = str(error)
        self._is_used = not self.trouble and not has_names
        self.assumed = {name: value for name, value in self.settings.items() if self._is_used and name not in given}

    def inputs(self, config: Config) -> Inputs:
        """The topics of the inputs of a configuration: named, suggested, configured, or the only ones of their types.

        Raises BagError: a topic does not exist or has another type, or there is none.
        """
        used = {one.name for one in config.sources if one.use != "none"} if self._is_used else set[str]()
        topics, (odometry, landmarks) = {name: self.topics[name] for name in used & self.topics.keys()}, self._asked
        return choose_inputs(self._bag, config, odometry or topics.get("odom"), landmarks or topics.get("detections"))

    def command(self, more: Mapping[str, Any] = MappingProxyType({}), name: str = "replay") -> str:
        """The command to paste into a shell, with additional settings, which come before what is assumed."""
        path = str(self._path)
        words = ["graph_slam", name, f"./{path}" if path.startswith("-") else path]
        for option, source in (("--odom", "odom"), ("--landmarks", "detections")):
            words += [option, self.topics[source]] if source in self.topics else []
        for key, value in (self.assumed | dict(more)).items():
            words += ["--set", assignment(key, value)]
        return shlex.join([*words, *(("--out", str(suggested_out(self._path))) if name == "replay" else ())])

    # -- landmarks -----------------------------------------------------------------------------------------------

    def _choose_landmarks(self) -> None:
        for one in readable(self._recording, self.unused, DETECTIONS):
            self._detections(one)
        for one in readable(self._recording, self.unused, CLOUD):
            self._cloud(one)
        for one in readable(self._recording, self.unused, *LANDMARK_TYPES):
            if one.topic.type == APRILTAGS and not one.ids & self._recording.moving.keys():
                self._corners(one)
            else:
                self._add(LANDMARK_TYPES[one.topic.type].input_name, one)
        for one in readable(self._recording, self.unused, POSE, POSE_WITH_COVARIANCE):
            if number := self._tag_number(one):
                self._add("tag", one, {"use": "landmarks", "id": number})
        prefixes = {found[1] for found in map(_TAG.fullmatch, self._recording.moving) if found}
        if not any(name.startswith("tags") for name in self.names):
            for prefix in sorted(prefixes):
                chosen = {"type": TRANSFORMS, "topic": TF_TOPIC, "use": "landmarks", "frame_prefix": prefix}
                frame = next(p for c, p in self._recording.moving.items() if c.startswith(prefix))
                self._set(self._free("tags"), chosen | self._mount(TF_TOPIC, frame))
        known = known_types()
        for one in readable(self._recording, self.unused, *(known - CONVERTERS.keys())):
            try:
                converters(one.topic.type)
                self._add("plugin", one)
            except GraphSlamError as error:
                self.unused[one.topic.name] = str(error)
        for one in self._recording.topics.values():
            if _CORNERS.search(one.topic.type) and one.topic.type not in known:
                self._corners(one)

    def _tag_number(self, one: TopicContents) -> str:
        """The number of the tag whose pose in the camera's frame a topic has; empty for any other topic."""
        found = _TAG_TOPIC.search(one.topic.name)
        return found[1] if found and one.frame not in (*MAP_FRAMES, "world", self._odom) else ""

    def _corners(self, one: TopicContents) -> None:
        corners = "these are corners without poses: run a pose estimator first, e.g. apriltag_ros on the images"
        poses = f"no input reads {one.topic.type}: publish its poses as {DETECTIONS}, or a plugin (docs/inputs.md)"
        self.unused[one.topic.name] = poses if "geometry_msgs/Pose" in one.topic.definition else corners

    def _detections(self, one: TopicContents) -> None:
        if not one.items:
            self.unused[one.topic.name] = "empty"
        elif one.ids and not one.without_id and all(id_.isdecimal() and len(id_) >= 15 for id_ in one.ids):
            self._add("closures", one, {"use": "closure"})
        else:
            if one.without_id == one.items and len(one.classes) > 1 and not one.is_repeated:
                self.settings["landmarks.id_from"] = "class_id"
                self.notes.append(f"{one.topic.name}: ids are empty, class ids are taken instead")
            elif one.without_id > 0.5 * one.items:
                self._join(one)
            self._add("detections", one)

    def _join(self, one: TopicContents) -> None:
        self.settings["landmarks.association"] = "joint"
        self.notes.append(f"{one.topic.name} has no ids: landmarks are associated by their position")

    def _cloud(self, one: TopicContents) -> None:
        is_position, is_bearing = {"x", "y"} <= one.fields, "bearing" in one.fields
        if not (is_position or is_bearing or "range" in one.fields):
            return
        if "id" not in one.fields and not (is_bearing and "range" in one.fields):
            self.unused[one.topic.name] = "points without ids: a scan is no list of landmarks"
        elif is_bearing and "elevation" not in one.fields and self.settings.get("world.dimensions") == 3:
            self.unused[one.topic.name] = "bearings without elevation, in three dimensions"
        else:
            has_sigma = one.fields & {"sigma_bearing"} or (one.fields & {"sigma"} and "range" not in one.fields)
            chosen: dict[str, Any] = {"sigma_rad": ASSUMED_BEARING_RAD} if is_bearing and not has_sigma else {}
            if chosen:
                self.notes.append(f"{one.topic.name} has no noise of bearings: {ASSUMED_BEARING_RAD} rad is assumed")
            if "range" in one.fields and "sigma" not in one.fields:
                chosen["sigma_m"] = ASSUMED_RANGE_M
                self.notes.append(f"{one.topic.name} has no noise of ranges: {ASSUMED_RANGE_M} m is assumed")
            if "id" not in one.fields:
                self._join(one)
            self._add("ranges" if "range" in one.fields else "points", one, chosen)

    # -- fixes ---------------------------------------------------------------------------------------------------

    def _choose_fixes(self) -> None:
        receivers = sorted(readable(self._recording, self.unused, GNSS), key=lambda one: -one.usable)
        if receivers and (best := receivers[0]).usable:
            self._add("gps", best, {} if best.has_noise else {"sigma_m": 2.0}, linked=True)
            self._mount(best.topic.name, best.frame)  # says what is assumed; the input itself assumes and counts it
            if not best.has_noise:
                self.notes.append(f"{best.topic.name} has no covariance: 2 m is assumed")
        for one in receivers[1:]:
            self.unused[one.topic.name] = "another receiver"
        self._choose_imu(readable(self._recording, self.unused, IMU), is_needed=len(self.names) == 1)
        for one in readable(self._recording, self.unused, POSE, POSE_WITH_COVARIANCE):
            is_landmark, is_odometry = bool(self._tag_number(one)), one.topic.name == self.topics.get("odom")
            if not (is_landmark or is_odometry):
                self._pose(one)

    def _pose(self, one: TopicContents) -> None:
        name, noise = one.topic.name, {} if one.has_noise else {"sigma_m": 0.1}
        if ESTIMATE.search(name):
            self.unused[name] = "the output of a localiser, or a goal: no measurement"
        elif one.frame == self._odom:
            self.unused[name] = "in the frame of the odometry: it says the same"
        elif one.topic.type == POSE or len(self.names) > 1:
            as_fix = self._as_input("pose", one, frame="map", **noise)
            self.unused[name] = f"a pose may be an estimate or the truth; as a fix: {as_fix}"
        else:
            self._add("pose", one, ({} if one.frame == "map" else {"frame": "map"}) | noise, linked=True)
            self.notes.append(f"{name} is taken for a fix: if it is an estimate or the truth, leave it out")

    def _as_input(self, name: str, one: TopicContents, **more: Any) -> str:
        """The settings that make a topic an input, too."""
        own = {"type": one.topic.type, "topic": one.topic.name} | more
        settings = {"inputs.names": " ".join([*self.names, name])} | {f"{name}.{key}": own[key] for key in own}
        return " ".join(f"--set {shlex.quote(f'{key}={value}')}" for key, value in settings.items())

    def _choose_imu(self, found: Iterator[TopicContents], is_needed: bool) -> None:
        for one in sorted(found, key=lambda one: -one.usable):
            angles = upright(tuple(total / max(one.read, 1) for total in one.felt))
            turn = " ".join(f"{0.0 if abs(angle) < _LEVEL_RAD else angle:.4g}" for angle in angles)
            mount = {} if self._recording.is_linked(one.frame, self._base) else {"mount": f"0 0 0 {turn} 0"}
            as_gyro = f"Its gyro as part of odometry: {self._as_input('imu', one, **mount, use='gyro')}"
            if one.usable < 0.5 * one.read:
                self.unused[one.topic.name] = f"it has no orientation (an IMU with a filter has). {as_gyro}"
            elif not is_needed:
                self.unused[one.topic.name] = f"its heading may drift, and there is better. {as_gyro}"
            else:
                self._add("imu", one, {} if one.has_noise else {"sigma_rad": 0.05})
                is_needed = False

    # -- what all inputs need --------------------------------------------------------------------------------------

    def _add(self, name: str, one: TopicContents, chosen: dict[str, Any] | None = None, linked: bool = False) -> None:
        topic = one.topic.name
        if one.is_zero:
            self.unused[topic] = "its stamps are zero: have the driver fill in header.stamp"
            return
        offset_s = 0.0 if self._odometry is None else one.clock_offset_s(self._odometry)
        settings = dict(chosen or {}) | ({} if linked else self._mount(topic, one.frame))
        if abs(offset_s) > _CLOCKS_DIFFER_S:
            settings["offset_s"] = round(offset_s, 3)
            self.notes.append(f"{topic} has another clock than odometry: {offset_s:.3f} s are added to its stamps")
        name = self._free(name)
        if name == "detections":
            self.topics[name] = topic
        else:
            settings = {"type": one.topic.type, "topic": topic} | settings
        self._set(name, settings)

    def _set(self, name: str, chosen: dict[str, Any]) -> None:
        self.names.append(name)
        self.settings |= {f"{name}.{key}": value for key, value in chosen.items()}

    def _mount(self, topic: str, frame: str) -> dict[str, str]:
        """Return the pose of a sensor that TF does not have."""
        if frame and self._recording.is_linked(frame, self._base):
            return {}
        if frame == self._odom and self._recording.moves_in(self._base, frame):
            self.notes.append(f"{topic} is given in {frame}: /tf says where the robot is in it")
            return {}
        if alike := self._recording.alike(frame, self._base):
            self.notes.append(f"{topic}: no transform has {frame}: did you mean {alike}? It is taken; mend the driver")
            return {"frame": alike}
        if not frame and self._recording.topics[topic].topic.type == APRILTAGS:
            self.notes.append(f"{topic} names no frame: have the driver of the camera fill in header.frame_id")
            return {}
        if frame in (self._odom, *MAP_FRAMES):
            why = f"{topic} is given in {frame}, a frame that does not move with the robot"
            self.notes.append(f"{why}: publish it in the sensor's frame, no setting mends that")
            return {"mount": ASSUMED}
        where = "at the base, looking ahead" if "optical" in frame else "at the base"
        named = frame or "its sensor, which it does not name,"
        assumed = f"{where} is assumed: publish it on /tf_static, or measure it and set its mount"
        self.notes.append(f"{topic}: no transform has the pose of {named} on the robot: {assumed}")
        return {"mount": ASSUMED}

    def _free(self, name: str) -> str:
        number = 1 + sum(re.fullmatch(rf"{name}(_\d+)?", other) is not None for other in self.names)
        return name if number == 1 else f"{name}_{number}"

    def _finish(self) -> None:
        names = " ".join(self.names)
        if names != Config().inputs.names:
            self.settings = {"inputs.names": names} | self.settings
        if self.names == ["odom"]:
            self.notes.append("nothing corrects this odometry: the result will be odometry alone (exit code 3)")
        self._not_read()

    def _not_read(self) -> None:
        """Topics that no input reads, one of which the user may expect to be used."""
        for name, one in self._recording.topics.items():
            usual = f"/{name.rpartition('/')[2]}"
            is_usual = usual in (TF_TOPIC, TF_STATIC_TOPIC) and usual in self._recording.topics
            if one.topic.type == TRANSFORMS and is_usual and name != usual:
                self.unused[name] = f"{usual} is there, and it alone is read"
            elif why := self._perhaps_landmarks(one):
                self.unused[name] = why
                self.perhaps.append(name)
        known = known_types()
        found = [
            f"{name} ({one.topic.type or 'no type'})"
            for name, one in sorted(self._recording.topics.items())
            if one.topic.type not in known and name not in self.unused and name not in _OF_ROS
        ]
        if found:
            more = f" and {len(found) - _MOST_LISTED} more" if len(found) > _MOST_LISTED else ""
            note = f"no input reads {', '.join(found[:_MOST_LISTED])}{more}: their types are none of docs/inputs.md"
            own = "; landmarks in a type of your own: a plugin (docs/inputs.md), or publish them as Detection3DArray"
            self.notes.append(note + own * (self.names == ["odom"]))

    def _perhaps_landmarks(self, one: TopicContents) -> str:
        """Return how a topic is used that may have landmarks or fixes, by its type; empty for any other."""
        name, of = one.topic.name, one.topic.type
        if is_truth(name) or not one.topic.count:
            return ""
        if of == MARKERS:
            return f"markers are mostly pictures; where they are landmarks: {self._as_input('markers', one)}"
        if of == GNSS and not one.usable:
            return "no message has a fix"
        if _WITHOUT_ID.search(of):
            return f"no input reads {of}, which has no ids; where these are landmarks, publish them as {DETECTIONS}"
        return ""


def _with_only(recording: Recording, odometry: str | None, landmarks: str | None) -> Recording:
    """The recording without other topics of odometry and landmarks than the given ones."""
    topics = recording.topics
    if odometry in topics:
        kind = topics[odometry].topic.type
        topics = {name: one for name, one in topics.items() if name == odometry or one.topic.type != kind}
    if landmarks in topics:
        topics = {n: one for n, one in topics.items() if n == landmarks or one.topic.type not in OF_LANDMARKS}
    return replace(recording, topics=topics)


def _topic_of(given: Mapping[str, Any], name: str) -> str | None:
    """The topic that somebody has given an input, with its slash."""
    topic = given.get(f"{name}.topic")
    return None if topic is None else f"/{str(topic).lstrip('/')}"


def suggestion_for_other_types(path: Path, config: Config, odometry: str | None = None) -> Suggestion | None:
    """Return how to replay a recording whose odometry or landmarks are of other types than the usual, or are fixes.

    None where they are usual, where other inputs are configured, or where there is nothing else in it. ``odometry`` is
    its topic, or else the suggested one. Raises BagError: it cannot be read.
    """
    if config.inputs.names != Config().inputs.names:
        return None
    bag, usual, chosen = open_bag(path), f"/{default_input('detections').topic}", dict[str, str]()
    try:
        chosen = {**choose_inputs(bag, config, odometry).topics}
        if chosen.get("detections") == usual or chosen.keys() - {"odom", "detections", TF, TF_STATIC}:
            return None
    except BagError:  # which the replay says
        is_usual = next(one for one in config.sources if one.name == "odom") == default_input("odom")
        if odometry or not is_usual or any(topic.type == ODOMETRY for topic in bag.topics.values()):
            return None
    found = Suggestion(bag, path, odometry)
    is_same = "detections" in chosen and chosen["detections"] == found.topics.get("detections")
    return None if found.trouble or len(found.names) < 2 or is_same else found


def unused_topics(path: Path, used: Collection[str]) -> list[str]:
    """Topics that have odometry, landmarks or fixes by their type, and are none of those that inputs have used."""
    topics = (
        one for one in open_bag(path).topics.values() if one.count and one.type in (*OF_LANDMARKS, ODOMETRY, GNSS)
    )
    return sorted(f"{one.name} ({one.type})" for one in topics if one.name not in used and not is_truth(one.name))
