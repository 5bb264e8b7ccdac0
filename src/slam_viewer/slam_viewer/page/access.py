# SPDX-License-Identifier: Apache-2.0
"""Rules of who may open the page: a token in the address, the page's own origin, and no parameters.

viser answers every request and takes websockets from any page that a browser shows. Here each request is judged before
viser gets it. A page that only this machine can reach needs no token, but the name of this machine in its address:
a foreign name that has been made to point here (DNS rebinding) is refused. Any other page has a token in its address.
"""

from __future__ import annotations

import gzip
import html
import http
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

_ProcessRequest = Callable[[ServerConnection, Request], Response | None]

_INDEX = Path(viser.__file__).parent / "client" / "build" / "index.html"
_TITLE = b"<title>Viser</title>"
_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Encoding": "gzip",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
}


class Access:
    """Judges the requests to a page that listens on ``host``, and answers those for the page itself.

    Parameters
    ----------
    host
        Address or name that the page listens on.
    title
        The page's title in the browser.
    """

    def __init__(self, host: str, title: str) -> None:
        self._host = host
        self.token = "" if _is_loopback(host) else secrets.token_urlsafe(16)
        page = _INDEX.read_bytes().replace(_TITLE, b"<title>" + html.escape(title).encode() + b"</title>", 1)
        self._page = gzip.compress(page, 1)
        self._serves = False

    def url(self, port: int) -> str:
        """Address of the page for a browser, with its token where it has one."""
        host = {"127.0.0.1": "localhost", "0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(
            self._host, self._host
        )
        path = f"/{self.token}/" if self.token else ""
        return f"http://{f'[{host}]' if ':' in host else host}:{port}{path}"

    def refusal(self, path: str, host: str, origin: str | None, *, is_websocket: bool) -> str:
        """Reason why a request is refused, or "" where it is granted; ``host`` and ``origin`` as in its header."""
        if not self.token and not _is_loopback(urlsplit(f"//{host}").hostname or ""):
            return "this page is for this machine alone: its address begins with http://localhost"
        # The client would take the address of another server from a parameter, and show what that one says.
        if not secrets.compare_digest(path.strip("/").encode(), self.token.encode()):
            return "the address of this page is not complete: the program that serves it prints it, with its token"
        if is_websocket and (not host or urlsplit(origin or "").netloc.lower() != host.lower()):
            return f"another page ({origin}) may not take part in this one"
        return ""

    def answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Response to a request, or None for a websocket that may be opened."""
        is_websocket = request.headers.get("Upgrade", "").lower() == "websocket"
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        host = hosts[0] if len(hosts) == 1 else ""
        origin = origins[0] if len(origins) == 1 else None
        if refused := self.refusal(request.path, host, origin, is_websocket=is_websocket):
            return connection.respond(http.HTTPStatus.FORBIDDEN, refused + "\n")
        if is_websocket:
            return None
        headers = Headers(_HEADERS | {"Content-Length": str(len(self._page))})
        return Response(http.HTTPStatus.OK, "OK", headers, self._page)

    @contextmanager
    def guarding(self) -> Iterator[None]:
        """Guard the one server of viser that starts in the block, which takes no rule of its own.

        Raises
        ------
        RuntimeError
            If none has started: this version of viser would be served without a guard.
        """
        module: Any = websockets.asyncio.server
        serve = module.serve

        def guarded(*args: Any, **options: Any) -> Any:
            self._serves = True
            return serve(*args, **(options | {"process_request": self.answer}))

        module.serve = guarded
        try:
            yield
        finally:
            module.serve = serve
        if not self._serves:
            raise RuntimeError(f"the page cannot be guarded with viser {viser.__version__}: install 1.1.1")


def _is_loopback(host: str) -> bool:
    """True if only this machine reaches a host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
