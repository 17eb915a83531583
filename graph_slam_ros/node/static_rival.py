"""The search for a static parent of the odometry frame on /tf_static, which contradicts map -> odom."""

import math
import time
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from graph_slam_ros.node.handle import NodeHandle
from graph_slam_ros.node.subscriptions import full_name

_TOPIC = "/tf_static"
_PATIENCE_S = 2.0  # for what is latched to come again
_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class StaticRival:
    """Notes whether somebody publishes a static transform to the odometry frame.

    Such a message comes once and stays valid. When a publisher of the topic has gone, all others are asked again.
    """

    def __init__(self, node: NodeHandle, odom_frame: str) -> None:
        self._node, self._frame = node, odom_frame
        self._until_s, self._parent = -math.inf, ""
        self._publishers: set[bytes] = set()
        self._subscribe()

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)

    @property
    def transform(self) -> str:
        """The transform, as ``map -> odom``; empty where there is none."""
        return f"{self._parent} -> {self._frame}" if time.monotonic() < self._until_s else ""

    def candidates(self) -> tuple[str, ...]:
        """The other nodes that publish on /tf_static, one of which publishes the transform."""
        names = set(map(full_name, self._node.get_publishers_info_by_topic(_TOPIC)))
        return tuple(sorted(names - {self._node.get_fully_qualified_name()}))

    def refresh(self) -> None:
        """Ask again where a publisher has gone that may have published it. Call it about every second."""
        if not self.transform:
            return
        publishers = {bytes(one.endpoint_gid) for one in self._node.get_publishers_info_by_topic(_TOPIC)}
        if self._publishers - publishers:
            self._until_s = min(self._until_s, time.monotonic() + _PATIENCE_S)
            self.close()
            self._subscribe()
        self._publishers = publishers

    def _subscribe(self) -> None:
        on_message = self._node.guarded(self._on_message)
        self._subscription = self._node.create_subscription(TFMessage, _TOPIC, on_message, _QOS)

    def _on_message(self, message: Any) -> None:
        for one in message.transforms:
            if one.child_frame_id.lstrip("/") == self._frame:
                self._until_s, self._parent = math.inf, one.header.frame_id.lstrip("/")
