"""viser's server: started behind a guard, and stopped, without a word."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from typing import Any

from svu_mi.errors import OptionError, SvuEnvironmentError
from svu_mi.output.viewer.guard import Guard, is_closed

HOST = "127.0.0.1"  # no other machine


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
    """Refuse with an ``OptionError`` what is not a port."""
    if not 0 <= port < 65536:
        raise OptionError(f"--port must be 0 to 65535, got {port}.")


def serve(port: int) -> tuple[Any, str]:
    """Start a ``ViserServer`` for who knows the page's address, and return it and the address.

    Args:
        port: where; the next free one if it is taken, any free one if it is 0.

    Raises:
        SvuEnvironmentError: viser is not installed, or this version of it cannot be guarded.
        OptionError: no port.
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
    """Keep viser from printing, which it does whatever it is told."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
