"""The odometry of a recording that a replay is to use, and the frames that it brings."""

import itertools
import re
from collections.abc import Iterator, Sequence
from typing import Any

from graph_slam_ros.config.inputs import ASSUMED
from graph_slam_ros.messages.from_msg import TRANSFORMS
from graph_slam_ros.messages.inputs import LANDMARK_TYPES
from graph_slam_ros.messages.inputs.transforms import MAP_FRAMES
from graph_slam_ros.overview.chosen_inputs import TF_TOPIC, WORD, is_truth
from graph_slam_ros.overview.contents import Recording, TopicContents

ODOMETRY, DETECTIONS = "nav_msgs/msg/Odometry", "vision_msgs/msg/Detection3DArray"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
ESTIMATE = re.compile(
    WORD.format(
        r"amcl\w*|\w*slam\w*|cartographer|rtabmap|locali[sz]\w*|mcl|tracked_pose|initialpose|goal\w*|pose_est\w*"
    ),
    re.IGNORECASE,
)
"""Topics that are the output of a localiser, or a goal, by their names."""
_FUSED = re.compile(r"filtered|fused|[eu]kf|combined", re.IGNORECASE)
_NOT_MEASURED = re.compile(r"raw|cmd|desired|target|set_?point|plan", re.IGNORECASE)
_OF_ODOMETRY = re.compile(r"odom|vio|vins|visual|[eu]kf|fused|filtered|dead_?reck", re.IGNORECASE)
_OFF_PLANE, _LEAST_M = 0.05, 0.05


