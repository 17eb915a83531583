"""The broadcaster of map -> odom. It also detects a second broadcaster."""

import time
from collections import deque
from collections.abc import Callable

from tf2_msgs.msg import TFMessage

from graph_slam_ros.messages import to_msg
from graph_slam_ros.node.estimate import Estimate
from graph_slam_ros.node.handle import NodeHandle
from graph_slam_ros.node.map_to_odom import MapToOdom
from graph_slam_ros.node.static_rival import StaticRival
from graph_slam_ros.node.subscriptions import full_name
from graph_slam_ros.slam import Config, Odometry

_REMEMBERED = 500  # messages of ours that may still come back to us
_OTHERS_S = 5.0  # after its last message somebody else is gone


class TfBroadcaster:
    """The publisher of map -> odom while the node is active.

    Parameters
    ----------
    guarded : makes a callback that raises nothing
    now : gives the configuration, the last estimate and the newest odometry

    Attributes
    ----------
    static : the search for another broadcaster on /tf_static
    """

    def __init__(
        self,
        node: NodeHandle,
        config: Config,
        guarded: Callable[[Callable[..., None]], Callable[..., None]],
        now: Callable[[], tuple[Config, Estimate | None, Odometry | None]],
    ) -> None:
        self._node, self._now = node, now
        self._policy = MapToOdom(config)
        self._publisher = node.create_publisher(TFMessage, "/tf", 100)
        self._is_closed = False
        self._ours: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._others_s = -1e9
        self.static = StaticRival(node, config.frames.odom)
        self._timer = node.create_timer(config.tf.transform_publish_period, guarded(self._tick))

    def close(self) -> None:
        """Remove timer and publisher. A tick that is already on its way finds them removed."""
        self._is_closed = True
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
        self.static.close()

    def forget_time(self) -> None:
        """Begin anew with the stamps."""
        self._policy.forget_time()

    def on_correction(self, cdr: bytes) -> None:
        """Note a transform from map, ours or another broadcaster's."""
        if cdr[4:] not in self._ours:
            self._others_s = time.monotonic()

    @property
    def behind_s(self) -> float:
        """The time by which the next transform would be dated before the last one; until it is 0, none is sent."""
        return self._policy.behind_s

    @property
    def has_rival(self) -> bool:
        """Return whether another node has broadcast the transform lately on /tf."""
        return time.monotonic() - self._others_s < _OTHERS_S

    def candidates(self) -> tuple[str, ...]:
        """The other nodes that publish on /tf, one of which broadcasts the transform."""
        own = self._node.get_fully_qualified_name()
        names = set(map(full_name, self._node.get_publishers_info_by_topic("/tf")))
        return tuple(sorted(names - {own}))

    def _tick(self) -> None:
        config, estimate, newest = self._now()
        if self._is_closed or estimate is None or newest is None or not config.tf.publish_tf or not estimate.is_located:
            return
        now_ns = self._node.get_clock().now().nanoseconds
        due = self._policy.next(config.tf, now_ns, newest.stamp_ns, newest.T_odom_base, estimate.T_map_odom)
        if due is None:
            return
        stamp_ns, T_map_odom = due
        cdr = to_msg.transform(stamp_ns, config.frames.map, config.frames.odom, T_map_odom)
        self._ours.append(cdr[4:])
        self._publisher.publish(cdr)
