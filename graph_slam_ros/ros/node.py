"""The ROS node: subscribes, hands every message to the pipeline, publishes what changed."""

import os
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path as FilePath
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy comes in: threads would reorder sums

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import UInt64
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.ros import results
from graph_slam_ros.ros.from_msg import TF, TF_STATIC, TRANSFORMS, Border, Decoder, is_correction
from graph_slam_ros.ros.inputs import uses
from graph_slam_ros.ros.interfaces import typestore
from graph_slam_ros.ros.message_class import message_class
from graph_slam_ros.ros.params import declare_parameters
from graph_slam_ros.run import RunRecorder, keep_earlier
from graph_slam_ros.slam import Config, Control, GraphSlam, Measurement, Update
from graph_slam_ros.warmup import warmup

_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class GraphSlamNode(Node):
    """Online pose-graph SLAM of odometry, landmark sightings, fixes and closures.

    Subscribes the configured inputs, ``/tf`` and ``/tf_static``; publishes ``~/path``, ``~/pose``, ``~/landmarks``,
    ``~/received`` and the transform map -> odom; serves ``~/save``.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("graph_slam", **options)
        config = declare_parameters(self)
        if config.output.folder:
            keep_earlier(FilePath(config.output.folder), config.output.keep_earlier)
        self._recorder = RunRecorder(config.output.folder, config) if config.output.folder else None
        self.get_logger().info("compiling kernels (once per installation)")
        self.get_logger().info(f"kernels ready after {warmup():.1f} s")
        self._slam = GraphSlam(config, self._recorder.sink if self._recorder else None)
        self._slam.counters.on_first = self._tell
        self._border = Border(config, self._slam.counters, _installed(config))
        self._received = 0
        self._acknowledged = -1
        self._has_player = False
        self._sent_tf_ns = 0
        self._landmarks_at = 0  # keyframes, or later
        self._saved = True
        self._advertise()
        self._listen()

    def _advertise(self) -> None:
        self._path = self.create_publisher(Path, "~/path", _LATCHED)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "~/pose", _LATCHED)
        self._landmarks = self.create_publisher(MarkerArray, "~/landmarks", _LATCHED)
        self._acknowledge = self.create_publisher(UInt64, "~/received", _LATCHED)
        self._tf = self.create_publisher(TFMessage, "/tf", 100)
        self.create_service(Trigger, "~/save", self._on_save)

    def _listen(self) -> None:
        config = self._slam.config
        kind = ReliabilityPolicy.RELIABLE if config.inputs.reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=config.inputs.depth, reliability=kind)
        static = QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self._subscribe(TRANSFORMS, "/tf_static", [TF_STATIC], static)
        inputs: dict[tuple[str, str], list[str]] = {(TRANSFORMS, "/tf"): [TF]} if config.inputs.tf else {}
        used = uses(config)
        for one in config.sources:
            if one.name in used:
                inputs.setdefault((one.type, self.resolve_topic_name(one.topic)), []).append(one.name)
        for (type_name, topic), names in inputs.items():
            self._subscribe(type_name, topic, names, qos)
        if config.tf.publish_tf:
            self.create_timer(config.tf.transform_publish_period, self._guarded(self._publish_tf))
        # a player with /clock waits for this one, so it must not wait for /clock
        self.create_timer(0.1, self._guarded(self._look_for_player), clock=Clock(clock_type=ClockType.STEADY_TIME))

    # -- messages in -------------------------------------------------------------------------------------------------

    def _subscribe(self, type_name: str, topic: str, names: list[str], qos: QoSProfile) -> None:
        """Hand every message of a topic to the inputs of these names, one after the other."""

        def on_message(cdr: bytes) -> None:
            for name in names:
                self._take(self._border.take(name, cdr))

        received = self._received_by(on_message)
        if TF in names:
            received = self._but_our_own(received)
        self.create_subscription(message_class(type_name), topic, received, qos, raw=True)

    def _but_our_own(self, callback: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """Of /tf we hear what we say ourselves, too."""
        map_frame = self._slam.config.frames.map

        def heard(cdr: bytes) -> None:
            if not is_correction(cdr, map_frame):
                callback(cdr)

        return heard

    def _take(self, measurements: Sequence[Measurement]) -> None:
        for measurement in measurements:
            self._saved = False
            self._process(measurement)

    def _process(self, measurement: Measurement) -> None:
        update = self._slam.process(measurement)
        if self._recorder:
            self._recorder.record(self._slam, update)
        if update:
            self._pose.publish(results.pose(self._slam))
            self._path.publish(results.path(self._slam))
        if self._landmarks_due(update):
            self._landmarks_at = len(self._slam.keyframes) + self._slam.config.output.landmarks_every_keyframes
            self._landmarks.publish(results.landmarks(self._slam))

    def _landmarks_due(self, update: Update) -> bool:
        """From the first on regularly, whether or not somebody listens: who joins late gets the last that was sent."""
        regularly = bool(self._slam.landmarks) and len(self._slam.keyframes) >= self._landmarks_at
        return update.report is not None or (update.solved and regularly)

    def _tell(self, source: str, reason: str) -> None:
        self.get_logger().warn(f"{source}: {reason} (told once, counted from now on)")

    def _received_by(self, callback: Callable[[bytes], None]) -> Callable[[bytes], None]:
        """A callback whose messages are acknowledged, whatever becomes of them."""
        guarded = self._guarded(callback)

        def received(cdr: bytes) -> None:
            guarded(cdr)
            self._received += 1
            if self._has_player:
                self._publish_received()

        return received

    def _guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Nothing ends the node: what a callback raises is counted and told."""

        def guarded(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self._slam.counters.count("node", type(error).__name__)
                self.get_logger().error(f"{type(error).__name__}: {error}", throttle_duration_sec=5.0)

        return guarded

    # -- results out -------------------------------------------------------------------------------------------------

    def _publish_tf(self) -> None:
        """The correction, at most once per odometry stamp and never before the first."""
        stamp_ns = self._slam.newest_odometry_ns
        if stamp_ns is None or stamp_ns <= self._sent_tf_ns:
            return
        self._sent_tf_ns = stamp_ns
        ahead_ns = round(self._slam.config.tf.transform_tolerance * 1e9)
        self._tf.publish(results.map_to_odom(self._slam, stamp_ns + ahead_ns))

    def _look_for_player(self) -> None:
        self._has_player = self._acknowledge.get_subscription_count() > 0
        self._publish_received()

    def _publish_received(self) -> None:
        if self._received != self._acknowledged:
            self._acknowledged = self._received
            self._acknowledge.publish(UInt64(data=self._received))

    def _on_save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = self.save()
            response.success = True
        except Exception as error:
            response.message = str(error) if isinstance(error, GraphSlamError) else f"{type(error).__name__}: {error}"
        return response

    def save(self, release: str = "flush") -> str:
        """Release what waits, solve, and write the run folder; returns its name."""
        if self._recorder is None:
            raise GraphSlamError("output.folder is empty: nowhere to save")
        self._take(self._border.finish())
        if not self._saved:
            for event in (release, "optimize"):
                self._process(Control(event))
        folder = str(self._recorder.save(self._slam))
        self._saved = True
        return folder

    def finish(self) -> None:
        """Save what was not saved yet, and end the recording."""
        if self._recorder is None:
            return
        if not self._saved:
            self.get_logger().info(f"saved {self.save('end')}")
        self._recorder.close()


def _installed(config: Config) -> dict[str, Decoder]:
    """Decoders of the types whose layout is known to the packages that are installed, and not to us."""
    names = {one.type for one in config.sources if one.name in uses(config)} - set(typestore().types)
    return {name: partial(deserialize_message, message_type=message_class(name)) for name in names}


class _Told:
    """Whether Ctrl-C or SIGTERM came: noted, never raised, so that no message is left half-way."""

    def __init__(self) -> None:
        self.to_stop = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: Any) -> None:
        self.to_stop = True


def main() -> int:
    """Run the node until it is told to stop; returns the exit code: 0, 1 our fault, 2 refused to start or save."""
    told = _Told()
    try:
        _init()
        node = GraphSlamNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not told.to_stop and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
        node.finish()
        executor.shutdown()
        node.destroy_node()
    except GraphSlamError as error:
        rclpy.logging.get_logger("graph_slam").fatal(str(error))
        return 2
    except Exception as error:
        rclpy.logging.get_logger("graph_slam").fatal(f"a fault of ours, {type(error).__name__}: {error}")
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _init() -> None:
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy has several for arguments and files it cannot read
        raise GraphSlamError(" ".join(str(error).split())) from None


if __name__ == "__main__":
    sys.exit(main())
