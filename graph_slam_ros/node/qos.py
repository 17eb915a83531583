"""QoS of the input subscriptions, and the reason why a publisher does not connect to one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.messages.from_msg import TF, TRANSFORMS
from graph_slam_ros.messages.inputs import uses
from graph_slam_ros.slam import Config

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode


@dataclass(frozen=True, slots=True)
class InputQos:
    """The QoS of the subscription of a topic.

    Attributes
    ----------
    reliability, durability : where more than the least is asked for, the parameter that asks for it, else empty
    """

    depth: int
    reliability: str = ""
    durability: str = ""

    @property
    def profile(self) -> QoSProfile:
        """The profile for rclpy."""
        return QoSProfile(
            depth=self.depth,
            reliability=ReliabilityPolicy.RELIABLE if self.reliability else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.durability else DurabilityPolicy.VOLATILE,
        )

    def mismatch(self, publisher: Any) -> str:
        """The reason why a publisher does not connect, from its endpoint info; empty if it connects."""
        offers, name = publisher.qos_profile, publisher.node_name
        if self.reliability and offers.reliability == ReliabilityPolicy.BEST_EFFORT:
            return f"{name} offers best effort, {self.reliability} asks for reliable delivery (QoS)"
        if self.durability and offers.durability == DurabilityPolicy.VOLATILE:
            return f"{name} offers volatile, {self.durability} asks for transient_local (QoS)"
        return ""


@dataclass(frozen=True, slots=True)
class InputTopic:
    """A topic to subscribe to, with its inputs."""

    type_name: str
    name: str
    inputs: Sequence[str]
    qos: InputQos


def input_topics(node: "GraphSlamNode", config: Config) -> list[InputTopic]:
    """The topics of the inputs, and /tf. Raises ConfigError as ``input_qos`` does."""
    topics: dict[tuple[str, str], list[str]] = {(TRANSFORMS, "/tf"): [TF]} if config.inputs.tf else {}
    used = uses(config)
    for one in config.sources:
        if one.name in used:
            topics.setdefault((one.type, node.resolve_topic_name(one.topic)), []).append(one.name)
    return [InputTopic(kind, topic, names, input_qos(config, topic, names)) for (kind, topic), names in topics.items()]


def input_qos(config: Config, topic: str, names: Sequence[str]) -> InputQos:
    """The QoS for a topic that these inputs share.

    Raises
    ------
    ConfigError
        Two of them ask for different reliability or durability: there is one subscription.
    """
    inputs = [one for one in config.sources if one.name in names]
    asked: dict[str, str] = {}  # by what is asked for, the parameter that does so
    for key, default in (("reliability", "auto"), ("durability", "")):
        given = {getattr(one, key): f"{one.name}.{key}" for one in inputs if getattr(one, key) != default}
        if len(given) > 1:
            pairs = " and ".join(f"{parameter} ({value})" for value, parameter in given.items())
            raise ConfigError(f"{pairs} are of one subscription, to {topic}: they must be the same")
        asked |= given
    if config.inputs.reliable and "best_effort" not in asked:
        asked.setdefault("reliable", "inputs.reliable")
    return InputQos(config.inputs.depth, asked.get("reliable", ""), asked.get("transient_local", ""))
