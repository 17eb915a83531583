"""The server: the page, and what it asks for, on one socket."""

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route
from uvicorn.protocols.http.h11_impl import H11Protocol

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.view.guard import MOST_BYTES, Access, Guard, TooLargeError, body_of
from graph_slam_ros.tools.view.workbench import Workbench, readable

MOST_CLIENTS = 8
PATIENCE_S = 10.0
"""How long a request may take to come, and a connection or an answer may rest."""
_Answer = Callable[[bytes], dict[str, Any]]


def application(work: Workbench, page: str, access: Access) -> Guard:
    """The application: the page and three questions, behind a guard."""

    async def show(request: Request) -> Response:
        return HTMLResponse(page)

    routes = [Route("/", show, methods=["GET"])]
    for path, answer in (("/solve", work.solve), ("/try", work.attempt), ("/save", work.save)):
        routes.append(Route(path, _asked(answer), methods=["POST"]))
    return Guard(Starlette(routes=routes), access)


def _asked(answer: _Answer) -> Callable[[Request], Any]:
    """A route that answers JSON with JSON; what cannot be done is one line."""

    async def respond(request: Request) -> Response:
        try:
            found = await run_in_threadpool(answer, await asyncio.wait_for(body_of(request), PATIENCE_S))
        except TooLargeError:
            return JSONResponse({"error": f"larger than {MOST_BYTES} bytes"}, 413, {"connection": "close"})
        except (TimeoutError, asyncio.TimeoutError, ClientDisconnect):
            return JSONResponse({"error": "the request did not come whole"}, 408, {"connection": "close"})
        except GraphSlamError as error:
            return JSONResponse({"error": readable(error)}, 422)
        except OSError as error:
            return JSONResponse({"error": readable(error)}, 500)
        return JSONResponse(found)

    return respond


def listening(host: str, port: int) -> socket.socket:
    """A socket that is bound, and not yet open for clients; port 0 is a free one.

    Raises
    ------
    GraphSlamError
        The address is not of this machine, or the port is somebody else's.
    """
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, kind, protocol)
    except OSError as error:
        raise GraphSlamError(f"--host {host}: {error.strerror}") from None
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(where)
    except OSError as error:
        bound.close()
        mend = "choose another --port, or none for a free one" if error.errno == errno.EADDRINUSE else error.strerror
        raise GraphSlamError(f"{host}:{port}: cannot be listened on: {mend}") from None
    return bound


class _Patient(H11Protocol):
    """A connection that is dropped if for some time it neither asks anything nor reads more of an answer."""

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > 2 * MOST_CLIENTS:  # up to that many are at least refused in words
            transport.abort()
        self._before: tuple[Any, int] = self, 0
        self._due = self.loop.call_later(PATIENCE_S, self._drop_idle)

    def connection_lost(self, exc: Exception | None) -> None:
        self._due.cancel()
        super().connection_lost(exc)

    def _drop_idle(self) -> None:
        now = self.cycle, self.transport.get_write_buffer_size()
        is_at_rest = self.cycle is None or self.cycle.response_complete or now[1] > 0
        if is_at_rest and now == self._before:
            self.transport.abort()
            return
        self._before = now
        self._due = self.loop.call_later(PATIENCE_S, self._drop_idle)


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._ready()


def server(app: Guard, ready: Callable[[], None]) -> uvicorn.Server:
    """Make a server, which ``run`` starts with a bound socket; it calls ``ready`` when clients can come."""
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)  # what a client does wrong is its own affair
    config = uvicorn.Config(
        app,
        http=_Patient,
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=MOST_CLIENTS + 1,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=1,
        h11_max_incomplete_event_size=16_384,
    )
    return _Server(config, ready)
