"""Digest of the code that computes results: an edited kernel makes cached results invalid."""

from functools import cache
from pathlib import Path

import drjit as dr
import mitsuba as mi

import svu_mi
from svu_mi.core.io.hashes import Key

AROUND = ("bench", "cli", "output")  # folders of svu_mi that do not affect results


def digest_of_code() -> str:
    """Return a digest of code, libraries and device."""
    return Key(digest_of_sources(), mi.__version__, dr.__version__, mi.variant()).digest()


@cache
def digest_of_sources() -> str:
    """Return a digest of the source files that affect results; read once."""
    root, key = Path(svu_mi.__file__).parent, Key()
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root)
        if name.parts[0] not in AROUND:
            key.add(name.as_posix(), path.read_text(encoding="utf-8"))
    return key.digest()
