"""The server: the page, and what it asks for, on one socket; and its guard: who may ask, how much, for how long.

The page is for one person at one browser. Other pages in that browser, other programs and other machines can reach a
port, too. So a request needs the secret of this start, a Host that is this server's address (a name that somebody else
makes point here is refused), and an Origin that is the page's own.
"""

import errno
import hmac
import logging
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.report.contents import Contents
from graph_slam_ros.tools.report.page import Panel, plotly, whole_page
from graph_slam_ros.tools.view.workbench import Workbench, readable

MOST_BYTES = 2**20
"""The size of the body of a request."""
_HEADERS = {
    "cache-control": "no-store",
    "content-security-policy": "frame-ancestors 'none'",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}
HOST = "127.0.0.1"
"""The address that the server listens on; from another machine, ``ssh -L`` leads to it."""
MOST_CLIENTS = 8
_Answer = Callable[[bytes], dict[str, Any]]
_HERE = Path(__file__).resolve().parent


@dataclass
class Access:
    """The secrets of one start of the server.

    Attributes
    ----------
    port : where it listens, on the loopback
    token : in the address that is printed; it opens the page once
    key : in the cookie of the browser that opened it
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    key: str = field(default_factory=lambda: secrets.token_urlsafe(32))

    @property
    def cookie(self) -> str:
        """The name of the cookie; browsers share cookies between the ports of a host."""
        return f"graph_slam_view_{self.port}"

    @property
    def address(self) -> str:
        """The address that opens the page."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def admits_host(self, name: str) -> bool:
        """Return whether a Host or Origin (HOST:PORT) is this server."""
        return name in (f"{HOST}:{self.port}", f"localhost:{self.port}")

    def opens(self, token: str) -> bool:
        """Return whether a token opens the page; it does so once."""
        if not self.token or not hmac.compare_digest(token.encode(), self.token.encode()):
            return False
        self.token = ""
        return True

    def knows(self, key: str) -> bool:
        """Return whether a cookie is that of the browser that opened the page."""
        return hmac.compare_digest(key.encode(), self.key.encode())


class Guard:
    """Lets only requests of the page through to an application, and bounds them."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            return
        request, is_new = Request(scope), False
        status, why = self._fault(request)
        if not status and not self._access.knows(request.cookies.get(self._access.cookie, "")):
            is_new = request.method == "GET" and self._access.opens(request.query_params.get("token", ""))
            if not is_new:
                status, why = (
                    403,
                    "open the address that `graph_slam view` printed: it can be used once, in one browser",
                )

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                more = dict(_HEADERS)
                if is_new:
                    flags = "Path=/; HttpOnly; SameSite=Strict"
                    more["set-cookie"] = f"{self._access.cookie}={self._access.key}; {flags}"
                pairs = [(name.encode(), value.encode()) for name, value in more.items()]
                message["headers"] = [*message.get("headers", ()), *pairs]
            await send(message)

        app = PlainTextResponse(f"{why}\n", status) if status else self._app
        await app(scope, receive, sent)

    def _fault(self, request: Request) -> tuple[int, str]:
        """Return the status and the sentence with which a request is refused; 0 if it is not."""
        headers = request.headers
        if len(headers.getlist("host")) != 1 or not self._access.admits_host(headers["host"]):
            return 403, "Host: not the address of this server"
        origin = headers.get("origin")
        is_own = origin is not None and origin.startswith("http://") and self._access.admits_host(origin[7:])
        if origin is not None and not is_own:
            return 403, "Origin: another page asks"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return 403, "Sec-Fetch-Site: another page asks"
        if request.method not in ("GET", "POST"):
            return 405, "only GET and POST"
        if request.method == "POST":
            if origin is None:
                return 403, "Origin: missing"
            if headers.get("content-type", "").partition(";")[0].strip() != "application/json":
                return 415, "Content-Type: not application/json"
            if headers.get("content-length", "").isdecimal() and int(headers["content-length"][:20]) > MOST_BYTES:
                return 413, f"larger than {MOST_BYTES} bytes"
        return 0, ""


class TooLargeError(Exception):
    """A body of too many bytes."""


async def body_of(request: Request) -> bytes:
    """The body of a request. Raises TooLargeError above ``MOST_BYTES``."""
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > MOST_BYTES:
            raise TooLargeError
        parts.append(part)
    return b"".join(parts)


def page_of(made: Contents, work: Workbench) -> str:
    """The page of a report with the panel of edits. Raises GraphSlamError where plotly is not installed."""
    names = "edits_bar.html", "edits.html", "edits.css", "edits.js"
    bar, html, css, script = ((_HERE / name).read_text(encoding="utf-8") for name in names)
    return whole_page(made, plotly(), Panel(bar, html, css, script, work.page_data))


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
            found = await run_in_threadpool(answer, await body_of(request))
        except TooLargeError:
            return JSONResponse({"error": f"larger than {MOST_BYTES} bytes"}, 413, {"connection": "close"})
        except ClientDisconnect:
            return JSONResponse({"error": "the request did not come whole"}, 408, {"connection": "close"})
        except GraphSlamError as error:
            return JSONResponse({"error": readable(error)}, 422)
        except OSError as error:
            return JSONResponse({"error": readable(error)}, 500)
        return JSONResponse(found)

    return respond


def listening(port: int) -> socket.socket:
    """A socket that clients can connect to, and that answers when a server is run with it; port 0 is a free one.

    Raises GraphSlamError: the port is somebody else's.
    """
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind((HOST, port))
        bound.listen(MOST_CLIENTS)
    except OSError as error:
        bound.close()
        mend = "choose another --port, or none for a free one" if error.errno == errno.EADDRINUSE else error.strerror
        raise GraphSlamError(f"{HOST}:{port}: cannot be listened on: {mend}") from None
    return bound


def server(app: Guard) -> uvicorn.Server:
    """Make a server, which ``run`` starts with a socket that listens."""
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)  # what a client does wrong is its own affair
    config = uvicorn.Config(
        app,
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        limit_concurrency=MOST_CLIENTS + 1,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=1,
        http="h11",
        h11_max_incomplete_event_size=16_384,
    )
    return uvicorn.Server(config)
