"""Import matplotlib with its own settings, for the same pictures on every machine."""

from __future__ import annotations

import importlib.util
import os
import sys
from contextlib import chdir
from pathlib import Path

BACKEND, SETTINGS = "MPLBACKEND", "matplotlibrc"  # variable, and file, that matplotlib reads


def import_matplotlib() -> None:
    """Import matplotlib with its own defaults, unless it is imported already.

    On import it reads settings from the working directory first. Those of a folder of photographs
    could change or break every picture, start LaTeX, or name a module to import.
    """
    if "matplotlib" in sys.modules:
        return
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or spec.origin is None:
        return  # the first picture raises the error
    package = Path(spec.origin).parent
    own = package / "mpl-data"
    backend = os.environ.pop(BACKEND, None)  # an unknown one would be an error
    try:
        with chdir(own if (own / SETTINGS).is_file() else package):
            importlib.import_module("matplotlib")
    finally:
        if backend is not None:
            os.environ[BACKEND] = backend