class OdometryChoice:
    """The odometry that is chosen.

    Parameters
    ----------
    unused : as of a ``Suggestion``; it is filled

    Attributes
    ----------
    settings, notes : as of a ``Suggestion``
    topic : of messages that have a topic of their own; empty for those of /tf
    contents : of that topic
    base, odom : names of frames
    trouble : why there is no odometry; empty where there is one
    """

    def __init__(self, recording: Recording, unused: dict[str, str]) -> None:
        self._recording, self._unused = recording, unused
        self.settings: dict[str, Any] = {}
        self.notes: list[str] = []
        self.topic = ""
        self.contents: TopicContents | None = None
        self.base, self.odom = "base_link", "odom"
        is_found = self._best_of(list(self._candidates(ODOMETRY))) or self._of_tf() or self._of_poses()
        self.trouble = "" if is_found else self._nothing()

    def _candidates(self, *types: str) -> Iterator[TopicContents]:
        """Topics of some types that may be odometry."""
        for one in readable(self._recording, self._unused, *types):
            name = one.topic.name
            if one.frame in MAP_FRAMES:
                self._unused[name] = f"in frame {one.frame}: somebody's estimate, not odometry"
            elif one.topic.type != ODOMETRY and ESTIMATE.search(name):
                self._unused[name] = "the output of a localiser, or a goal, not odometry"
            elif one.is_zero:
                self._unused[name] = "its stamps are zero: have the driver fill in header.stamp"
            else:
                yield one

    def _best_of(self, found: list[TopicContents]) -> bool:
        """Choose the best of several topics; False where there is none."""
        if not found:
            return False
        best = max(found, key=self._merit)
        for one in found:
            if one is not best:
                self._unused[one.topic.name] = "another odometry"
        if len(found) > 1:
            self.notes.append(f"{len(found)} odometries: {best.topic.name} is chosen; --odom takes another")
        self.topic, self.contents = best.topic.name, best
        self._leave_out_other_robots([one.topic.name for one in found])
        self._frames(best.frame, best.child if best.topic.type == ODOMETRY else self.base)
        if best.off_plane > _OFF_PLANE * best.read:
            self.settings["world.dimensions"] = 3
            self.notes.append(f"{best.topic.name} leaves the plane: these are three dimensions")
        return True

    def _leave_out_other_robots(self, odometries: Sequence[str]) -> None:
        """Landmarks in the namespace of another odometry are of its robot, where any are in that of the chosen one."""
        seen = [name for name, one in self._recording.topics.items() if one.topic.type in (DETECTIONS, *LANDMARK_TYPES)]
        own = _namespace(self.topic)
        if own and own in map(_namespace, seen):
            for other, name in itertools.product(odometries, seen):
                if _namespace(name) == _namespace(other) != own:
                    self._unused[name] = f"of the robot of {other}: --odom {other} --landmarks {name} replay that one"

    def _of_poses(self) -> bool:
        """Choose poses that are odometry by the name of their frame or topic."""
        moving = [one for one in self._candidates(*POSES) if one.path_m > _LEAST_M]
        found = [one for one in moving if _OF_ODOMETRY.search(f"{one.frame} {one.topic.name}")]
        if not self._best_of(found):
            return False
        chosen = self._recording.topics[self.topic].topic
        self.settings |= {"odom.type": chosen.type, "odom.use": "odometry"}
        self.notes.append(
            f"odometry is {self.topic}, poses without a child frame: they are taken for those of {self.base}"
        )
        return True

    def _merit(self, one: TopicContents) -> tuple[Any, ...]:
        """The order of preference: complete and moving, then fused, then in a frame of odometry, then most messages."""
        longest = max(other.last_ns - other.first_ns for other in self._recording.topics.values())
        is_whole = one.last_ns - one.first_ns >= 0.5 * longest
        name = one.topic.name
        is_odom = "odom" in one.frame.lower()
        fused = bool(_FUSED.search(name)) - bool(_NOT_MEASURED.search(name))
        return is_whole, one.path_m > _LEAST_M, fused, is_odom, one.topic.count

    def _of_tf(self) -> bool:
        links = [(p, c) for c, p in self._recording.moving.items() if p not in MAP_FRAMES]
        links = [(p, c) for p, c in links if "odom" in p.lower() or c.startswith("base")]
        if not links or TF_TOPIC not in self._recording.topics:
            return False
        parent, child = min(links, key=lambda link: ("odom" not in link[0].lower(), not link[1].startswith("base")))
        self.settings |= {"odom.type": TRANSFORMS, "odom.topic": TF_TOPIC}
        self.notes.append(f"odometry is {parent} -> {child} of /tf: there is no topic with it")
        self._frames(parent, child)
        return True

    def _nothing(self) -> str:
        there = ", ".join(f"{name} ({one.topic.type or 'no type'})" for name, one in self._recording.topics.items())
        poses = [n for n, one in self._recording.topics.items() if one.topic.type in POSES and n not in self._unused]
        why = "".join(f"; {name}: {reason}" for name, reason in self._unused.items())
        if any(self._recording.topics[name].topic.type == ODOMETRY for name in self._unused):
            return f"no odometry that can be used{why}"
        for name in poses:
            of = self._recording.topics[name].topic.type
            why += f"; if {name} is odometry: --set odom.type={of} --set odom.topic={name} --set odom.use=odometry"
        return f"no odometry (nav_msgs/msg/Odometry, or odom -> base_link on /tf); there are {there}{why}"

    def _frames(self, parent: str, child: str) -> None:
        if not parent:
            self.settings["odom.frame"] = self.odom
        elif parent != self.odom:
            self.settings["frames.odom"] = self.odom = parent
        if not child:
            self.settings["odom.mount"] = ASSUMED
            self.notes.append("odometry names no child frame: that of the robot's base is assumed")
        elif base := self._unlinked_base(child):
            self.settings["odom.mount"] = ASSUMED
            self.notes.append(f"no transform links {child}, which odometry names, to {base}: one place is assumed")
            if base != self.base:
                self.settings["frames.base"] = self.base = base
        elif child != self.base:
            self.settings["frames.base"] = self.base = child

    def _unlinked_base(self, child: str) -> str:
        """The base that carries the sensors on /tf_static if odometry's child is not linked to it, else empty."""
        fixed = self._recording.fixed
        if child in fixed or child in fixed.values():
            return ""
        roots = {parent for parent in fixed.values() if parent not in fixed and "base" in parent}
        return roots.pop() if len(roots) == 1 else ""


def _namespace(topic: str) -> str:
    """The first part of a topic's name; empty where it has only one."""
    return topic.lstrip("/").partition("/")[0] if topic.count("/") > 1 else ""


def readable(recording: Recording, unused: dict[str, str], *types: str) -> Iterator[TopicContents]:
    """Topics of some types that can be read and are not the truth.

    Parameters
    ----------
    unused : why a topic is not used, by its name; such topics are left out, and it is filled
    """
    for name, one in recording.topics.items():
        if one.topic.type in types and one.topic.count:
            if name in unused:
                continue
            if is_truth(name):
                unused[name] = "ground truth by its name: graph_slam evaluate RUN --truth compares with it"
            elif one.trouble:
                unused[name] = one.trouble
            else:
                yield one
