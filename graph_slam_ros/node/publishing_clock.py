"""The schedule of results: each topic has a period, which grows if the pipeline would fall behind."""

import time
from collections import Counter
from collections.abc import Sequence

from graph_slam_ros.measurements.types import Measured
from graph_slam_ros.node import events
from graph_slam_ros.node.handle import NodeHandle
from graph_slam_ros.node.publishers import Publishers
from graph_slam_ros.node.session import Session
from graph_slam_ros.node.worker import Worker
from graph_slam_ros.slam import GraphSlam, Update
from graph_slam_ros.slam.frontend.ingest_gate import input_of, size_of

ACKNOWLEDGE = 32  # messages
_MOST_UNPUBLISHED_S, _AGAIN_S, _JUMP_RAD = 4.0, 5.0, 0.2


class PublishingClock:
    """Makes the worker publish what is due, and acknowledges messages to a player.

    Parameters
    ----------
    publishers : of the results

    Attributes
    ----------
    refused : messages that went no further
    processed : measurements that the worker has processed, by input
    """

    def __init__(self, node: NodeHandle, publishers: Publishers, worker: Worker) -> None:
        self._node, self._publishers, self._worker = node, publishers, worker
        self.refused = self._done = 0
        self.processed: Counter[str] = Counter()
        self._acknowledged = -1
        self._has_player = False
        self._is_overdue, self._published_s = False, time.monotonic()  # results, where the worker always has messages

    # -- in the main thread ------------------------------------------------------------------------------------------

    def tick(self, session: Session) -> None:
        """Offer the worker a job to publish what is due, ten times a second. It is overdue if the worker is busy."""
        self._has_player = self._node.has_player
        self._acknowledge()
        is_due = self._publishers.are_due(self._node.config)
        if is_due and self._worker.waiting < ACKNOWLEDGE:
            self._worker.offer(lambda: self.publish_due(session.slam))
        elif is_due and time.monotonic() - self._published_s > _MOST_UNPUBLISHED_S:
            self._is_overdue = True

    def _acknowledge(self) -> None:
        count = self.refused + self._done
        if count != self._acknowledged:
            self._acknowledged = count
            self._node.acknowledge(count)

    # -- in the worker's thread --------------------------------------------------------------------------------------

    def after_message(self, session: Session, measured: Sequence[Measured]) -> None:
        """Count another processed message, publish what is overdue, and acknowledge."""
        self._done += 1
        for m in measured:
            self.processed[input_of(m)] += size_of(m)
        if self._is_overdue:
            self.publish_due(session.slam)
        if self._has_player and (not self._worker.waiting or self._done % ACKNOWLEDGE == 0):
            self._acknowledge()

    def on_update(self, slam: GraphSlam, update: Update, *, is_located: bool) -> None:
        """Publish what an update changed, and log large moves of the robot."""
        self._publishers.update(slam, update, is_located=is_located)
        moved, tf = update.correction, slam.config.tf
        if update.solved and (moved.distance_m > tf.report_jump_m or moved.angle_rad > _JUMP_RAD):
            slam.counters.count("tf", "jump")
            self._node.get_logger().warn(events.correction(slam, update).message, throttle_duration_sec=_AGAIN_S)

    def publish_due(self, slam: GraphSlam) -> None:
        """Publish what is due now."""
        self._is_overdue, self._published_s = False, time.monotonic()
        self._publishers.publish_due(slam)
