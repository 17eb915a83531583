"""A bond with Nav2's lifecycle manager: both sides send heartbeats on the topic ``bond``.

The manager notices when this node is gone. The protocol is that of bondcpp, with the name of the node as id. As in
Nav2's own servers, silence of the manager does not end the bond; only its message does.
"""

from typing import TYPE_CHECKING, Any
from uuid import uuid4

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration

from graph_slam_ros.errors import ConfigError
from graph_slam_ros.messages.interfaces import message_class

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode

_TYPE = "bond/msg/Status"
_PERIOD_S, _TIMEOUT_S = 0.25, 4.0  # Nav2's
_ACKNOWLEDGED = Duration(seconds=0.1)  # what the end of a bond may wait for its last word to arrive
MISSING = (
    "no bond with a lifecycle manager: the messages of the package bond are not installed; install it as Nav2 does, or"
    " set the manager's bond_timeout: 0.0"
)


def is_installed() -> bool:
    """Return whether the messages of a bond are installed."""
    try:
        message_class(_TYPE)
    except ConfigError:
        return False
    return True


class Bond:
    """One end of a bond. It lasts until ``end``."""

    def __init__(self, node: "GraphSlamNode") -> None:
        self._node, self._instance = node, str(uuid4())
        self._status = message_class(_TYPE)
        self._is_formed = self._is_over = False
        self._publisher = node.create_publisher(self._status, "bond", 5)
        self._subscription = node.create_subscription(self._status, "bond", node.guarded(self._on_status), 100)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(_PERIOD_S, node.guarded(self._publish), clock=steady)

    def end(self) -> None:
        """Tell the manager that the node ends, so that it does not have to notice the silence."""
        self._node.destroy_timer(self._timer)
        self._publish(is_active=False)
        self._publisher.wait_for_all_acked(_ACKNOWLEDGED)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)

    def _on_status(self, status: Any) -> None:
        if status.id != self._node.get_name() or status.instance_id == self._instance or self._is_over:
            return
        if not status.active:
            self._publish(is_active=False)  # what the manager waits for
            self._is_over = True
            self._node.get_logger().warn("the lifecycle manager has ended the bond")
        elif not self._is_formed:
            self._is_formed = True
            self._node.get_logger().info("bond with the lifecycle manager")

    def _publish(self, *, is_active: bool = True) -> None:
        if self._is_over:
            return
        status = self._status(
            id=self._node.get_name(),
            instance_id=self._instance,
            active=is_active,
            heartbeat_period=_PERIOD_S,
            heartbeat_timeout=_TIMEOUT_S,
        )
        status.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(status)
