"""The guard of the server: who may ask, how much, and how long it may last.

The page is for one person at one browser. Other pages in that browser, other programs and other machines can reach a
port, too. So a request needs the secret of this start, a Host that is this server's address (a name that somebody else
makes point here is refused), and an Origin that is the page's own.
"""

import hmac
import secrets
from dataclasses import dataclass, field

from starlette.requests import Request
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
