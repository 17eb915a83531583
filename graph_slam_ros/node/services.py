"""Services with a slow answer: the worker answers when the work is done, and callbacks go on meanwhile."""

import math
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from graph_slam_ros.errors import ConfigError, GraphSlamError, message_of

if TYPE_CHECKING:
    from graph_slam_ros.node.node import GraphSlamNode
    from graph_slam_ros.node.runtime import Runtime


SERVICES: "dict[str, Callable[[Runtime], Future[str]]]" = {
    "save": lambda run: run.save(),
    "load": lambda run: run.load(),
    "reset": lambda run: run.reset(),
    "pause": lambda run: run.pause(True),
    "resume": lambda run: run.pause(False),
    "optimize": lambda run: run.control("optimize"),
    "clear_closures": lambda run: run.control("clear_closures"),
}
"""What is asked of a configured node by ``std_srvs/Trigger``."""


@dataclass(frozen=True, slots=True)
class _Later:
    response: Any
    future: "Future[str]"


def _triggered(response: Any, message: str, error: BaseException | None) -> Any:
    response.success, response.message = error is None, message_of(error) if error is not None else message
    return response


Answer = Callable[[Any, str, BaseException | None], Any]


def serve_later(
    node: "GraphSlamNode",
    name: str,
    start: Callable[[Any], "Future[str]"],
    kind: Any = Trigger,
    answer: Answer = _triggered,
) -> None:
    """Serve requests, of ``std_srvs/Trigger`` by default: ``start`` starts the work, and its result is the message.

    ``answer`` fills the response with the message or the error. rclpy's own way, a coroutine, blocks a single-threaded
    executor, and its events executor does not support it.
    """

    def on_request(request: Any, response: Any) -> Any:
        try:
            return _Later(response, start(request))
        except Exception as error:
            return answer(response, "", error)

    service: Any = node.create_service(kind, name, on_request)
    send = service.send_response

    def send_when_done(response: Any, header: Any) -> None:
        if not isinstance(response, _Later):
            send(response, header)
            return

        def answer_now(future: "Future[str]") -> None:
            error = future.exception()
            filled = answer(response.response, future.result() if error is None else "", error)
            with suppress(Exception):  # the node, or who asked, has gone in the meantime
                send(filled, header)

        response.future.add_done_callback(answer_now)

    service.send_response = send_when_done


_GIVEN_POSE, _LOCALIZE = 2, 3  # match_type of slam_toolbox/srv/DeserializePoseGraph
_BAD_NAME, _BAD_MATCH_TYPE, _UNREADABLE, _FAILED = 1, 2, 3, 255  # its result, and that of SerializePoseGraph

Values = dict[str, Any]


class MatchTypeError(GraphSlamError):
    """A request that does not contain where the robot is."""


def saved_as(request: Any) -> Values:
    """Convert a SerializePoseGraph request into parameters. Raises ConfigError without a name."""
    return {"output.save_as": _name(request)}


def loaded_from(request: Any, dimensions: int) -> Values:
    """Convert a DeserializePoseGraph request into parameters. Raises ConfigError without a name, or MatchTypeError."""
    if request.match_type not in (_GIVEN_POSE, _LOCALIZE):
        raise MatchTypeError(
            f"match_type: {request.match_type} gives no pose: ask for START_AT_GIVEN_POSE (2) or LOCALIZE_AT_POSE (3)"
        )
    pose = _pose_text(request.initial_pose, dimensions)
    localizes = request.match_type == _LOCALIZE
    return {"output.load": _name(request), "output.load_pose": pose, "map.localize": localizes}


def serve_maps(node: "GraphSlamNode") -> None:
    """Serve ``~/serialize_map`` and ``~/deserialize_map`` if slam_toolbox is installed."""
    try:
        types = import_module("slam_toolbox.srv")
    except ImportError:
        return

    def save(request: Any) -> "Future[str]":
        config = node.config.changed(saved_as(request))
        return node.configured().save(config)

    def load(request: Any) -> "Future[str]":
        config = node.config.changed(loaded_from(request, node.config.world.dimensions))
        run = node.configured()
        run.session.earlier(config.output.load)  # before anything changes
        if config.map.localize != node.config.map.localize:
            node.set_parameters_atomically([Parameter("map.localize", value=config.map.localize)])
        return run.load(config)

    def answer(response: Any, message: str, error: BaseException | None) -> Any:
        """Fill the response with its result code; the log gets the message, for which it has no field."""
        if error is None:
            node.get_logger().info(message)
        else:
            node.get_logger().error(message_of(error))
        if hasattr(response, "result"):  # some versions answer with nothing
            response.result = _code(response, error)
        return response

    serve_later(node, "~/serialize_map", save, types.SerializePoseGraph, answer)
    serve_later(node, "~/deserialize_map", load, types.DeserializePoseGraph, answer)


def _code(response: Any, error: BaseException | None) -> int:
    if error is None:
        return 0
    if not hasattr(response, "RESULT_INVALID_FILENAME"):
        return _FAILED
    by_type: dict[type[BaseException], int] = {ConfigError: _BAD_NAME, MatchTypeError: _BAD_MATCH_TYPE}
    return by_type.get(type(error), _UNREADABLE if isinstance(error, GraphSlamError) else _FAILED)


def _name(request: Any) -> str:
    if not request.filename:
        raise ConfigError("filename: is empty: give the name of a run in the directory of output.folder")
    return str(request.filename)


def _pose_text(pose: Any, dimensions: int) -> str:
    if hasattr(pose, "theta"):  # geometry_msgs/Pose2D
        numbers = [pose.x, pose.y, pose.theta]
    else:
        p, q = pose.position, pose.orientation
        if not math.isclose(math.hypot(q.x, q.y, q.z, q.w), 1.0, abs_tol=0.01):
            raise MatchTypeError("initial_pose: its orientation is no unit quaternion")
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        roll = math.atan2(2.0 * (q.w * q.x + q.y * q.z), 1.0 - 2.0 * (q.x * q.x + q.y * q.y))
        pitch = math.asin(max(-1.0, min(1.0, 2.0 * (q.w * q.y - q.z * q.x))))
        numbers = [p.x, p.y, yaw] if dimensions == 2 else [p.x, p.y, p.z, roll, pitch, yaw]
    return " ".join(map(repr, map(float, numbers)))
