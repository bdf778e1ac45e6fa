"""Entry point of ``svu`` and ``python -m svu_mi``."""

import os
import signal
import sys
from contextlib import suppress

from svu_mi.core.interrupts import raise_after_imports

INTERRUPTED = 130  # exit status after Ctrl-C


def main() -> int:
    """Run ``svu``; Ctrl-C ends it with a one-line message, also during imports."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, raise_after_imports)
    try:
        from svu_mi.cli.main import main as run

        status = run()
    except KeyboardInterrupt:
        status = INTERRUPTED
        with suppress(OSError):  # stderr may be closed
            os.write(2, b"svu: interrupted\n")
    if status == INTERRUPTED:  # half-imported C++ modules may abort at a regular exit
        os._exit(status)
    return status


if __name__ == "__main__":
    sys.exit(main())
