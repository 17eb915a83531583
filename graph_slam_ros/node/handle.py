"""The part of the ROS node that its components use."""

# ruff: noqa: D102 - the rest is rclpy's

from collections.abc import Callable
from typing import Any, Protocol

from graph_slam_ros.slam import Config

Callback = Callable[..., None]
Guard = Callable[[Callback], Callback]
"""Makes of a callback one that raises nothing."""


class NodeHandle(Protocol):
    """The node as its components see it: methods of rclpy, which has no types for them, and of ``GraphSlamNode``.

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

    def configured(self) -> Any:
        """Return the runtime that exists since configuration. Raises GraphSlamError before."""

    def change(self, values: dict[str, Any]) -> None:
        """Set parameters, by name."""

    def create_publisher(self, *arguments: Any, **options: Any) -> Any: ...
    def destroy_publisher(self, *arguments: Any, **options: Any) -> object: ...
    def create_subscription(self, *arguments: Any, **options: Any) -> Any: ...
    def destroy_subscription(self, *arguments: Any, **options: Any) -> object: ...
    def create_timer(self, *arguments: Any, **options: Any) -> Any: ...
    def destroy_timer(self, *arguments: Any, **options: Any) -> object: ...
    def create_service(self, *arguments: Any, **options: Any) -> Any: ...
    def get_clock(self, *arguments: Any, **options: Any) -> Any: ...
    def get_logger(self, *arguments: Any, **options: Any) -> Any: ...
    def get_parameter(self, *arguments: Any, **options: Any) -> Any: ...
    def get_name(self, *arguments: Any, **options: Any) -> str: ...
    def get_fully_qualified_name(self, *arguments: Any, **options: Any) -> str: ...
    def get_namespace(self, *arguments: Any, **options: Any) -> str: ...
    def get_node_names_and_namespaces(self, *arguments: Any, **options: Any) -> list[tuple[str, str]]: ...
    def get_topic_names_and_types(self, *arguments: Any, **options: Any) -> list[tuple[str, list[str]]]: ...
    def get_publishers_info_by_topic(self, *arguments: Any, **options: Any) -> list[Any]: ...
    def resolve_topic_name(self, *arguments: Any, **options: Any) -> str: ...
