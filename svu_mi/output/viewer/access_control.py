"""Access control for viser's server: only the secret address is answered.

Every program on the machine, and every web page in its browser, can reach a server on 127.0.0.1:
scripts may open WebSockets to any address, and their host name may be rebound to 127.0.0.1 (DNS
rebinding). A request therefore needs a secret as the first part of its path, a ``Host`` of this
machine and, if the browser sends one, the matching ``Origin``. viser's page derives the address of
its WebSocket from its own address and so keeps the secret.

viser has no option for this, so its arguments to ``websockets`` are replaced. The server is
stopped if it still answers a request without the secret.
"""

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

HOST = "127.0.0.1"  # not reachable from other machines
NAMES = (HOST, "localhost")  # accepted host names; the port may differ with SSH forwarding
REFUSAL = "Open the whole address that the viewer has printed.\n"
PRIVATE = {"Referrer-Policy": "no-referrer", "Cache-Control": "no-store"}  # protects the secret
SECONDS = 5.0  # timeout of the self-test

_patching = threading.Lock()


@dataclass(frozen=True)
class Guard:
    """Filter of requests: accepts those with the secret path that come from the page itself.

    Attributes:
        secret: First part of the path of every request.
    """

    secret: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    def allows(self, path: str, hosts: list[str], origins: list[str]) -> bool:
        """Check a request by its path and its headers ``Host`` and ``Origin``."""
        first = (path.partition("?")[0].split("/") + [""])[1]
        return (
            secrets.compare_digest(first.encode(errors="replace"), self.secret.encode())
            and len(hosts) == 1
            and host_name(hosts[0]) in NAMES
            and all(origin == f"http://{hosts[0]}" for origin in origins)
        )

    def process_request(self, then: Callable[..., Any] | None) -> Callable[..., Any]:
        """Return a callback of ``websockets`` that refuses a request or passes it to ``then``."""

        def guarded(connection: Any, request: Any) -> Any:
            headers = request.headers
            hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
            if not self.allows(request.path, hosts, origins):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL)
            if then is None:
                return None
            path = "/" + request.path.removeprefix(f"/{self.secret}").removeprefix("/")
            response = then(connection, replace(request, path=path))
            if response is not None:
                response.headers.update(PRIVATE)
            return response

        return guarded

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Protect all servers that viser starts in this context; verify with ``is_closed``."""
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
    """Return the name in a ``Host`` header without the port; None if malformed."""
    try:
        parts = urlsplit(f"//{host}")
        _ = parts.port  # raises a ValueError if it is not a number
    except ValueError:
        return None
    return parts.hostname if parts.netloc == host and "@" not in host else None


def is_closed(port: int) -> bool:
    """Check that a local server refuses a page and a WebSocket without the secret."""
    key = base64.b64encode(secrets.token_bytes(16)).decode()
    handshake = {
        "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": key,
    }  # fmt: skip
    return all(_answer(port, headers) == HTTPStatus.FORBIDDEN for headers in ({}, handshake))


def _answer(port: int, headers: dict[str, str]) -> int:
    """Return the HTTP status of a request for ``/``; 0 without an answer."""
    connection = http.client.HTTPConnection(HOST, port, timeout=SECONDS)
    with contextlib.closing(connection):
        try:
            connection.request("GET", "/", headers=headers)
            return connection.getresponse().status
        except (OSError, http.client.HTTPException):
            return 0


def require_viser() -> Any:
    """Import and return viser.

    Raises:
        SvuEnvironmentError: viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise SvuEnvironmentError(
            "The viewer needs viser, which is not installed: pip install 'svu_mi[viewer]'."
        ) from error
    return viser


def require_port(port: int) -> None:
    """Raise an ``OptionError`` if the port is invalid."""
    if not 0 <= port < 65536:
        raise OptionError(f"--port must be 0 to 65535, got {port}.")


def serve(port: int) -> tuple[Any, str]:
    """Start a ``ViserServer``; return it and its secret address.

    If the port is in use, the next free one is taken; 0 takes any free port.

    Raises:
        SvuEnvironmentError: viser is not installed, or its version cannot be protected.
        OptionError: the port is invalid.
    """
    require_port(port)
    viser = require_viser()
    # Browsers that disconnect would otherwise be logged as errors.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    guard = Guard()
    with contextlib.redirect_stdout(io.StringIO()), guard.installed():
        server = viser.ViserServer(host=HOST, port=port, label="svu view", verbose=False)
    if not is_closed(server.get_port()):
        stop(server)
        raise SvuEnvironmentError(
            "The viewer cannot be protected from other programs and web pages with viser "
            f"{viser.__version__}; run pip install 'svu_mi[viewer]'."
        )
    return server, f"http://{HOST}:{server.get_port()}/{guard.secret}/"


def stop(server: Any) -> None:
    """Stop a server and its threads."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
