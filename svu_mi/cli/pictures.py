"""matplotlib as it comes: the same pictures on every machine, and from every folder."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BACKEND, SETTINGS = "MPLBACKEND", "matplotlibrc"  # variable, and file, that matplotlib reads


def import_matplotlib() -> None:
    """Import matplotlib with its own defaults, unless somebody has imported it already.

    On import it reads settings from the working directory first. A folder of photographs may come
    from anywhere; its settings could change or break every picture, start LaTeX, or name a module
    to import.
    """
    if "matplotlib" in sys.modules:
        return
    found = importlib.util.find_spec("matplotlib")
    if found is None or found.origin is None:
        return  # whoever needs it will say so
    package = Path(found.origin).parent
    own = package / "mpl-data"
    backend = os.environ.pop(BACKEND, None)  # an unknown one would be an error
    try:
        with _working_in(own if (own / SETTINGS).is_file() else package):
            importlib.import_module("matplotlib")
    finally:
        if backend is not None:
            os.environ[BACKEND] = backend


@contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    """Change the working directory for a while; the one before may be removed by now."""
    if os.chdir not in os.supports_fd:  # Windows, where nobody can remove it
        before = os.getcwd()
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)
        return
    descriptor = os.open(".", getattr(os, "O_PATH", os.O_RDONLY))
    try:
        os.chdir(folder)
        yield
    finally:
        os.chdir(descriptor)
        os.close(descriptor)
