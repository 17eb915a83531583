"""The broadcaster of map -> odom. It also detects a second broadcaster."""

import math
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from graph_slam_ros.config.config import Config
from graph_slam_ros.config.node import TfConfig
from graph_slam_ros.findings.finding import Finding
from graph_slam_ros.graph.geometry import Geometry
from graph_slam_ros.messages import to_msg
from graph_slam_ros.node.subscriptions import full_name
from graph_slam_ros.typing import Numbers

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode
    from graph_slam_ros.node.runtime import Runtime

_BEHIND_S = 1.0  # more is said


class MapToOdom:
    """The correction to broadcast. It follows the estimate at once, or with a limited speed of the robot in the map.

    Attributes
    ----------
    behind_s : the time by which the next transform would be dated before the last one; until it is 0, none is sent
    """

    def __init__(self, config: Config) -> None:
        self._space: Geometry = config.space
        self._newest_ns: int | None = None  # odometry of the last transform
        self._sent_ns: int | None = None
        self._published: Numbers | None = None
        self.behind_s = 0.0

    def forget_time(self) -> None:
        """Begin anew with the stamps."""
        self._newest_ns = self._sent_ns = None
        self.behind_s = 0.0

    def next(
        self, config: TfConfig, now_ns: int, odometry_ns: int, T_odom_base: Numbers, T_map_odom: Numbers
    ) -> tuple[int, Numbers] | None:
        """Stamp and transform to broadcast with the newest odometry and the estimate; None if nothing is new."""
        if self._newest_ns is not None and odometry_ns <= self._newest_ns:
            return None
        stamp_ns = odometry_ns if config.stamp == "odometry" else now_ns
        stamp_ns += round(config.transform_tolerance * 1e9)
        self.behind_s = max(0.0, ((self._sent_ns or 0) - stamp_ns) * 1e-9)
        if self._sent_ns is not None and stamp_ns <= self._sent_ns:
            return None
        elapsed_s = 0.0 if self._newest_ns is None else (odometry_ns - self._newest_ns) * 1e-9
        self._published = self._followed(config, T_map_odom, T_odom_base, elapsed_s)
        self._newest_ns, self._sent_ns = odometry_ns, stamp_ns
        return stamp_ns, self._published

    def _followed(self, config: TfConfig, T_map_odom: Numbers, T_odom_base: Numbers, elapsed_s: float) -> Numbers:
        """The last transform, moved towards the estimate as far as the limits of speed allow."""
        last, group, n = self._published, self._space.group, self._space.dimensions
        if last is None or last == T_map_odom or not (config.max_speed_m_s or config.max_turn_rad_s):
            return T_map_odom
        here, there = group.compose(last, T_odom_base), group.compose(T_map_odom, T_odom_base)
        moved = group.between(here, there)
        far, turn = math.hypot(*group.log(moved)[:n]), self._space.angle(moved)  # along the arc, not across
        part = min(
            1.0,
            config.max_speed_m_s * elapsed_s / far if config.max_speed_m_s and far else 1.0,
            config.max_turn_rad_s * elapsed_s / turn if config.max_turn_rad_s and turn else 1.0,
        )
        if part == 1.0:
            return T_map_odom
        return tuple(map(float, group.compose(group.interpolate(here, there, part), group.inverse(T_odom_base))))


_STATIC = "/tf_static"
_PATIENCE_S = 2.0  # for what is latched to come again
_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_REMEMBERED = 500  # messages of ours that may still come back to us
_OTHERS_S = 5.0  # after its last message somebody else is gone


class StaticRival:
    """Notes whether somebody publishes a static transform to the odometry frame.

    Such a message comes once and stays valid. When a publisher of the topic has gone, all others are asked again.
    """

    def __init__(self, node: "GraphSlamNode") -> None:
        self._node, self._frame = node, node.config.frames.odom
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

    def refresh(self) -> None:
        """Ask again where a publisher has gone that may have published it. Call it about every second."""
        if self.transform:
            publishers = {bytes(one.endpoint_gid) for one in self._node.get_publishers_info_by_topic(_STATIC)}
            if self._publishers - publishers:
                self._until_s = min(self._until_s, time.monotonic() + _PATIENCE_S)
                self.close()
                self._subscribe()
            self._publishers = publishers

    def _subscribe(self) -> None:
        on_message = self._node.guarded(self._on_message)
        self._subscription = self._node.create_subscription(TFMessage, _STATIC, on_message, _QOS)

    def _on_message(self, message: Any) -> None:
        for one in message.transforms:
            if one.child_frame_id.lstrip("/") == self._frame:
                self._until_s, self._parent = math.inf, one.header.frame_id.lstrip("/")


class TfBroadcaster:
    """The publisher of map -> odom while the node is active."""

    def __init__(self, run: "Runtime") -> None:
        self._run, self._node = run, run.node
        self._policy = MapToOdom(self._node.config)
        self._publisher = self._node.create_publisher(TFMessage, "/tf", 100)
        self._is_closed = False
        self._ours: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._others_s = -math.inf
        self._static = StaticRival(self._node)
        period_s = self._node.config.tf.transform_publish_period
        self._timer = self._node.create_timer(period_s, self._node.guarded(self._tick))

    def close(self) -> None:
        """Remove timer and publisher. A tick that is already on its way finds them removed."""
        self._is_closed = True
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)
        self._static.close()

    def forget_time(self) -> None:
        """Begin anew with the stamps."""
        self._policy.forget_time()

    def on_correction(self, cdr: bytes) -> None:
        """Note a transform from map, ours or another broadcaster's."""
        if cdr[4:] not in self._ours:
            self._others_s = time.monotonic()

    def wrong(self) -> Iterator[Finding]:
        """Yield that another node sends the transform or gives odometry's frame another parent, or none is sent."""
        self._static.refresh()
        if transform := self._static.transform:
            yield Finding("static_rival", "error", topic=transform, text=self._others_on(_STATIC))
        elif time.monotonic() - self._others_s < _OTHERS_S:
            yield Finding("rival", "error", text=self._others_on("/tf"))
        if self._policy.behind_s > _BEHIND_S:
            yield Finding("behind_last", "warning", self._policy.behind_s)

    def _others_on(self, topic: str) -> str:
        """The other nodes that publish on a topic, one of which it is: a transform does not say who sent it."""
        names = set(map(full_name, self._node.get_publishers_info_by_topic(topic)))
        others = sorted(names - {self._node.get_fully_qualified_name()})
        return f"one of {', '.join(others)}, which publish {topic}" if len(others) > 1 else "".join(others) or "a node"

    def _tick(self) -> None:
        config, odometry = self._node.config, self._run.ingest.extrapolator
        newest = odometry.newest
        if self._is_closed or newest is None or not config.tf.publish_tf:
            return
        estimated = self._run.session.T_map_odom(newest, odometry.source)
        if estimated is None:
            return
        due = self._policy.next(config.tf, self._node.now_ns, newest.stamp_ns, newest.T_odom_base, estimated)
        if due is not None:
            stamp_ns, T_map_odom = due
            cdr = to_msg.transform(stamp_ns, config.frames.map, config.frames.odom, T_map_odom)
            self._ours.append(cdr[4:])
            self._publisher.publish(cdr)
