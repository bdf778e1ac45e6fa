"""Import matplotlib with its default settings, for the same pictures on every machine."""

import importlib.util
import os
import sys
from contextlib import chdir
from pathlib import Path

BACKEND, SETTINGS = "MPLBACKEND", "matplotlibrc"  # environment variable and file of matplotlib


def import_matplotlib() -> None:
    """Import matplotlib with its default settings, unless it is imported already.

    Settings in the working directory could break pictures, start LaTeX, or import a module.
    """
    if "matplotlib" in sys.modules:
        return
    spec = importlib.util.find_spec("matplotlib")
    if spec is None or spec.origin is None:
        return  # drawing a picture raises the error
    package = Path(spec.origin).parent
    own = package / "mpl-data"
    backend = os.environ.pop(BACKEND, None)  # an unknown backend is an error
    try:
        with chdir(own if (own / SETTINGS).is_file() else package):
            importlib.import_module("matplotlib")
    finally:
        if backend is not None:
            os.environ[BACKEND] = backend
