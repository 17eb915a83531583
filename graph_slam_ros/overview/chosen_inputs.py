"""The topics of a recording that inputs are read from: named, configured, or the only ones of their type.

Names of topics tell which are the truth.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from graph_slam_ros.config import Config
from graph_slam_ros.config.inputs import InputConfig, default_input
from graph_slam_ros.errors import did_you_mean
from graph_slam_ros.messages.from_msg import TF, TF_STATIC, TRANSFORMS
from graph_slam_ros.messages.inputs import check_topics, uses
from graph_slam_ros.recordings.bag import Bag, BagError

TF_STATIC_TOPIC, TF_TOPIC = "/tf_static", "/tf"
_OPTIONS = {"odometry": "--odom", "landmarks": "--landmarks"}
_OPTIONAL = default_input("detections")  # a recording need not have what nobody asked for
WORD = r"(^|[/_])({})([/_\d]|$)"
_TRUTH = re.compile(
    WORD.format(r"ground_?truth|groundtruth|truth|true|gt|reference|vicon|vrpn\w*|mocap|optitrack|qualisys|p3d|leica"),
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class Inputs:
    """The topics of a recording that are used, by name of the input, with ``tf_static`` and ``tf``."""

    topics: Mapping[str, str]

    def by_topic(self) -> dict[str, list[str]]:
        """Names of the inputs of each topic that is read in order of recording; ``tf`` is the first of its own."""
        out: dict[str, list[str]] = {}
        for name in sorted(self.topics, key=lambda name: name != TF):
            if name != TF_STATIC:
                out.setdefault(self.topics[name], []).append(name)
        return out


def choose_inputs(bag: Bag, config: Config, odometry: str | None = None, landmarks: str | None = None) -> Inputs:
    """The topic of each input: the named one, else the configured one, else the only one of its type.

    ``odometry`` and ``landmarks`` are topics of the first input that is used so. Raises BagError with the topics that
    exist: a named one does not, or has another type, or there is none.
    """
    named = {"odometry": odometry, "landmarks": landmarks}
    by_name = {settings.name: settings for settings in config.sources}
    topics = {}
    for name, use in uses(config).items():
        option, topic = _OPTIONS.get(use) if use in named else None, named.pop(use, None)
        found = _choose(bag, by_name[name], topic, option or f"--set {name}.topic=")
        if found:
            topics[name] = found
    check_topics(config, uses(config), topics)
    if named.get("landmarks"):
        raise BagError(f"no input is used as landmarks: {landmarks} cannot be one")
    namespaces = [topics[name].rpartition("/")[0] for name, use in uses(config).items() if name in topics]
    if found := _of_namespace(bag, TF_STATIC_TOPIC, namespaces):
        topics[TF_STATIC] = found
    if config.inputs.tf and (found := _of_namespace(bag, TF_TOPIC, namespaces)):
        topics[TF] = found
    return Inputs(topics)


def _of_namespace(bag: Bag, topic: str, namespaces: Sequence[str]) -> str:
    """Return a topic of transforms, else that in the namespace of an input; empty if there is none."""
    names = (topic, *(f"{namespace}{topic}" for namespace in namespaces))
    there = [name for name in names if name in bag.topics]
    return next((name for name in there if name == TF_STATIC_TOPIC or bag.topics[name].type == TRANSFORMS), "")


def _choose(bag: Bag, settings: InputConfig, named: str | None, option: str) -> str:
    fitting = ", ".join(t.name for t in bag.topics.values() if t.type == settings.type)
    others = ", ".join(t.name + " (no type)" * (not t.type) for t in [*bag.topics.values()][:6])
    there = f"of {settings.type} there is {fitting}" if fitting else f"there are {len(bag.topics)} topics: {others}"
    usual = f"/{settings.topic.lstrip('/')}"
    if named is None and settings.topic != default_input(settings.name).topic:
        named = usual
    if named is not None:
        if (topic := bag.topics.get(named)) is None:
            near = did_you_mean(named, [one for one in bag.topics if not is_truth(one)])
            raise BagError(f"no topic {named} in the recording; {there}{near}")
        if not topic.type:
            raise BagError(f"topic {named} has no type: the recording lacks its schema")
        if topic.type != settings.type:
            raise BagError(f"topic {named} is {topic.type}, not {settings.type}")
        return named
    found = [t.name for t in bag.topics.values() if t.type == settings.type and t.name != TF_STATIC_TOPIC]
    if usual in found:
        return usual
    found = [name for name in found if not is_truth(name)]
    if len(found) == 1:
        return found[0]
    if found:
        raise BagError(f"several topics of type {settings.type} ({', '.join(found)}): choose one with {option}")
    if settings != _OPTIONAL:
        truth = f", the truth by its name: {option} takes it all the same, and graph_slam info prints what fits better"
        why = there + truth * bool(fitting)
        raise BagError(f"no topic of type {settings.type} in the recording; {why}")
    return ""


def is_truth(topic: str) -> bool:
    """Return whether a topic has the truth, by its name: no sensor of the robot measured it."""
    return _TRUTH.search(topic) is not None
