"""The page's server: viser on this machine alone, behind a check of who connects; and threads that work for it.

viser accepts every connection. Here the address holds a random token, which every request and websocket has to name;
what comes from a page of another origin, or under another host's name, is refused before viser sees it.
"""

from __future__ import annotations

import http
import logging
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, redirect_stdout
from dataclasses import dataclass, field, replace
from http.client import HTTPConnection
from io import StringIO
from queue import SimpleQueue
from typing import Any

import viser
import websockets.asyncio.server as websocket_server
from websockets import Headers
from websockets.http11 import Request, Response

from lidardesign.errors import ConfigError

HOST, HOSTS = "127.0.0.1", ("127.0.0.1", "localhost")
OPTION = "--port"
TOKEN_BYTES = 24
# Strangers may send anything, and the user's terminal is no log of it.
SILENT = logging.Logger("studio", logging.CRITICAL + 1)
END_S = 1.0  # for which what is under way is waited for


class LocalServer(viser.ViserServer):
    """viser without its way to make a page public."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: the page stays on this machine."""
        return None


@dataclass
class Guard:
    """The check of who connects.

    Arguments:
        token: The first part of every path.
        port: The port, once it is known.
    """

    token: str = field(default_factory=lambda: secrets.token_urlsafe(TOKEN_BYTES))
    port: int = 0

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    def refuses(self, request: Request) -> bool:
        """True for a request without the token, to another host, or from a page of another origin."""
        names = {f"{host}:{self.port}" for host in HOSTS}
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        token = request.path.split("?")[0].strip("/").split("/")[0]
        return (
            len(hosts) != 1
            or hosts[0] not in names
            or not {*origins} <= {f"http://{name}" for name in names}
            or not secrets.compare_digest(token.encode(errors="surrogateescape"), self.token.encode())
        )

    def within(self, request: Request) -> Request:
        """The request with a path that viser knows."""
        path, mark, query = request.path.partition("?")
        rest = path.strip("/").removeprefix(self.token)
        return replace(request, path=f"/{rest.strip('/')}{mark}{query}")


def start_server(port: int | None = None) -> tuple[viser.ViserServer, Guard]:
    """Start the page's server, and see that it refuses a stranger.

    Arguments:
        port: The port to listen on; None: any that is free.

    Raises:
        ConfigError: The port is taken, or the check does not hold.
    """
    guard = Guard()
    with _checked_by(guard), redirect_stdout(StringIO()):  # viser greets
        server = LocalServer(host=HOST, port=port or 0, verbose=False)
    guard.port = server.get_port()
    if port not in (None, guard.port):
        stop_server(server)
        raise ConfigError(f"the port {port} is taken", where=OPTION, allowed="a free port, or none for any")
    if _lets_strangers_in(guard):
        stop_server(server)
        raise ConfigError(
            f"viser {viser.__version__} goes around the check of who connects", where="studio", hint="install viser 1.1"
        )
    return server, guard


def stop_server(server: viser.ViserServer) -> None:
    """Stop the server and its threads."""
    with redirect_stdout(StringIO()):  # viser says goodbye
        server.stop()
    server._thread_executor.shutdown(wait=True)


@contextmanager
def _checked_by(guard: Guard) -> Iterator[None]:
    """A context in which servers of websockets check their requests: viser has no place for that of its own."""
    serve = websocket_server.serve

    def checked_serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def check(connection: Any, request: Request) -> Response | None:
            if request.path == "/favicon.ico":
                return Response(http.HTTPStatus.NO_CONTENT, "No Content", Headers({"Content-Length": "0"}))
            if guard.refuses(request):
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", Headers({"Content-Length": "0"}))
            return process_request(connection, guard.within(request))

        return serve(*arguments, process_request=check, logger=SILENT, **options)

    websocket_server.serve = checked_serve
    try:
        yield
    finally:
        websocket_server.serve = serve


def _lets_strangers_in(guard: Guard) -> bool:
    connection = HTTPConnection(HOST, guard.port, timeout=10)
    with closing(connection):
        connection.request("GET", "/")
        return connection.getresponse().status != http.HTTPStatus.FORBIDDEN


class Worker:
    """A thread that does the last thing asked for under each name; what waits under the same name is dropped.

    Arguments:
        name: Of the thread.
        failed: Called with what was raised.
    """

    def __init__(self, name: str, failed: Callable[[Exception], None]) -> None:
        self._queue: SimpleQueue[Any] = SimpleQueue()
        self._last: dict[Any, Callable[[], None]] = {}
        self._failed = failed
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def ask(self, name: Any, work: Callable[[], None]) -> None:
        """Have something done after what was asked for under other names."""
        self._last[name] = work
        self._queue.put((name, work))

    def stop(self) -> None:
        """End the thread after what it does now, which is not waited for long."""
        self._last.clear()
        self._queue.put(None)
        self._thread.join(END_S)

    def _work(self) -> None:
        for name, work in iter(self._queue.get, None):
            if self._last.get(name) is work:
                try:
                    work()
                except Exception as error:
                    self._failed(error)
