"""Services with a slow answer: the worker answers when the work is done, and callbacks go on meanwhile."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from std_srvs.srv import Trigger

from graph_slam_ros.errors import message_of
from graph_slam_ros.node.handle import NodeHandle


@dataclass(frozen=True, slots=True)
class _Later:
    response: Any
    future: "Future[str]"


def _triggered(response: Any, message: str, error: BaseException | None) -> Any:
    response.success, response.message = error is None, message_of(error) if error is not None else message
    return response


Answer = Callable[[Any, str, BaseException | None], Any]


def serve_later(
    node: NodeHandle, name: str, start: Callable[[Any], "Future[str]"], kind: Any = Trigger, answer: Answer = _triggered
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

    service = node.create_service(kind, name, on_request)
    send = service.send_response

    def send_when_done(response: Any, header: Any) -> None:
        if isinstance(response, _Later):
            response.future.add_done_callback(lambda future: _send(send, filled(response.response, future), header))
        else:
            send(response, header)

    def filled(response: Any, future: "Future[str]") -> Any:
        error = future.exception()
        return answer(response, future.result() if error is None else "", error)

    service.send_response = send_when_done


def _send(send: Callable[[Any, Any], None], response: Any, header: Any) -> None:
    try:
        send(response, header)
    except Exception:  # the node, or who asked, has gone in the meantime
        return
