"""Topics that an input could subscribe to instead of one that nobody publishes."""

from collections.abc import Collection, Iterator

from graph_slam_ros.config.inputs import InputConfig
from graph_slam_ros.messages.from_msg import TRANSFORMS
from graph_slam_ros.messages.inputs.landmark_types import LANDMARK_TYPES
from graph_slam_ros.node.handle import NodeHandle

_MOST = 3  # that are named
_LANDMARKS = frozenset({"vision_msgs/msg/Detection3DArray", *LANDMARK_TYPES})


def alternatives(node: NodeHandle, one: InputConfig, use: str, subscribed: Collection[str]) -> tuple[str, ...]:
    """Return a text for each topic of another node that the input could use, with the parameters that choose it.

    Parameters
    ----------
    use : of the input
    subscribed : the topics of all inputs
    """
    if one.type == TRANSFORMS:
        return ()
    found = [
        (kind != one.type, topic, kind)
        for topic, kinds in node.get_topic_names_and_types()
        for kind in kinds
        if kind == one.type or (use == "landmarks" and {kind, one.type} <= _LANDMARKS)
        if topic not in subscribed and any(_others(node, topic))
    ]
    return tuple(_text(one.name, topic, kind, is_other_type=differs) for differs, topic, kind in sorted(found)[:_MOST])


def _text(name: str, topic: str, kind: str, *, is_other_type: bool) -> str:
    if is_other_type:
        return f"{topic} has landmarks, too: {name}.type:={kind} {name}.topic:={topic}"
    return f"{topic} has this type: {name}.topic:={topic}"


def _others(node: NodeHandle, topic: str) -> Iterator[bool]:
    """Yield for each publisher of a topic whether it belongs to another node."""
    own = node.get_name(), node.get_namespace()
    for publisher in node.get_publishers_info_by_topic(topic):
        yield (publisher.node_name, publisher.node_namespace) != own
