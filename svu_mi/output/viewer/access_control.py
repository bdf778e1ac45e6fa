"""viser's server with access control: only a browser with the secret address is answered.

A server on 127.0.0.1 is open to every program of this machine, and to every page that a browser
shows: scripts may open WebSockets to any address, and a name of theirs may suddenly mean 127.0.0.1
(DNS rebinding). So each request must have a secret as the first part of its path, which viser's
page keeps when it derives the WebSocket's address from its own; a ``Host`` of this machine; and
the same ``Origin``, if the browser sends one.

viser has no option for this. The arguments that it passes to ``websockets`` are changed on the
way, and the server is stopped if it then answers a request without the secret.
"""

from __future__ import annotations

import base64
import contextlib
import http.client
import io
import logging
import secrets
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from svu_mi.errors import OptionError, SvuEnvironmentError

HOST = "127.0.0.1"  # no other machine
NAMES = (HOST, "localhost")  # of this machine; the port may be another one, through SSH
REFUSAL = "Open the whole address that the viewer has printed.\n"
PRIVATE = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}  # the address is secret
SECONDS = 5.0  # for an answer from this machine

_patching = threading.Lock()


@dataclass(frozen=True)
class Guard:
    """Lets requests through that know the secret and come from the page itself.

    Attributes:
        secret: first part of the path of every request.
    """

    secret: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def allows(self, path: str, hosts: list[str], origins: list[str]) -> bool:
        """Return whether to answer a request by its path and headers ``Host`` and ``Origin``."""
        first = (path.partition("?")[0].split("/") + [""])[1]
        return (
            secrets.compare_digest(first.encode(errors="replace"), self.secret.encode())
            and len(hosts) == 1
            and host_name(hosts[0]) in NAMES
            and all(origin == f"http://{hosts[0]}" for origin in origins)
        )

    def without_secret(self, path: str) -> str:
        """Return a path without the secret."""
        return "/" + path.removeprefix(f"/{self.secret}").removeprefix("/")

    def process_request(self, then: Callable[..., Any] | None) -> Callable[..., Any]:
        """Return a ``process_request`` of ``websockets`` that asks this guard before another."""

        def guarded(connection: Any, request: Any) -> Any:
            headers = request.headers
            hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
            if not self.allows(request.path, hosts, origins):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL)
            if then is None:
                return None
            response = then(connection, replace(request, path=self.without_secret(request.path)))
            if response is not None:
                response.headers.update(PRIVATE)
            return response

        return guarded

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Guard the servers that viser starts meanwhile; ``is_closed`` tells whether it worked."""
        from websockets.asyncio import server

        serve = server.serve

        def guarded(handler: Any, *words: Any, **options: Any) -> Any:
            if getattr(handler, "__module__", "").startswith("viser."):
                options["process_request"] = self.process_request(options.get("process_request"))
            return serve(handler, *words, **options)

        with _patching:
            server.serve = guarded  # type: ignore[assignment, misc]
            try:
                yield
            finally:
                server.serve = serve  # type: ignore[misc]


def host_name(host: str) -> str | None:
    """Return the name in a header ``Host`` without the port, None if it is malformed."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # ValueError: no number
    except ValueError:
        return None
    return parts.hostname if parts.netloc == host and "@" not in host else None


def is_closed(port: int) -> bool:
    """Return whether a server of this machine refuses a page and a WebSocket to a stranger."""
    key = base64.b64encode(secrets.token_bytes(16)).decode()
    handshake = {
        "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": key,
    }  # fmt: skip
    return all(_answer(port, headers) == HTTPStatus.FORBIDDEN for headers in ({}, handshake))


def _answer(port: int, headers: dict[str, str]) -> int:
    """Return the status with which ``/`` is answered, 0 if it is not."""
    connection = http.client.HTTPConnection(HOST, port, timeout=SECONDS)
    with contextlib.closing(connection):
        try:
            connection.request("GET", "/", headers=headers)
            return connection.getresponse().status
        except (OSError, http.client.HTTPException):
            return 0


def require_viser() -> Any:
    """Return the module viser.

    Raises:
        SvuEnvironmentError: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise SvuEnvironmentError(
            "The viewer needs viser, which is not installed: pip install 'svu_mi[viewer]'."
        ) from error
    return viser


def require_port(port: int) -> None:
    """Refuse an invalid port with an ``OptionError``."""
    if not 0 <= port < 65536:
        raise OptionError(f"--port must be 0 to 65535, got {port}.")


def serve(port: int) -> tuple[Any, str]:
    """Return a ``ViserServer`` and its secret address; the next free port is used, any if 0.

    Raises:
        SvuEnvironmentError: viser is not installed, or this version of it cannot be guarded.
        OptionError: not a port.
    """
    require_port(port)
    viser = require_viser()
    # A browser that goes away in the middle is nothing to log.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    guard = Guard()
    with _silence(), guard.installed():
        server = viser.ViserServer(host=HOST, port=port, label="svu view", verbose=False)
    if not is_closed(server.get_port()):
        stop(server)
        raise SvuEnvironmentError(
            f"The viewer cannot be protected from other pages and programs with viser "
            f"{viser.__version__}: pip install 'svu_mi[viewer]'."
        )
    return server, f"http://{HOST}:{server.get_port()}/{guard.secret}/"


def stop(server: Any) -> None:
    """Stop a server and its threads."""
    with _silence():
        server.stop()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep viser from printing."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
