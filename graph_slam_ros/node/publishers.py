"""Publishers of results. Small messages are sent at once; others when they are due, changed, and subscribed to.

A latched topic is sent once more to a late subscriber, even if the robot stands.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.messages import results, to_msg, topics
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.messages.path_updates import PathUpdates
from graph_slam_ros.messages.to_msg import Status
from graph_slam_ros.node import events
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.worker import Worker
from graph_slam_ros.slam import Config, GraphSlam, MapView, Update
from graph_slam_ros.slam.frontend.ingest_gate import input_of, size_of

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode

_LANDMARKS = ("landmarks", "landmarks_estimate")
_LATER = ("path", "path_updates", "graph", *_LANDMARKS)
_MOVED_M, _MOVED_RAD = 0.02, 0.02  # a keyframe that moved by less looks the same in RViz
_LANDMARKS_EVERY = 20  # keyframes, some seconds of driving
_GRAPH_S, _MOST_EDGES = 2.0, 5000  # of ~/graph: its period, and the edges of one message, some MB
_SPARE = 50.0  # of the worker's time, one part for each topic
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@dataclass(slots=True)
class _Topic:
    """A publisher and its state."""

    publisher: Any
    subscribers: int = 0
    is_stale: bool = False  # something has changed since it was sent
    begins_anew: bool = True  # somebody has nothing of it
    sent_s: float = -1e9
    encode_s: float = 0.0  # to make and send it


class Publishers:
    """Publishers of results. The node creates them, and the worker's thread uses them."""

    def __init__(self, node: "GraphSlamNode", config: Config) -> None:
        self._node = node
        self._topics = {
            one.name.removeprefix("~/"): _Topic(
                node.create_publisher(message_class(one.type), one.name, LATCHED if one.latched else 100)
            )
            for one in topics.PUBLICATIONS
            if one.name.startswith("~/") and one.name not in ("~/received", "~/events")
        }
        self._events = node.create_publisher(message_class("diagnostic_msgs/msg/DiagnosticArray"), "~/events", 100)
        self._landmarks_at = 0  # keyframes, or later
        self._has_something = False
        self.begin(config)

    def begin(self, config: Config, *, has_map: bool = False) -> None:
        """Begin a new run, perhaps in a loaded map: earlier messages belong to another run."""
        self._has_something |= has_map
        self._updates = PathUpdates(_MOVED_M, _MOVED_RAD)
        self._landmarks_at = 0
        for topic in self._topics.values():
            topic.is_stale = topic.begins_anew = True

    def forget_time(self) -> None:
        """Begin anew after a jump of time: subscribers identify poses by their stamps, and need all of them again."""
        self._topics["path_updates"].begins_anew = True

    @property
    def path_version(self) -> int:
        """The number of messages of ``~/path_updates`` since it began anew."""
        return self._updates.version

    def close(self) -> None:
        """Remove the publishers."""
        for topic in self._topics.values():
            self._node.destroy_publisher(topic.publisher)
        self._node.destroy_publisher(self._events)

    # -- at once -----------------------------------------------------------------------------------------------------

    def update(self, view: MapView, update: Update, *, is_located: bool) -> None:
        """Publish pose and events, and note which topics have changed."""
        if is_located:
            self._send("pose", results.pose(view))
        self._has_something = True
        for name in ("path", "path_updates", "graph"):
            self._topics[name].is_stale = True
        if self._landmarks_due(view, update):
            self._landmarks_at = len(view.keyframes) + _LANDMARKS_EVERY
            for name in _LANDMARKS:
                self._topics[name].is_stale = True
        if self._events.get_subscription_count():
            self.publish_events(view.keyframes[-1].stamp_ns, events.of_update(view, update))

    def publish_events(self, stamp_ns: int, happened: Iterable[Status]) -> None:
        """Publish events, with or without subscribers."""
        if statuses := list(happened):
            self._events.publish(to_msg.diagnostics(stamp_ns, statuses))

    def odometry(self, cdr: bytes) -> None:
        """Publish the pose of the robot in the map at the newest odometry."""
        self._send("odometry", cdr)

    def has_subscribers(self, name: str) -> bool:
        """Return whether somebody subscribes to a topic."""
        return bool(self._topics[name].publisher.get_subscription_count())

    def _send(self, name: str, cdr: bytes) -> None:
        topic = self._topics[name]
        topic.publisher.publish(cdr)
        topic.is_stale, topic.sent_s = False, time.monotonic()

    def _landmarks_due(self, view: MapView, update: Update) -> bool:
        """Return whether landmarks are due: regularly from the first on, and after each complete solve."""
        regularly = bool(view.landmarks) and len(view.keyframes) >= self._landmarks_at
        return update.report is not None or (update.solved and regularly)

    def _send_updates(self, view: MapView) -> None:
        """Publish changes of the path. A late subscriber lacks the earlier ones, so the whole path is sent again."""
        if self._topics["path_updates"].begins_anew:
            self._topics["path_updates"].begins_anew = False
            self._send("path_updates", self._updates.restart(view))
        if changed := self._updates.update(view):
            self._send("path_updates", changed)

    # -- when due ----------------------------------------------------------------------------------------------------

    def are_due(self, config: Config) -> bool:
        """Return whether ``publish_due`` has something to publish. It is called often, from any thread."""
        now_s = time.monotonic()
        return any(self._is_due(config, name, now_s) for name in _LATER)

    def _is_due(self, config: Config, name: str, now_s: float) -> bool:
        topic, output = self._topics[name], config.output
        subscribers = topic.publisher.get_subscription_count()
        if subscribers > topic.subscribers:
            topic.begins_anew = True  # who came late has what was latched, and of what is not latched nothing
            topic.is_stale = topic.is_stale or name == "path_updates"
        topic.subscribers = subscribers
        period_s = _GRAPH_S if name == "graph" else output.path_period_s
        period_s = max(period_s, _SPARE * topic.encode_s)  # what takes long comes seldom
        return self._has_something and topic.is_stale and bool(subscribers) and now_s - topic.sent_s >= period_s

    def publish_due(self, view: MapView) -> None:
        """Publish what is due, has changed and has a subscriber."""
        now_s, output = time.monotonic(), view.config.output
        make: dict[str, Callable[[], bytes]] = {
            "path": lambda: results.path(view, output.path_max_poses),
            "graph": lambda: results.graph(view, _MOST_EDGES),
            "landmarks": lambda: results.landmarks(view),
            "landmarks_estimate": lambda: results.landmarks_estimate(view),
        }
        for name, encode in make.items():
            if self._is_due(view.config, name, now_s):
                start = time.thread_time()
                self._send(name, encode())
                self._topics[name].encode_s = time.thread_time() - start
        if self._is_due(view.config, "path_updates", now_s):
            self._send_updates(view)


