"""Copies of the files of a capture."""

from __future__ import annotations

import shutil
from pathlib import Path

from svu_mi.errors import CaptureError
from svu_mi.files import prepare_folder, replacing


def copy_file(source: Path, target: Path) -> None:
    """Copy a file; the folder of the copy is made if missing.

    Raises:
        CaptureError: the file cannot be read.
        OutputError: the copy cannot be written.
    """
    if not source.is_file():
        raise CaptureError(f"{source}: no such file.")
    prepare_folder(target.parent)
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)
