"""Services whose answer takes long: given by whoever has the work done, while callbacks go on."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from std_srvs.srv import Trigger

from graph_slam_ros.errors import said


@dataclass(frozen=True, slots=True)
class _Later:
    response: Any
    future: "Future[str]"


def serve_later(node: Any, name: str, start: Callable[[], "Future[str]"]) -> None:
    """Serve a ``std_srvs/Trigger``: ``start`` begins the work, what comes of it is the message.

    rclpy's own way, a coroutine, holds up a single-threaded executor, and its events executor knows none.
    """

    def on_request(_: Any, response: Any) -> Any:
        try:
            return _Later(response, start())
        except Exception as error:
            return _failed(response, error)

    service = node.create_service(Trigger, name, on_request)
    send = service.send_response

    def send_when_done(response: Any, header: Any) -> None:
        if isinstance(response, _Later):
            response.future.add_done_callback(lambda future: _send(send, _filled(response.response, future), header))
        else:
            send(response, header)

    service.send_response = send_when_done


def _filled(response: Any, future: "Future[str]") -> Any:
    error = future.exception()
    if error is not None:
        return _failed(response, error)
    response.success, response.message = True, future.result()
    return response


def _failed(response: Any, error: BaseException) -> Any:
    response.success = False
    response.message = said(error)
    return response


def _send(send: Callable[[Any, Any], None], response: Any, header: Any) -> None:
    try:
        send(response, header)
    except Exception:  # the node, or who asked, has gone in the meantime
        return
