"""Filtered and split light, and options of commands, computed once per process in tests."""

from __future__ import annotations

import hashlib
import pickle
from types import ModuleType

MAPS = 64  # of filtered light, that are kept: less than 100 MB


def remember() -> None:
    """Keep results of three functions by their arguments.

    The same light comes again in many tests: NumPy filters it in 0.3 s and splits it in 0.04 s.
    Tyro reads the options of a command in 0.02 s.
    """
    from tyro._docstrings import _ClassTokenization

    from svu_mi.light import light_tree, prefiltered

    _once(prefiltered, "convolve")
    _once(light_tree, "_split")
    _once(_ClassTokenization, "make")


def _once(module: ModuleType | type, name: str) -> None:
    compute, kept = getattr(module, name), {}

    def remembered(*arguments: object) -> object:
        key = hashlib.blake2b(pickle.dumps(arguments)).digest()
        result = kept.get(key)  # several threads do this
        if result is None:
            if len(kept) >= MAPS:
                kept.clear()
            result = kept[key] = compute(*arguments)
        return result

    setattr(module, name, remembered)
