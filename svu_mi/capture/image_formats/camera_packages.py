"""Packages of the extra ``camera``, imported when a file needs them."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from svu_mi.errors import CaptureError

MISSING = "is read by the package {0}; install it with: pip install 'svu_mi[camera]'"


def required(name: str, path: Path) -> Any:
    """Return a module of the extra ``camera``."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise CaptureError(f"{path}: {MISSING.format(name.replace('_', '-'))}.") from error
