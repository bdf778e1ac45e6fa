"""Entry point of ``svu`` and ``python -m svu_mi``."""

import os
import signal
import sys
from contextlib import suppress
from typing import Any


def main() -> int:
    """Run ``svu``; Ctrl-C ends it with a one-line message, also during imports."""
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if usual:
        signal.signal(signal.SIGINT, _stop)
    from svu_mi.cli.main import main as run

    try:
        if usual:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return run()
    except KeyboardInterrupt:
        return _interrupted()


def _stop(*_: Any) -> None:
    """End the process immediately; an exception would print a traceback of the imports."""
    os._exit(_interrupted())


def _interrupted() -> int:
    with suppress(OSError):  # stderr may be closed
        os.write(2, b"svu: interrupted\n")
    return 130


if __name__ == "__main__":
    sys.exit(main())
