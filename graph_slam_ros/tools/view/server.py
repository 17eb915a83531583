"""The server: the page, and what it asks for, on one socket."""

import errno
import logging
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from graph_slam_ros.errors import GraphSlamError
from graph_slam_ros.tools.report.contents import Contents
from graph_slam_ros.tools.report.page import Panel, plotly, whole_page
from graph_slam_ros.tools.view.guard import HOST, MOST_BYTES, Access, Guard, TooLargeError, body_of
from graph_slam_ros.tools.view.workbench import Workbench, readable

MOST_CLIENTS = 8
_Answer = Callable[[bytes], dict[str, Any]]
_HERE = Path(__file__).resolve().parent


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

    Raises
    ------
    GraphSlamError
        The port is somebody else's.
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
