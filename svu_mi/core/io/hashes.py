"""Digests of values, bytes and files."""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

LETTERS = 32  # hexadecimal digits of a digest


class Key:
    """SHA-256 digest of a sequence of values, including types and shapes of arrays."""

    def __init__(self, *values: Any) -> None:
        self._hash = hashlib.sha256()  # processors have instructions for it
        self.add(*values)

    def add(self, *values: Any) -> None:
        """Add arrays, numbers, text, None, or lists, dictionaries and dataclasses of them.

        Raises:
            TypeError: a value of another type, whose ``repr`` may contain its address.
        """
        for value in values:
            self._add(value)

    def digest(self) -> str:
        """Return the digest as 32 hexadecimal digits."""
        return self._hash.hexdigest()[:LETTERS]

    def _add(self, value: Any) -> None:
        if isinstance(value, np.ndarray):
            self._text(f"{value.dtype}{value.shape}")
            self._hash.update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        elif isinstance(value, np.generic):
            self._add(value.item())
        elif value is None or isinstance(value, bool | int | float | str):
            self._text(repr(value))
        elif isinstance(value, list | tuple):
            self._text(f"list {len(value)}")
            self.add(*value)
        elif isinstance(value, Mapping):
            self._text(f"dict {len(value)}")
            self.add(*sorted(value.items()))
        elif dataclasses.is_dataclass(value):
            self._text(type(value).__name__)
            self.add({f.name: getattr(value, f.name) for f in dataclasses.fields(value)})
        else:
            raise TypeError(f"Key: a {type(value).__name__} has no digest.")

    def _text(self, text: str) -> None:
        self._hash.update(text.encode("utf-8", "surrogatepass") + b"\0")


def digest_of(content: bytes) -> str:
    """Return the BLAKE2b digest of ``content``: 32 hexadecimal digits."""
    return hashlib.blake2b(content, digest_size=LETTERS // 2).hexdigest()


def digest_of_file(path: Path) -> str:
    """Return the BLAKE2b digest of a file: 32 hexadecimal digits.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        new = hashlib.blake2b(digest_size=LETTERS // 2)
        return hashlib.file_digest(stream, lambda: new).hexdigest()
