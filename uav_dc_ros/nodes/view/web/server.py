"""A small web server: one page, and a stream of news to each open page (server-sent events).

Each page has a thread of its own. A page that is slow receives what it missed in one piece, one that stops
reading is disconnected after a while, and none holds up another or the node.
"""

import hmac
import ipaddress
import secrets
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from uav_dc_ros.errors import ParameterError
from uav_dc_ros.nodes.view.web.feed import Cursor, Feed

PERIOD_S = 0.1  # between two pieces of news
SILENCE_S = 10.0  # after which a comment shows that the connection is alive
SEND_TIMEOUT_S = 20.0  # for a page that does not read
PAGES_MAX = 32  # open at once
CLOSE_S = 0.5  # for the pages to learn that the mission is over
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": POLICY,
    "Referrer-Policy": "no-referrer",  # the address may hold the token
    "X-Content-Type-Options": "nosniff",
}


def is_local(address: str) -> bool:
    """Whether only this machine reaches a network address."""
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address == "localhost"


def token_for(address: str, given: str) -> str:
    """The given token; without one a random one, or none where only this machine reaches the address."""
    return given or ("" if is_local(address) else secrets.token_urlsafe(16))


def check(*, address: str, port: int) -> None:
    """Raise ParameterError if a server cannot be started."""
    try:
        socket.create_server((address, port), family=_family(address)).close()
    except OSError as error:
        raise _port_error(address, port, error) from None


def free_port(address: str) -> int:
    """A TCP port that nothing listens on."""
    with socket.create_server((address, 0), family=_family(address)) as server:
        port: int = server.getsockname()[1]
    return port


def url(address: str, port: int, token: str) -> str:
    """Address of the page, for a browser; an address that stands for all is this machine's name."""
    host = socket.gethostname() if address in ("0.0.0.0", "::") else address
    host = f"[{host}]" if ":" in host else host
    return f"http://{host}:{port}/" + (f"?token={token}" if token else "")


def _family(address: str) -> int:
    return socket.AF_INET6 if ":" in address else socket.AF_INET


def _port_error(address: str, port: int, error: OSError) -> ParameterError:
    reason = str(error.strerror or error).partition(" (while")[0]
    return ParameterError(
        f"port: {port} at address {address!r}: {reason}; expected a free port of this machine (0: any)"
    )


class ViewServer:
    """A running server of a page and its feed.

    With a `token`, pages need `?token=TOKEN` in their address. Without one, the server answers only browsers
    whose address names this machine: a page of another site cannot reach it under a name of its own.
    Raises ParameterError if the port is in use, or the address belongs to another machine.
    """

    def __init__(self, feed: Feed, page: bytes, *, address: str, port: int, token: str = "") -> None:
        self.feed, self.page, self.token = feed, page, token
        self.is_closing = False
        self.pages = 0
        self._lock = threading.Lock()
        try:
            self._http = _HttpServer(self, address, port)
        except OSError as error:
            raise _port_error(address, port, error) from None
        threading.Thread(target=self._http.serve_forever, args=(PERIOD_S,), daemon=True).start()

    @property
    def port(self) -> int:
        """TCP port of the server."""
        port: int = self._http.server_address[1]
        return port

    def admit(self, difference: int) -> bool:
        """Count a page that opens (1) or closes (-1); false if too many are open."""
        with self._lock:
            if self.pages + difference > PAGES_MAX:
                return False
            self.pages += difference
            return True

    def stop(self) -> None:
        """Send what is left, close all connections and the port."""
        self.is_closing = True
        with self.feed.changing():
            pass
        deadline_s = time.monotonic() + CLOSE_S
        while self.pages and time.monotonic() < deadline_s:
            time.sleep(0.01)
        self._http.shutdown()
        self._http.server_close()


class _HttpServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, view: ViewServer, address: str, port: int) -> None:
        self.view = view
        self.address_family = _family(address)
        super().__init__((address, port), _Handler)

    def server_bind(self) -> None:
        """Bind, without the name server that the base class queries for this machine's name."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a connection that broke."""


class _Handler(BaseHTTPRequestHandler):
    server: _HttpServer
    timeout = SEND_TIMEOUT_S
    server_version, sys_version = "uav_dc_ros", ""

    def do_GET(self) -> None:
        """Answer a browser."""
        view, target = self.server.view, urlsplit(self.path)
        if not self._is_allowed(target.query):
            expected = "the address that run_all printed, with its token" if view.token else "localhost"
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", f"expected {expected}\n".encode())
        elif target.path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", view.page)
        elif target.path != "/news":
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"expected / or /news\n")
        elif not view.admit(1):
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", b"too many pages are open\n")
        else:
            try:
                self._stream(view)
            finally:
                view.admit(-1)

    def _is_allowed(self, query: str) -> bool:
        token = self.server.view.token
        if token:
            (given,) = parse_qs(query).get("token", [""])[:1]
            return hmac.compare_digest(given.encode(), token.encode())
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        return is_local(host.strip("[]"))

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _stream(self, view: ViewServer) -> None:
        """Send news until the page or the server closes."""
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        for name, value in {"Content-Type": "text/event-stream", **HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()
        cursor = Cursor()
        while True:
            has_news = view.feed.wait(cursor, SILENCE_S)
            is_closing = view.is_closing
            self.wfile.write(b"data: " + view.feed.news(cursor) + b"\n\n" if has_news else b":\n\n")
            if is_closing:
                self.wfile.write(b"event: end\ndata:\n\n")
                return
            time.sleep(PERIOD_S)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""
