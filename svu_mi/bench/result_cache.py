"""Cache of finished results: JSON files that are valid under one key."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import drjit as dr

import svu_mi
from svu_mi.core.code_digest import digest_of_code
from svu_mi.core.io.files import prepare_folder
from svu_mi.output.run_record import write_manifest


def key_of(*parts: Any) -> str:
    """Return a short digest of settings (JSON values) and of svu_mi's version.

    A result is reused only if the key is equal, so that results for other settings or versions
    are computed again.
    """
    text = json.dumps([svu_mi.__version__, *parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def code_now() -> str:
    """Return a digest of code, libraries, device and number of threads."""
    return key_of(digest_of_code(), dr.thread_count())


class Store:
    """JSON records by name in a folder.

    Args:
        folder: Folder of the records; created if missing.

    Raises:
        OutputError: The folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = prepare_folder(folder)

    def path(self, name: str) -> Path:
        """Return the file of a record."""
        return self.folder / f"{name}.json"

    def load(self, name: str, key: str) -> dict[str, Any] | None:
        """Return the record with this key; None if missing.

        Damaged JSON counts as missing, so that the record is computed again.
        """
        try:
            record = json.loads(self.path(name).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
        matches = isinstance(record, dict) and record.get("key") == key
        return record if matches else None

    def save(self, name: str, key: str, record: Mapping[str, Any]) -> dict[str, Any]:
        """Write a record atomically; return it as ``load`` returns it.

        Raises:
            OutputError: The file cannot be written, or a value is not JSON.
        """
        write_manifest(self.path(name), {**record, "key": key})
        loaded = self.load(name, key)
        assert loaded is not None
        return loaded