ACKNOWLEDGE = 32  # messages
_MOST_UNPUBLISHED_S, _AGAIN_S, _JUMP_RAD = 4.0, 5.0, 0.2


class PublishingClock:
    """Makes the worker publish what is due, and acknowledges messages to a player.

    Parameters
    ----------
    session : has the pipeline, whose results these are

    Attributes
    ----------
    refused : messages that went no further
    processed : measurements that the worker has processed, by input
    """

    def __init__(self, node: "GraphSlamNode", session: Session, publishers: Publishers, worker: Worker) -> None:
        self._node, self._session, self._publishers, self._worker = node, session, publishers, worker
        self.refused = self._done = 0
        self.processed: Counter[str] = Counter()
        self._acknowledged = -1
        self._has_player = False
        self._is_overdue, self._published_s = False, time.monotonic()  # results, where the worker always has messages

    # -- in the main thread ------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Offer the worker a job to publish what is due, ten times a second. It is overdue if the worker is busy."""
        self._has_player = self._node.has_player
        self._acknowledge()
        is_due = self._publishers.are_due(self._node.config)
        if is_due and self._worker.waiting < ACKNOWLEDGE:
            self._worker.offer(lambda: self.publish_due(self._session.slam.view))
        elif is_due and time.monotonic() - self._published_s > _MOST_UNPUBLISHED_S:
            self._is_overdue = True

    def _acknowledge(self) -> None:
        count = self.refused + self._done
        if count != self._acknowledged:
            self._acknowledged = count
            self._node.acknowledge(count)

    # -- in the worker's thread --------------------------------------------------------------------------------------

    def after_message(self, measured: Sequence[Measured]) -> None:
        """Count another processed message, publish what is overdue, and acknowledge."""
        self._done += 1
        for m in measured:
            self.processed[input_of(m)] += size_of(m)
        if self._is_overdue:
            self.publish_due(self._session.slam.view)
        if self._has_player and (not self._worker.waiting or self._done % ACKNOWLEDGE == 0):
            self._acknowledge()

    def on_update(self, slam: GraphSlam, update: Update) -> None:
        """Publish what an update changed, and log large moves of the robot."""
        estimate = self._session.estimate
        self._publishers.update(slam.view, update, is_located=estimate is not None and estimate.is_located)
        moved, tf = update.correction, slam.view.config.tf
        if update.solved and (moved.distance_m > tf.report_jump_m or moved.angle_rad > _JUMP_RAD):
            slam.counters.count("tf", "jump")
            self._node.get_logger().warn(events.correction(slam.view, update).message, throttle_duration_sec=_AGAIN_S)

    def publish_due(self, view: MapView) -> None:
        """Publish what is due now."""
        self._is_overdue, self._published_s = False, time.monotonic()
        self._publishers.publish_due(view)
