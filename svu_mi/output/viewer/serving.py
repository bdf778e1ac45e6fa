"""viser's server, started and stopped without a word."""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from typing import Any

from svu_mi.errors import OptionError, SvuEnvironmentError

HOST = "127.0.0.1"  # nobody else's browser


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
    """Refuse what is no port.

    Raises:
        OptionError: it is none.
    """
    if not 0 <= port < 65536:
        raise OptionError(f"--port must be 0 to 65535, got {port}.")


def serve(port: int) -> tuple[Any, str]:
    """Start a ``ViserServer`` for this machine alone, and return it and the page's address.

    Args:
        port: where; the next free one if it is taken, any free one if it is 0.

    Raises:
        SvuEnvironmentError: viser is not installed.
        OptionError: no port.
    """
    require_port(port)
    # A browser that goes away in the middle is nothing to log.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with _silence():
        server = require_viser().ViserServer(host=HOST, port=port, label="svu view", verbose=False)
    return server, f"http://{HOST}:{server.get_port()}"


def stop(server: Any) -> None:
    """Stop a server and its threads."""
    with _silence():
        server.stop()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep viser from printing, which it does whatever it is told."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
