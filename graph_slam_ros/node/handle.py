"""The part of the ROS node that its components use."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol

from graph_slam_ros.slam import Config

Callback = Callable[..., None]
Guard = Callable[[Callback], Callback]
"""Makes of a callback one that raises nothing."""


class Logger(Protocol):
    """The part of a logger that the node uses."""

    def info(self, message: str) -> object:
        """Log as INFO."""

    def warn(self, message: str, *, throttle_duration_sec: float = 0.0) -> object:
        """Log as WARN."""

    def error(self, message: str) -> object:
        """Log as ERROR."""


class NodeHandle(Protocol):
    """The node as its components see it: methods of rclpy and of ``GraphSlamNode``.

    Messages, publishers, subscriptions, timers and clocks are rclpy's, which has no types for them.

    Attributes
    ----------
    config : the configuration, as it is now
    """

    config: Config

    @property
    def now_ns(self) -> int:
        """ROS time; 0 before the first /clock if simulated time is used."""

    @property
    def has_player(self) -> bool:
        """Return whether somebody subscribes to the number of received messages."""

    def guarded(self, callback: Callback) -> Callback:
        """Return a callback that never raises: exceptions of the given one are counted and logged."""

    def report_fault(self, error: Exception) -> None:
        """Count and log the exception of a job."""

    def acknowledge(self, count: int) -> None:
        """Publish the number of messages received."""

    def create_publisher(self, message: Any, topic: str, qos: Any) -> Any:
        """Create a publisher."""

    def destroy_publisher(self, publisher: Any) -> object:
        """Remove a publisher."""

    @property
    def create_subscription(self) -> Callable[..., Any]:
        """Create a subscription, with the arguments of rclpy."""

    def destroy_subscription(self, subscription: Any) -> object:
        """Remove a subscription."""

    @property
    def create_timer(self) -> Callable[..., Any]:
        """Create a timer, with the arguments of rclpy."""

    def destroy_timer(self, timer: Any) -> object:
        """Remove a timer."""

    def create_service(self, kind: Any, name: str, callback: Callable[[Any, Any], Any]) -> Any:
        """Create a service."""

    def get_clock(self) -> Any:
        """Return the clock of the node."""

    def get_logger(self) -> Logger:
        """Return the logger of the node."""

    def get_parameter(self, name: str) -> Any:
        """Return a parameter."""

    def get_name(self) -> str:
        """Return the name without the namespace."""

    def get_fully_qualified_name(self) -> str:
        """Return the name with the namespace."""

    def get_namespace(self) -> str:
        """Return the namespace."""

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Return all nodes of the ROS graph."""

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        """Return all topics of the ROS graph with their types."""

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        """Return the endpoints that publish a topic."""

    def resolve_topic_name(self, topic: str) -> str:
        """Return the full name of a topic."""


class MapServer(NodeHandle, Protocol):
    """A node that can save and load maps by name."""

    def configured(self) -> "MapRun":
        """Return the runtime that exists since configuration. Raises GraphSlamError before."""

    def change(self, values: dict[str, Any]) -> None:
        """Set parameters, by name."""


class MapRun(Protocol):
    """A run whose map can be saved, and that can go on in another."""

    def save(self, config: Config | None = None) -> "Future[str]":
        """Save the run, and its map under the name of the configuration."""

    def check_map(self, name: str) -> None:
        """Raise RunError if no run of that name can be loaded."""

    def load(self, config: Config | None = None) -> "Future[str]":
        """Continue from the run that the configuration names."""
