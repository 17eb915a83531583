"""Publishers of results. Small messages are sent at once; others when they are due, changed, and subscribed to.

A latched topic is sent once more to a late subscriber, even if the robot stands. A player gets the number of messages
that have gone through the node.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.messages import results, to_msg, topics
from graph_slam_ros.messages.interfaces import message_class
from graph_slam_ros.messages.path_updates import PathUpdates
from graph_slam_ros.messages.to_msg import Status
from graph_slam_ros.node import events
from graph_slam_ros.slam import GraphSlam, MapView, Update
from graph_slam_ros.slam.frontend.ingest_gate import input_of, size_of

if TYPE_CHECKING:
    from graph_slam_ros.node.runtime import Runtime

_PATHS, _LANDMARKS = ("path", "path_updates", "graph"), ("landmarks", "landmarks_estimate")
_MOVED_M, _MOVED_RAD = 0.02, 0.02  # a keyframe that moved by less looks the same in RViz
_LANDMARKS_EVERY = 20  # keyframes, some seconds of driving
_GRAPH_S, _MOST_EDGES = 2.0, 5000  # of ~/graph: its period, and the edges of one message, some MB
_SPARE = 50.0  # of the worker's time, one part for each topic
_ACKNOWLEDGE = 32  # messages
_MOST_UNPUBLISHED_S, _AGAIN_S, _JUMP_RAD = 4.0, 5.0, 0.2
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
    """Publishers of results. The node creates them, and the worker's thread uses them.

    Attributes
    ----------
    refused : messages that went no further
    processed : measurements that the worker has processed, by input
    """

    def __init__(self, run: "Runtime") -> None:
        self._run, self._node = run, run.node
        self._topics = {
            one.name.removeprefix("~/"): _Topic(
                self._node.create_publisher(message_class(one.type), one.name, LATCHED if one.latched else 100)
            )
            for one in topics.PUBLICATIONS
            if one.name.startswith("~/")
        }
        self._landmarks_at = 0  # keyframes, or later
        self._has_something = False
        self._is_overdue, self._published_s = False, time.monotonic()  # results, where the worker always has messages
        self.refused = self._done = 0
        self.processed: Counter[str] = Counter()
        self._acknowledged, self._has_player = -1, False
        self.begin()

    def begin(self, *, has_map: bool = False) -> None:
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

    def has_subscribers(self, name: str) -> bool:
        """Return whether somebody subscribes to a topic."""
        return bool(self._topics[name].publisher.get_subscription_count())

    # -- in the main thread ------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Offer the worker a job to publish what is due, ten times a second. It is overdue if the worker is busy."""
        now_s, worker = time.monotonic(), self._run.worker
        self._has_player = self.has_subscribers("received")
        self._acknowledge()
        is_due = any(self._is_due(name, now_s) for name in (*_PATHS, *_LANDMARKS))
        if is_due and worker.waiting < _ACKNOWLEDGE:
            worker.offer(self.publish_due)
        elif is_due and now_s - self._published_s > _MOST_UNPUBLISHED_S:
            self._is_overdue = True

    def odometry(self, cdr: bytes) -> None:
        """Publish the pose of the robot in the map at the newest odometry."""
        self._send("odometry", cdr)

    def publish_events(self, stamp_ns: int, happened: Iterable[Status]) -> None:
        """Publish events, with or without subscribers."""
        if statuses := list(happened):
            self._send("events", to_msg.diagnostics(stamp_ns, statuses))

    # -- in the worker's thread --------------------------------------------------------------------------------------

    def on_update(self, slam: GraphSlam, update: Update) -> None:
        """Publish pose and events, note which topics have changed, and log large moves of the robot."""
        view, estimate, moved = slam.view, self._run.session.estimate, update.correction
        if estimate is not None and estimate.is_located:
            self._send("pose", results.pose(view))
        self._has_something = True
        changed = list(_PATHS)
        is_time = len(view.keyframes) >= self._landmarks_at
        if update.report is not None or (update.solved and view.landmarks and is_time):
            self._landmarks_at = len(view.keyframes) + _LANDMARKS_EVERY
            changed += _LANDMARKS
        for name in changed:
            self._topics[name].is_stale = True
        if self.has_subscribers("events"):
            self.publish_events(view.keyframes[-1].stamp_ns, events.of_update(view, update))
        if update.solved and (moved.distance_m > view.config.tf.report_jump_m or moved.angle_rad > _JUMP_RAD):
            slam.counters.count("tf", "jump")
            self._node.get_logger().warn(events.correction(view, update).message, throttle_duration_sec=_AGAIN_S)

    def after_message(self, measured: Sequence[Measured]) -> None:
        """Count another processed message, publish what is overdue, and acknowledge."""
        self._done += 1
        for m in measured:
            self.processed[input_of(m)] += size_of(m)
        if self._is_overdue:
            self.publish_due()
        if self._has_player and (not self._run.worker.waiting or self._done % _ACKNOWLEDGE == 0):
            self._acknowledge()

    def publish_due(self) -> None:
        """Publish what is due, has changed and has a subscriber."""
        self._is_overdue, self._published_s = False, (now_s := time.monotonic())
        view = self._run.session.slam.view
        make: dict[str, Callable[[], Iterable[bytes]]] = {
            "path": lambda: [results.path(view, view.config.output.path_max_poses)],
            "graph": lambda: [results.graph(view, _MOST_EDGES)],
            "landmarks": lambda: [results.landmarks(view)],
            "landmarks_estimate": lambda: [results.landmarks_estimate(view)],
            "path_updates": lambda: self._changes(view),
        }
        for name, encode in make.items():
            if self._is_due(name, now_s):
                start, topic = time.thread_time(), self._topics[name]
                for cdr in encode():
                    topic.publisher.publish(cdr)
                topic.is_stale, topic.sent_s, topic.encode_s = False, now_s, time.thread_time() - start

    def _changes(self, view: MapView) -> Iterator[bytes]:
        """Yield changes of the path. A late subscriber lacks the earlier ones, so the whole path is sent again."""
        if self._topics["path_updates"].begins_anew:
            self._topics["path_updates"].begins_anew = False
            yield self._updates.restart(view)
        if changed := self._updates.update(view):
            yield changed

    # -- in either -----------------------------------------------------------------------------------------------------

    def _acknowledge(self) -> None:
        count = self.refused + self._done
        if count != self._acknowledged:
            self._acknowledged = count
            self._send("received", UInt64(data=count))

    def _send(self, name: str, message: Any) -> None:
        self._topics[name].publisher.publish(message)

    def _is_due(self, name: str, now_s: float) -> bool:
        topic, output = self._topics[name], self._node.config.output
        subscribers = topic.publisher.get_subscription_count()
        if subscribers > topic.subscribers:
            topic.begins_anew = True  # who came late has what was latched, and of what is not latched nothing
            topic.is_stale = topic.is_stale or name == "path_updates"
        topic.subscribers = subscribers
        period_s = _GRAPH_S if name == "graph" else output.path_period_s
        period_s = max(period_s, _SPARE * topic.encode_s)  # what takes long comes seldom
        return self._has_something and topic.is_stale and bool(subscribers) and now_s - topic.sent_s >= period_s
